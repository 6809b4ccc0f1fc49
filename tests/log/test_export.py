"""A run in the format of l2logger, against the format's rules."""

from __future__ import annotations

import csv
import json
import re
import sys
from datetime import datetime
from pathlib import Path

import pytest
import torch
from helpers.made_runs import learned

from ctgraph_rl import RunLog
from ctgraph_rl.log import export
from ctgraph_rl.log.export import numbered, task_names, write_l2logger
from ctgraph_rl.metrics import Regime


def regime(task: str, training: bool, *values: float) -> Regime:
    return Regime(task, training, torch.tensor(values or (0.5,), dtype=torch.float64))


def rows_of(folder: Path) -> list[dict[str, str]]:
    """All rows as l2metrics puts them together: of every file, in the order of experiences."""
    rows = []
    for path in folder.rglob("data-log.tsv"):
        with path.open(newline="", encoding="utf-8") as file:
            rows += [{**row, "folder": path.parent.name} for row in csv.DictReader(file, delimiter="\t")]
    return sorted(rows, key=lambda row: int(row["exp_num"]))


def test_a_run_is_written_block_by_block(tmp_path):
    write_l2logger(learned(RunLog()).regimes(), tmp_path / "out")

    rows = rows_of(tmp_path / "out")
    assert [(row["folder"], row["exp_num"], row["task_name"], float(row["reward"])) for row in rows] == [
        ("0-test", "0", "ctgraph_1goal11", 0.0),
        ("0-test", "1", "ctgraph_2goal12", 0.25),
        ("1-train", "2", "ctgraph_1goal11", 0.25),
        ("2-test", "3", "ctgraph_1goal11", 1.0),
        ("2-test", "4", "ctgraph_2goal12", 0.5),
        ("3-train", "5", "ctgraph_2goal12", 0.5),
        ("4-test", "6", "ctgraph_1goal11", 0.75),
        ("4-test", "7", "ctgraph_2goal12", 1.0),
    ]


def test_every_row_and_file_obeys_the_format(tmp_path):
    write_l2logger(learned(RunLog()).regimes(), tmp_path / "out")

    rows = rows_of(tmp_path / "out")
    assert all(tuple(row) == (*export.COLUMNS, "folder") for row in rows)
    assert all(f"{row['block_num']}-{row['block_type']}" == row["folder"] for row in rows)
    assert {(row["block_subtype"], row["exp_status"], row["worker_id"]) for row in rows} == {
        ("wake", "complete", "worker0")
    }
    assert all(re.fullmatch("[0-9a-z]+_[0-9a-z]+", row["task_name"]) for row in rows)
    assert all(json.loads(row["task_params"]) == {} for row in rows)
    stamps = [datetime.strptime(row["timestamp"], "%Y%m%dT%H%M%S.%f") for row in rows]
    assert stamps == sorted(set(stamps))
    about, scenario = (json.loads((tmp_path / f"out/{name}_info.json").read_text()) for name in ("logger", "scenario"))
    assert about == {"metrics_columns": ["reward"], "log_format_version": "1.1"}
    assert scenario == {"complexity": "1-low", "difficulty": "1-easy", "scenario_type": "custom"}


def test_values_are_written_without_loss(tmp_path):
    values = torch.rand(50, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).tolist()

    write_l2logger([regime("a", True, *values)], tmp_path / "out")

    assert [float(row["reward"]) for row in rows_of(tmp_path / "out")] == values


def test_evaluations_of_different_tasks_share_a_block_and_of_one_task_do_not():
    kinds = [("a", False), ("b", False), ("a", True), ("a", True), ("a", False), ("a", False), ("b", False)]

    blocks = [block for block, _ in numbered([regime(*kind) for kind in kinds])]

    assert blocks == [0, 0, 1, 2, 3, 4, 4]


def test_tasks_of_one_name_but_for_signs_stay_apart():
    names = task_names([regime("goal1.1-d2#2", True), regime("goal11-d2_2", True), regime("goal1.1-d2#2", False)])

    assert names == {"goal1.1-d2#2": "ctgraph_1goal11d22", "goal11-d2_2": "ctgraph_2goal11d22"}


def test_equal_runs_give_equal_files(tmp_path):
    for name in ("one", "other"):
        write_l2logger(learned(RunLog()).regimes(), tmp_path / name)

    one, other = (
        {str(path.relative_to(tmp_path / name)): path.read_bytes() for path in (tmp_path / name).rglob("*.*")}
        for name in ("one", "other")
    )
    assert one == other


def test_a_folder_with_something_in_it_is_refused_and_kept(tmp_path):
    (tmp_path / "mine").write_text("mine")

    with pytest.raises(ValueError, match="must be empty or new; choose another folder"):
        write_l2logger([regime("a", True)], tmp_path)

    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def command_line(monkeypatch, *arguments) -> None:
    monkeypatch.setattr(sys, "argv", ["export", *map(str, arguments)])
    export.main()


def test_the_command_exports_a_run_directory(tmp_path, monkeypatch, capsys):
    learned(RunLog(tmp_path / "run.jsonl")).close()

    command_line(monkeypatch, tmp_path, "--format", "l2logger", "--out", tmp_path / "out")

    assert len(rows_of(tmp_path / "out")) == 8
    assert capsys.readouterr().out == f"l2logger: {tmp_path / 'out'}\n"


@pytest.mark.parametrize(
    ("trained", "message"),
    [
        (None, "holds no run: no run.jsonl in it; name a run directory"),
        ((), "has no training and no evaluation yet: there is nothing to export"),
        (([1], [1, 2]), "lifelong metrics need blocks that train one task, block 2 trains several"),
    ],
)
def test_a_run_that_cannot_be_exported_is_one_message(tmp_path, monkeypatch, capsys, trained, message):
    if trained == ():
        (tmp_path / "run.jsonl").touch()
    elif trained is not None:
        learned(RunLog(tmp_path / "run.jsonl"), trained).close()

    with pytest.raises(SystemExit, match="2"):
        command_line(monkeypatch, tmp_path, "--out", tmp_path / "out")

    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_the_command_exports_tables(tmp_path, monkeypatch, kind):
    log = RunLog(tmp_path / "run.jsonl")
    log.append("run", trained=[[1]])
    log.append("training", block=1, frames=8, episodes=1, return_mean=0.5)
    log.close()

    command_line(monkeypatch, tmp_path, "--format", kind, "--out", tmp_path / "tables")

    of_parquet = {"evaluations.parquet", "training.parquet"} if kind == "parquet" else set()
    tables = {"evaluations.csv", "training.csv", "performance.csv"}
    assert {path.name for path in (tmp_path / "tables").iterdir()} == tables | of_parquet
