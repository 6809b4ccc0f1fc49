"""Tables and curves of a run on the terminal."""

from __future__ import annotations

import io
import json
import math

import pytest
from helpers.made_runs import write_run
from rich.console import Console

from ctgraph_rl import RunLog, metrics
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.report import terminal
from ctgraph_rl.report.terminal import print_summary, sparklines

LABELS = ("goal1.1", "goal1.2")


@pytest.fixture
def run_dir(tmp_path):
    """What a run of two tasks leaves."""
    log = RunLog(tmp_path / "run.jsonl")
    log.append("run", schema=1, curriculum="two", fingerprint="f", config={"seed": 0}, trained=[[1], [2]])
    for block, frames, returns in ((0, 0, (0.0, 0.25)), (1, 1024, (1.0, 0.5)), (2, 2048, (0.75, 1.0))):
        if block:
            log.append("training", block=block, frames=frames - 512, return_mean=float("nan"))
            log.append("training", block=block, frames=frames, return_mean=0.5)
        for task, (label, value) in enumerate(zip(LABELS, returns, strict=True), 1):
            where = {"block": block, "frames": frames, "task": task, "label": label, "held_out": False}
            log.append("evaluation", moment="after", **where, return_mean=value)
    log.close()
    write_metrics(tmp_path / "metrics.json", metrics.summary(log.performance(), [(0,), (1,)]))
    return tmp_path


def shown(run_dir, width: int = 200) -> list[list[str]]:
    """The cells of the printed tables, line by line."""
    console = Console(file=io.StringIO(), width=width)
    print_summary(run_dir, console)
    lines = console.file.getvalue().splitlines()
    return [[cell.strip() for cell in line.strip("│┃").replace("┃", "│").split("│")] for line in lines]


def test_the_summary_shows_the_performance_matrix_and_every_metric(run_dir):
    rows = shown(run_dir)

    assert ["block", "frames", *LABELS] in rows
    matrix = [["0", "0", "0.00", "0.25"], ["1", "1,024", "1.00", "0.50"], ["2", "2,048", "0.75", "1.00"]]
    assert [row for row in rows if row in matrix] == matrix
    assert ["average performance", "0.88", "1/T sum_j R[T,j]"] in rows
    assert ["forward transfer", "0.25", "1/(T-1) sum_{j=2..T} (R[j-1,j] - R[0,j])"] in rows
    assert ["backward transfer", "-0.25", "1/(T-1) sum_{j=1..T-1} (R[T,j] - R[j,j])"] in rows
    assert ["forgetting", "0.25", "1/(T-1) sum_{j=1..T-1} (max_{l=1..T-1} R[l,j] - R[T,j])"] in rows


def test_no_table_is_laid_out_with_more_columns_than_fit(tmp_path, monkeypatch):
    measured = []
    width = terminal._width
    monkeypatch.setattr(terminal, "_width", lambda table: (measured.append(len(table.columns)), width(table))[1])
    labels = [f"goal{number}" for number in range(25)]
    run_dir = write_run(tmp_path / "run", performance=[[0.0] * 25] * 26, labels=labels)

    print_summary(run_dir, Console(file=io.StringIO(), width=80))
    print_summary(run_dir, Console(file=io.StringIO(), width=100))

    assert measured == [5, 27, 2, 5]


def test_many_tasks_are_a_line_each(tmp_path):
    labels = [f"goal{number}" for number in range(7)]
    returns = [[0.0] * 7, [1.0, *[0.25] * 6], [0.5, *[0.25] * 5, math.nan]]

    rows = shown(write_run(tmp_path / "run", performance=returns, labels=labels), 69)

    assert ["task", "before", "best", "in block", "at end", "curve"] in rows
    assert ["goal0", "0.00", "1.00", "1", "0.50", "▁█▅"] in rows
    assert ["goal1", "0.00", "0.25", "1", "0.25", "▁▃▃"] in rows
    assert ["goal6", "0.00", "0.25", "1", "-", "▁▃"] in rows


def test_a_task_that_is_never_above_0_has_no_best_block(tmp_path):
    run_dir = write_run(tmp_path / "run", performance=[[0.0] * 7] * 2, labels=[f"goal{i}" for i in range(7)])

    assert ["goal0", "0.00", "0.00", "-", "0.00", "▁▁"] in shown(run_dir, 70)


@pytest.mark.parametrize(
    ("tasks", "length", "width"), [(1, 40, 80), (4, 16, 80), (6, 7, 80), (6, 40, 100), (40, 7, 100), (40, 40, 80)]
)
def test_a_terminal_shows_every_task_whatever_the_length_of_their_names(tmp_path, tasks, length, width):
    labels = [f"{number}{'x' * (length - 4)}{number}" for number in range(10, 10 + tasks)]
    run_dir = write_run(tmp_path / "run", performance=[[0.125] * tasks] * (tasks + 1), labels=labels)
    console = Console(file=io.StringIO(), width=width)

    print_summary(run_dir, console)

    printed = console.file.getvalue()
    assert "…" not in printed
    assert max(map(len, printed.splitlines())) <= width
    assert all(f" {label[:5]}" in printed and f"{label[-5:]} " in printed for label in labels)


def test_an_undefined_metric_shows_why(run_dir):
    log = RunLog.read(run_dir / "run.jsonl")
    write_metrics(run_dir / "metrics.json", metrics.summary(log.performance(), [(1,), (0,)]))

    rows = shown(run_dir)

    reason = "the definition needs each task trained once, alone, in the order of the columns"
    assert ["forgetting", "undefined", reason] in rows


def test_a_run_with_a_detector_shows_what_it_detected(run_dir):
    assert "false alarms" not in [cells[0] for cells in shown(run_dir)]
    found = json.loads((run_dir / "metrics.json").read_text())
    found["false_alarms"] = {**found["forgetting"], "value": 2.0, "undefined": None}
    (run_dir / "metrics.json").write_text(json.dumps(found))

    assert ["false alarms", "2.00"] in [cells[:2] for cells in shown(run_dir)]


def test_a_bar_for_each_evaluation_is_printed_for_each_task(run_dir):
    rows = shown(run_dir)

    assert ["goal1.1", "▁█▆"] in rows
    assert ["goal1.2", "▃▅█"] in rows


def test_a_terminal_without_unicode_gets_ascii(run_dir):
    file = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    print_summary(run_dir, Console(file=file, width=200))
    file.seek(0)

    text = file.read()

    assert "| goal1.1 | _#+ " in text
    assert "| goal1.2 | -=# " in text


def test_bars_share_one_scale_that_holds_0_and_1():
    curves = {"a": [(0, -1.0), (1, 0.0), (2, 3.0)], "b": [(0, 1.0), (1, math.nan), (2, 0.5)]}

    assert sparklines(curves) == {"a": "▁▃█", "b": "▅ ▄"}
    assert sparklines({"c": [(0, 0.0), (1, 0.5)]}) == {"c": "▁▅"}


def test_many_evaluations_share_places_as_means():
    curve = [(i, float(i % 2)) for i in range(64)] + [(64, 1.0)]

    (line,) = sparklines({"a": curve}).values()

    assert len(line) == 32
    assert line[:5] == "▅▅▅▅▅"  # means of 0 and 1
