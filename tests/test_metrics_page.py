"""docs/metrics.md: its tables are those of the code, and its Python runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from test_lifelong import curriculum, task
from test_log import learned

from ctgraph_rl import Block, RunLog, metrics, tables
from ctgraph_rl.provenance import provenance

TEXT = (Path(__file__).resolve().parents[1] / "docs" / "metrics.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def table(*rows: tuple[str, ...]) -> str:
    """A table of the page, without its header."""
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |\n" for row in rows)


def definition_rows() -> list[tuple[str, ...]]:
    rows = []
    for name, definition in metrics.definitions().items():
        terms = "left out, counted" if definition.partial else "undefined"
        rows.append((f"`{name}`", f"`{definition.id}`", f"`{definition.formula}`", definition.source, terms))
    return rows


def column_rows(columns: dict[str, tuple[str, str]]) -> list[tuple[str, ...]]:
    return [(f"`{name}`", type_, meaning) for name, (type_, meaning) in columns.items()]


def test_the_page_has_every_definition_as_the_code_has_it():
    assert table(*definition_rows()) in TEXT


@pytest.mark.parametrize("columns", [tables.EVALUATIONS, tables.TRAINING], ids=["evaluations", "training"])
def test_the_page_has_the_columns_of_the_tables(columns):
    assert table(*column_rows(columns)) in TEXT


def test_the_python_of_the_page_runs(tmp_path, monkeypatch, capsys):
    learned(RunLog(tmp_path / "run.jsonl")).close()
    (tmp_path / "RUN").mkdir()
    (tmp_path / "run.jsonl").rename(tmp_path / "RUN" / "run.jsonl")
    monkeypatch.chdir(tmp_path)

    exec(compile("".join(BLOCKS), "metrics.md", "exec"), {"torch": torch})

    assert capsys.readouterr().out.splitlines()[0] == "0.875 lopez-paz2017/acc"
    assert (tmp_path / "RUN" / "evaluations.csv").exists()


def test_the_page_has_the_fields_of_the_logs_first_line():
    (row,) = [line for line in TEXT.splitlines() if line.startswith("| `run` |")]

    fields = set(re.findall(r"`(\w+)`", row)) - {"run"}

    assert fields == {*provenance(curriculum(Block(task(), 12))), "config"}


def test_a_training_line_is_as_small_as_the_page_says(tmp_path):
    log = RunLog(tmp_path / "run.jsonl")
    means = dict.fromkeys(("return_mean", "success_rate", "length_mean"), 0.9959432048681541)
    losses = ("loss_objective", "loss_critic", "loss_entropy", "entropy", "grad_norm")
    log.append("training", block=4, frames=98304, episodes=493, **means, **dict.fromkeys(losses, -0.0057376245968))
    log.close()

    (stated,) = re.findall(r"a training line has about (\d+) bytes", TEXT)

    assert abs((tmp_path / "run.jsonl").stat().st_size - int(stated)) < 50
