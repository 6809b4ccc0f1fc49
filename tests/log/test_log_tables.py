"""A run's log as tidy tables."""

from __future__ import annotations

import csv
import sys
import textwrap
import types

import pytest
from helpers.scripted import Scripted, curriculum, task

from ctgraph_rl import Block, RunLog, learn_curriculum
from ctgraph_rl.log import tables
from ctgraph_rl.log.tables import EVALUATIONS, TRAINING, write_tables


@pytest.fixture
def log() -> RunLog:
    log = RunLog()
    log.append("run", curriculum="two, tasks", fingerprint="00ff", config={"seed": 3}, trained=[[1]])
    means = {"episodes": 4, "return_mean": 0.25, "success_rate": 0.25, "length_mean": 5.5}
    where = {"block": 0, "moment": "before", "frames": 0, "task": 1, "label": "goal1.1", "held_out": False}
    log.append("evaluation", **where, **means)
    nothing = dict.fromkeys(("return_mean", "success_rate", "length_mean"), float("nan"))
    log.append("training", block=1, frames=64, episodes=0, **nothing, loss=0.5)
    log.append("training", block=1, frames=128, **means, loss=0.25, entropy=1.0)
    for measurement in log.measurements:
        measurement["seconds"] = 1.5
    return log


def read(path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_there_is_a_row_per_evaluation_of_a_task(log, tmp_path):
    write_tables(log, tmp_path, parquet=False)

    (row,) = read(tmp_path / "evaluations.csv")
    assert list(row) == list(EVALUATIONS)
    assert list(row.values()) == [
        *("two, tasks", "00ff", "3", "0", "before", "0", "1", "goal1.1", "False", "4", "0.25", "0.25", "", "5.5", "1.5")
    ]


def test_there_is_a_row_per_training_interval_with_what_the_agent_reports(log, tmp_path):
    write_tables(log, tmp_path, parquet=False)

    first, second = read(tmp_path / "training.csv")
    assert list(first) == [*TRAINING, "loss", "entropy"]
    assert list(first.values())[3:] == ["1", "64", "0", "", "", "", "", "1.5", "0.5", ""]
    assert (second["return_mean"], second["loss"], second["entropy"]) == ("0.25", "0.25", "1.0")


def test_parquet_holds_the_same_rows_with_types(log, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")

    written = write_tables(log, tmp_path, parquet=True)

    assert [path.name for path in written] == [
        *("evaluations.csv", "evaluations.parquet", "training.csv", "training.parquet", "performance.csv")
    ]
    evaluations, training = (parquet.read_table(tmp_path / f"{name}.parquet") for name in ("evaluations", "training"))
    assert {field.name: str(field.type) for field in evaluations.schema} == {
        name: type_ for name, (type_, _) in EVALUATIONS.items()
    }
    assert evaluations.to_pylist()[0]["held_out"] is False
    assert [row["return_mean"] for row in training.to_pylist()] == [None, 0.25]
    assert [row["entropy"] for row in training.to_pylist()] == [None, 1.0]


def test_a_log_without_measurements_has_tables_without_rows(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")

    write_tables(RunLog(), tmp_path)

    assert (read(tmp_path / "evaluations.csv"), read(tmp_path / "training.csv")) == ([], [])
    assert parquet.read_table(tmp_path / "training.parquet").num_rows == 0


def test_without_pyarrow_there_is_csv_and_an_error_only_where_parquet_is_asked_for(log, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)

    assert [path.suffix for path in write_tables(log, tmp_path)] == [".csv"] * 3
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'ctgraph_rl\[tables\]'"):
        write_tables(log, tmp_path, parquet=True)


def test_the_three_lines_of_the_docstring_read_a_table(log, tmp_path, monkeypatch):
    write_tables(log, tmp_path)
    monkeypatch.chdir(tmp_path)
    code = textwrap.dedent(tables.__doc__.split("::\n")[1].split("\nand")[0])

    found: dict = {}
    exec(compile(code, "docstring", "exec"), found)

    assert found["rows"][0]["label"] == "goal1.1"
    assert len(code.strip().splitlines()) == 3


def test_the_columns_are_what_the_loop_logs():
    log = learn_curriculum(curriculum(Block(task(), 12)), Scripted())

    for kind, columns in (("evaluation", EVALUATIONS), ("training", TRAINING)):
        logged = {name for measurement in log.of_kind(kind) for name in measurement} - {"kind"}
        assert set(columns) - set(tables.RUN) <= logged


def test_a_log_is_shown_in_one_line(log):
    assert repr(log) == "<RunLog two, tasks, seed 3: 2 training intervals, 1 evaluations>"


def test_a_log_is_a_data_frame_where_pandas_is_there(log, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", types.SimpleNamespace(DataFrame=list))  # it gets a list of rows

    (evaluation,), training = log.to_pandas(), log.to_pandas("training")

    assert (evaluation["curriculum"], evaluation["seed"], evaluation["return_mean"]) == ("two, tasks", 3, 0.25)
    assert [row["loss"] for row in training] == [0.5, 0.25]
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match="pip install pandas"):
        log.to_pandas()


@pytest.mark.parametrize(("kind", "columns"), [("evaluation", EVALUATIONS), ("training", TRAINING)])
def test_a_data_frame_of_a_run_has_the_columns_of_its_tables_with_their_types_and_values(kind, columns):
    pandas = pytest.importorskip("pandas")
    run = RunLog()
    run.append("run", curriculum="mine", fingerprint="00ff", config={"seed": 3}, trained=[[1]])
    learn_curriculum(curriculum(Block(task(), 48)), Scripted(), log=run)

    frame = run.to_pandas(kind)

    kinds = {"string": "OSU", "bool": "b", "int64": "i", "double": "f"}
    rows = list(run.rows(kind))
    assert isinstance(frame, pandas.DataFrame) and len(frame) == len(rows) > 1
    assert list(frame.columns) == list(rows[0])
    for name, (type_name, _) in columns.items():
        found = frame[name].astype(object).where(frame[name].notna(), None)
        assert frame[name].dtype.kind in kinds[type_name], name
        assert found.tolist() == [row[name] for row in rows], name
