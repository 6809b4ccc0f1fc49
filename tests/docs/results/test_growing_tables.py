"""Tables of raw results that grow: they are stored once, when no run is lacking, and lose none that is stored."""

from __future__ import annotations

import shutil
from importlib import import_module

import pytest
from helpers.paths import CHECKOUT

FOLDER = CHECKOUT / "docs" / "results"
RUNS = {
    "collectives": ("studies.collectives.runs", "collective.jsonl", ("collectives", "collective_blocks", "selecting")),
    "memory_cells": ("studies.memory.page", "metrics.json", ("memory_cells", "memory_ladder")),
    "no_labels": ("studies.no_labels.runs", "metrics.json", ("no_labels", "no_labels_spans")),
}
"""The module that collects a table, the file of a run that it looks for, and all tables that it writes."""


@pytest.fixture
def raw(monkeypatch, tmp_path):
    """The module of tables, with copies of the stored ones."""
    from studies import raw

    (tmp_path / "stored").mkdir()
    for *_, names in RUNS.values():
        for name in names:
            shutil.copy(FOLDER / f"{name}.csv", tmp_path / "stored")
    monkeypatch.setattr(raw, "HERE", tmp_path / "stored")
    monkeypatch.setattr(raw, "GROWING", tmp_path / "growing")
    return raw


def contents(folder):
    return {path.stem: path.read_bytes() for path in folder.glob("*.csv")}


@pytest.mark.parametrize("table", RUNS)
def test_a_stored_table_to_which_no_run_is_added_keeps_its_lines_in_their_order(raw, table, tmp_path):
    before = contents(tmp_path / "stored")
    first, *others = raw.read(table)
    raw.write(table, [*others, first])

    import_module(RUNS[table][0]).collect(table, [tmp_path / "none"], add=True)

    assert contents(tmp_path / "stored") == before
    assert contents(tmp_path / "growing") == {}


@pytest.mark.parametrize("table", RUNS)
def test_a_part_of_the_runs_grows_apart_and_all_of_them_are_stored(raw, table, monkeypatch, capsys, tmp_path):
    module = import_module(RUNS[table][0])
    before = contents(tmp_path / "stored")
    lines = raw.read(table)
    first = lines[0]
    folder = tmp_path / "runs" / first.get("curriculum", "") / "run"
    folder.mkdir(parents=True)
    (folder / RUNS[table][1]).touch()
    again = {**first, "machine": "another"}
    lines_of = {"collectives": (again, [again]), "memory_cells": again, "no_labels": (again, [again])}
    monkeypatch.setattr(module, "measured", lambda path: lines_of[table])

    module.collect(table, [tmp_path / "runs"])
    grown = raw.read(table, tmp_path / "growing")
    said = capsys.readouterr().out
    unchanged = contents(tmp_path / "stored") == before
    module.collect(table, [tmp_path / "none"], add=True)

    assert grown == [again] and unchanged
    assert said.startswith(f"To run for {table}.csv") and said.endswith("stay as they were until then.\n")
    assert contents(tmp_path / "growing") == {}
    assert [line["machine"] == "another" for line in raw.read(table)] == [True] + [False] * (len(lines) - 1)
