"""RunLog and the files that are made of it."""

from __future__ import annotations

import json
import textwrap

import pytest
import torch
from helpers.made_runs import evaluate, learned

from ctgraph_rl import RunLog, metrics
from ctgraph_rl.log import run_log as log_module
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.log.tables import write_performance

TRAINED = [(0,), (1,)]


def evaluated(log: RunLog) -> RunLog:
    """Two tasks, before training and after two blocks."""
    evaluate(log, "before", 0, 0, 0.0, 0.25)
    evaluate(log, "after", 1, 64, 1.0, 0.5)
    evaluate(log, "after", 2, 192, 0.75, 1.0)
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


def test_a_closed_log_is_written_to_no_more_and_one_in_memory_may_be_closed(tmp_path):
    log, in_memory = RunLog(tmp_path / "run.jsonl"), RunLog()

    log.close()
    in_memory.close()

    with pytest.raises(ValueError, match="is closed: nothing can be added"):
        log.append("training", block=1)
    in_memory.append("training", block=1)


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
    log.append("training", block=1, frames=64)
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

    write_performance(tmp_path / "performance.csv", log)

    expected = "block,frames,goal1.1,goal1.2\n0,0,0.0,0.25\n1,64,1.0,0.5\n2,192,0.75,1.0\n"
    assert (tmp_path / "performance.csv").read_text() == expected


def test_metrics_are_written_with_value_and_definition(tmp_path):
    log = evaluated(RunLog())

    write_metrics(tmp_path / "metrics.json", metrics.summary(log.performance(), [(0,), (1,)]))

    content = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail)
    del content["files"]
    assert {name: metric["value"] for name, metric in content.items()} == {
        "average_performance": 0.875,
        "forward_transfer": 0.25,
        "backward_transfer": -0.25,
        "forgetting": 0.25,
    }
    fields = ("value", "definition", "formula", "source", "undefined", "n_undefined", "n_seeds", "interval")
    assert {tuple(metric) for metric in content.values()} == {fields}


def test_an_undefined_metric_is_written_as_null_with_the_reason(tmp_path):
    single = torch.tensor([[0.0], [1.0]], dtype=torch.float64)

    write_metrics(tmp_path / "metrics.json", metrics.summary(single, [(0,)]))

    forgetting = json.loads((tmp_path / "metrics.json").read_text())["forgetting"]
    assert forgetting["value"] is None
    assert forgetting["undefined"] == "the definition needs at least two tasks"


def test_a_run_without_some_evaluations_has_rows_of_nan():
    log = RunLog()
    for block in (1, 2):
        log.append("training", block=block, frames=64 * block, episodes=1, return_mean=0.0)
    evaluate(log, "during", 2, 100, 0.5, 0.5)

    performance = log.performance()

    assert performance.shape == (3, 2)
    assert performance.isnan().all()
    assert log.ends() == [0, 64, 100]


def test_tasks_that_were_not_yet_evaluated_are_nan():
    log = RunLog()
    evaluate(log, "after", 1, 64, 1.0)
    evaluate(log, "after", 2, 128, 0.5, 1.0)

    assert log.performance().isnan().tolist() == [[True, True], [False, True], [False, False]]


def test_evaluations_during_blocks_and_of_held_out_tasks_are_not_in_the_matrix():
    performance = learned(RunLog()).performance()

    assert performance.tolist() == [[0.0, 0.25], [1.0, 0.5], [0.75, 1.0]]


def test_curves_have_every_evaluation_of_the_trained_tasks_in_time_order():
    curves = learned(RunLog()).curves()

    assert (curves.blocks, curves.frames) == ((0, 1, 1, 2, 2), (0, 50, 100, 150, 200))
    assert curves.performance.tolist() == [[0.0, 0.25], [0.5, 0.25], [1.0, 0.5], [1.0, 0.75], [0.75, 1.0]]
    assert curves.trained == ((0,), (1,))
    assert torch.equal(curves.ends, learned(RunLog()).performance())


def test_regimes_are_training_intervals_with_episodes_and_evaluations_at_boundaries():
    regimes = learned(RunLog()).regimes()

    assert [(r.task, r.training, r.values.tolist()) for r in regimes] == [
        ("goal1.1", False, [0.0]),
        ("goal1.2", False, [0.25]),
        ("goal1.1", True, [0.25]),
        ("goal1.1", False, [1.0]),
        ("goal1.2", False, [0.5]),
        ("goal1.2", True, [0.5]),
        ("goal1.1", False, [0.75]),
        ("goal1.2", False, [1.0]),
    ]


def test_a_log_that_does_not_say_what_was_trained_is_told():
    log = evaluated(RunLog())

    assert log.curves(TRAINED).trained == ((0,), (1,))
    with pytest.raises(ValueError, match="does not say what each block trained: give trained"):
        log.curves()


def test_a_block_of_several_tasks_has_no_regimes():
    with pytest.raises(ValueError, match="lifelong metrics need blocks that train one task, block 2 trains several"):
        learned(RunLog(), ([1], [1, 2])).regimes()


def test_a_task_that_was_never_evaluated_has_no_regimes_and_columns_of_nan():
    log = RunLog()
    log.append("training", block=1, frames=64, episodes=1, return_mean=0.0)
    evaluate(log, "after", 1, 64, 1.0)

    with pytest.raises(ValueError, match="lifelong metrics need an evaluation of every task"):
        log.regimes([(1,)])
    assert log.performance(num_tasks=2)[1].isnan().tolist() == [False, True]
    assert log.curves([(1,)]).performance.isnan().tolist() == [[False, True]]


def test_a_run_that_stopped_has_rows_of_nan_for_what_the_log_says_is_to_come(tmp_path):
    log = RunLog()
    log.append("run", schema=1, trained=[[1], [2]])
    evaluate(log, "before", 0, 0, 0.0, 0.25)
    evaluate(log, "after", 1, 64, 1.0, 0.5)

    write_performance(tmp_path / "performance.csv", log)
    summary = metrics.summary(log.performance(), TRAINED)

    assert log.performance().isnan().tolist() == [[False] * 2, [False] * 2, [True] * 2]
    assert (tmp_path / "performance.csv").read_text().splitlines()[1:] == ["0,0,0.0,0.25", "1,64,1.0,0.5"]
    assert {name: metric.value for name, metric in summary.items()} == {
        "average_performance": None,
        "forward_transfer": 0.25,
        "backward_transfer": None,
        "forgetting": None,
    }


def test_tasks_that_the_log_says_are_trained_have_columns_before_they_are_evaluated():
    log = RunLog()
    log.append("run", schema=1, trained=[[1], [3]])
    evaluate(log, "before", 0, 0, 0.5)

    assert log.performance().shape == (3, 3)
    assert log.performance()[0].isnan().tolist() == [False, True, True]


def test_a_label_may_come_from_an_evaluation_during_a_block():
    log = RunLog()
    log.append("training", block=1, frames=64, episodes=1, return_mean=0.5)
    evaluate(log, "during", 1, 64, 0.25)

    (regime,) = log.regimes([(0,)])

    assert (regime.task, regime.training, regime.values.tolist()) == ("goal1.1", True, [0.5])


def test_fields_of_training_and_of_the_last_evaluations_are_read_by_name():
    log = learned(RunLog())

    assert log.training("frames").tolist() == [50, 100, 150, 200]
    assert log.training_by_block("return_mean")[2].isnan().tolist() == [True, False]
    assert log.last("return_mean").tolist() == [0.75, 1.0]
    assert log.last("end_rate", num_tasks=3).isnan().all()


def test_a_log_without_evaluations_has_no_curves():
    with pytest.raises(ValueError, match="this log has no evaluation"):
        RunLog().curves(TRAINED)


TORN = {
    "no newline": b'{"kind": "training", "block": 1, "fra',
    "zeros of a full disk": b"\0\0\0\0",
    "half a character": b'{"kind": "\xc3',
    "a number": b"12",
    "no kind": b'{"block": 1}',
}


@pytest.mark.parametrize("torn", TORN.values(), ids=TORN)
def test_a_torn_last_line_is_left_out_and_counted(tmp_path, torn):
    log = evaluated(RunLog(tmp_path / "run.jsonl"))
    log.close()
    with (tmp_path / "run.jsonl").open("ab") as file:
        file.write(torn)

    read = RunLog.read(tmp_path / "run.jsonl")

    assert read.measurements == log.measurements
    assert (read.torn_lines, log.torn_lines) == (1, 0)


def test_a_whole_log_has_no_torn_line(tmp_path):
    evaluated(RunLog(tmp_path / "run.jsonl")).close()

    assert RunLog.read(tmp_path / "run.jsonl").torn_lines == 0


def test_a_broken_line_in_the_middle_is_refused(tmp_path):
    (tmp_path / "run.jsonl").write_text('{"kind": "run"}\n{"kind": "trai\n{"kind": "training"}\n')

    with pytest.raises(ValueError, match=r"run\.jsonl: line 2 is no measurement"):
        RunLog.read(tmp_path / "run.jsonl")


def test_a_newer_schema_is_refused(tmp_path):
    (tmp_path / "run.jsonl").write_text('{"kind": "run", "schema": 2}\n')

    with pytest.raises(ValueError, match="has schema 2, this version reads 1: update ctgraph_rl"):
        RunLog.read(tmp_path / "run.jsonl")


def test_the_three_lines_of_the_docstring_read_a_log(tmp_path, monkeypatch):
    log = evaluated(RunLog(tmp_path / "run.jsonl"))
    log.close()
    monkeypatch.chdir(tmp_path)
    code = textwrap.dedent(log_module.__doc__.split("::\n")[1])

    found: dict = {}
    exec(compile(code, "docstring", "exec"), found)

    assert found["measurements"] == log.measurements
    assert len(code.strip().splitlines()) == 3
