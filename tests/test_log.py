"""RunLog and the files that are made of it."""

from __future__ import annotations

import json

import pytest
import torch

from ctgraph_rl import RunLog, metrics
from ctgraph_rl.log import write_metrics, write_performance


def evaluated(log: RunLog) -> RunLog:
    """Two tasks, before training and after two blocks."""
    for block, frames, returns in ((0, 0, (0.0, 0.25)), (1, 64, (1.0, 0.5)), (2, 192, (0.75, 1.0))):
        for task, value in enumerate(returns, 1):
            log.append("evaluation", block=block, frames=frames, task=task, return_mean=value)
    return log


def test_every_measurement_is_one_line_that_is_on_disk_at_once(tmp_path):
    log = RunLog(tmp_path / "run.jsonl")

    log.append("training", block=1, loss=0.5)
    log.append("evaluation", block=1, task=2)

    lines = [json.loads(line) for line in (tmp_path / "run.jsonl").read_text().splitlines()]
    assert [list(line) for line in lines] == [
        ["kind", "block", "loss", "seconds"],
        ["kind", "block", "task", "seconds"],
    ]
    assert lines[0] | {"seconds": 0} == {"kind": "training", "block": 1, "loss": 0.5, "seconds": 0}
    log.close()


def test_nan_and_infinity_become_null(tmp_path):
    log = RunLog(tmp_path / "run.jsonl")

    log.append("training", a=float("nan"), b=float("inf"), c=-float("inf"), d=0.0)
    log.close()

    line = json.loads((tmp_path / "run.jsonl").read_text(), parse_constant=pytest.fail)
    assert [line[name] for name in "abcd"] == [None, None, None, 0.0]


def test_seconds_never_fall():
    log = evaluated(RunLog())

    seconds = [measurement["seconds"] for measurement in log.measurements]

    assert seconds == sorted(seconds)
    assert seconds[0] >= 0


def test_a_file_that_exists_is_refused_and_kept(tmp_path):
    path = tmp_path / "run.jsonl"
    path.write_text("old\n")

    with pytest.raises(FileExistsError, match=r"run\.jsonl"):
        RunLog(path)

    assert path.read_text() == "old\n"


def test_a_log_read_back_holds_the_same_measurements(tmp_path):
    log = evaluated(RunLog(tmp_path / "run.jsonl"))
    log.append("training", block=1)
    log.close()

    read = RunLog.read(tmp_path / "run.jsonl")

    assert read.measurements == log.measurements
    assert [m["kind"] for m in read.measurements] == ["evaluation"] * 6 + ["training"]
    assert [m["block"] for m in read.of_kind("training")] == [1]
    assert torch.equal(read.performance(), log.performance())


def test_the_performance_matrix_has_a_row_per_block_and_a_column_per_task():
    log = evaluated(RunLog())

    performance = log.performance()

    expected = torch.tensor([[0.0, 0.25], [1.0, 0.5], [0.75, 1.0]], dtype=torch.float64)
    assert performance.dtype == torch.float64
    assert torch.equal(performance, expected)


def test_the_performance_matrix_is_written_as_a_line_per_block_with_the_tasks_as_last_columns(tmp_path):
    log = evaluated(RunLog())

    write_performance(tmp_path / "performance.csv", log, ("goal1.1", "goal1.2"))

    expected = "block,frames,goal1.1,goal1.2\n0,0,0.0,0.25\n1,64,1.0,0.5\n2,192,0.75,1.0\n"
    assert (tmp_path / "performance.csv").read_text() == expected


def test_metrics_are_written_with_value_and_definition(tmp_path):
    log = evaluated(RunLog())

    write_metrics(tmp_path / "metrics.json", metrics.summary(log.performance(), [(0,), (1,)]))

    content = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail)
    assert {name: metric["value"] for name, metric in content.items()} == {
        "average_performance": 0.875,
        "forward_transfer": 0.25,
        "backward_transfer": -0.25,
        "forgetting": 0.25,
    }
    assert {tuple(metric) for metric in content.values()} == {("value", "definition", "formula", "source", "undefined")}


def test_an_undefined_metric_is_written_as_null_with_the_reason(tmp_path):
    single = torch.tensor([[0.0], [1.0]], dtype=torch.float64)

    write_metrics(tmp_path / "metrics.json", metrics.summary(single, [(0,)]))

    forgetting = json.loads((tmp_path / "metrics.json").read_text())["forgetting"]
    assert forgetting["value"] is None
    assert forgetting["undefined"] == "the definition needs at least two tasks"
