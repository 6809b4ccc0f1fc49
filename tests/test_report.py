"""Tables and figure of a run directory."""

from __future__ import annotations

import io
import json
import sys
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from ctgraph_rl import RunLog, metrics, report
from ctgraph_rl.log import write_metrics, write_performance

if TYPE_CHECKING:
    from matplotlib.lines import Line2D

LABELS = ("goal1.1", "goal1.2")


@pytest.fixture
def run_dir(tmp_path):
    """What a run of two tasks leaves."""
    log = RunLog(tmp_path / "run.jsonl")
    for block, frames, returns in ((0, 0, (0.0, 0.25)), (1, 1024, (1.0, 0.5)), (2, 2048, (0.75, 1.0))):
        if block:
            log.append("training", block=block, frames=frames - 512, return_mean=float("nan"))
            log.append("training", block=block, frames=frames, return_mean=0.5)
        for task, (label, value) in enumerate(zip(LABELS, returns, strict=True), 1):
            where = {"block": block, "frames": frames, "task": task, "label": label, "held_out": False}
            log.append("evaluation", moment="after", **where, return_mean=value)
    log.close()
    write_performance(tmp_path / "performance.csv", log, LABELS)
    write_metrics(tmp_path / "metrics.json", metrics.summary(log.performance(), [(0,), (1,)]))
    return tmp_path


def shown(run_dir, width: int = 200) -> list[list[str]]:
    """The cells of the printed tables, line by line."""
    console = Console(file=io.StringIO(), width=width)
    report.print_summary(run_dir, console)
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


def test_many_tasks_are_a_line_each(run_dir):
    labels = [f"goal{number}" for number in range(7)]
    lines = [[0, 0, *[0.0] * 7], [1, 64, 1.0, *[0.25] * 6], [2, 128, 0.5, *[0.25] * 5, "nan"]]
    text = [["block", "frames", *labels], *lines]
    (run_dir / "performance.csv").write_text("\n".join(",".join(map(str, line)) for line in text), encoding="utf-8")

    rows = shown(run_dir, 80)

    assert ["task", "before", "best", "after block", "at the end"] in rows
    assert ["goal0", "0.00", "1.00", "1", "0.50"] in rows
    assert ["goal1", "0.00", "0.25", "1", "0.25"] in rows
    assert ["goal6", "0.00", "0.25", "1", "-"] in rows


def test_a_task_that_is_never_above_0_has_no_best_block(run_dir):
    text = ["block,frames," + ",".join(f"goal{number}" for number in range(7)), "0,0" + ",0.0" * 7, "1,64" + ",0.0" * 7]
    (run_dir / "performance.csv").write_text("\n".join(text), encoding="utf-8")

    assert ["goal0", "0.00", "0.00", "-", "0.00"] in shown(run_dir, 80)


def test_an_undefined_metric_shows_why(run_dir):
    log = RunLog.read(run_dir / "run.jsonl")
    write_metrics(run_dir / "metrics.json", metrics.summary(log.performance(), [(1,), (0,)]))

    rows = shown(run_dir)

    reason = "the definition needs each task trained once, alone, in the order of the columns"
    assert ["forgetting", "undefined", reason] in rows


def test_a_figure_is_drawn_in_the_format_of_its_name(run_dir):
    pytest.importorskip("matplotlib")

    report.draw_figure(run_dir, run_dir / "figure.png")
    report.draw_figure(run_dir, run_dir / "figure.svg")

    assert (run_dir / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (run_dir / "figure.svg").read_text()


def lines(run_dir, *keep: str) -> tuple[dict[str, Line2D], list[float], str]:
    """What the left panel of a log's figure has, of some kinds of measurements: named lines, block ends, title."""
    matplotlib = pytest.importorskip("matplotlib.figure")
    log = RunLog.read(run_dir / "run.jsonl")
    log.measurements = [m for m in log.measurements if m["kind"] in keep]
    axes = matplotlib.Figure().subplots()
    report._draw_curves(axes, report._training_curves(log), report._evaluation_curves(log), log.ends()[1:])
    ends = [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == "--" and line.get_color() == "grey"]
    return {line.get_label(): line for line in axes.lines}, ends, axes.get_title()


def evaluate_during(run_dir, frames: int, *returns: float) -> None:
    """Another evaluation in the log of a run, during block 2."""
    where = {"kind": "evaluation", "moment": "during", "block": 2, "frames": frames, "held_out": False}
    with open(run_dir / "run.jsonl", "a", encoding="utf-8") as file:
        for task, value in enumerate(returns, 1):
            label = f"goal1.{task}"
            file.write(json.dumps({**where, "task": task, "label": label, "return_mean": value}) + "\n")


def test_a_block_with_one_training_batch_is_a_point_that_is_seen(run_dir):
    named, ends, title = lines(run_dir, "training", "evaluation")

    assert ends == [1024, 2048]
    assert title == "Learning, task after task"
    assert named["while training"].get_xydata().tolist() == [[1024, 0.5]]
    assert named["while training"].get_marker() == "."


def test_without_training_the_evaluations_of_each_task_are_drawn(run_dir):
    named, ends, title = lines(run_dir, "evaluation")

    assert ends == [1024, 2048]
    assert title == "Evaluations, task after task"
    assert named["goal1.1"].get_xydata().tolist() == [[0, 0.0], [1024, 1.0], [2048, 0.75]]
    assert named["goal1.2"].get_xydata().tolist() == [[0, 0.25], [1024, 0.5], [2048, 1.0]]
    assert named["goal1.1"].get_marker() != named["goal1.2"].get_marker()


def test_evaluations_during_blocks_are_drawn_above_the_training(run_dir):
    evaluate_during(run_dir, 3000, 0.5, 0.75)

    named, _, title = lines(run_dir, "training", "evaluation")

    assert title == "Evaluations, task after task"
    assert named["goal1.2"].get_xydata().tolist()[-1] == [3000, 0.75]
    assert named["while training"].get_zorder() < named["goal1.1"].get_zorder()


def test_of_many_tasks_the_mean_is_drawn_where_all_were_evaluated(run_dir):
    evaluate_during(run_dir, 3000, *[0.25] * 10, 3.0)
    evaluate_during(run_dir, 4000, 1.0)

    named, _, _ = lines(run_dir, "training", "evaluation")

    assert named["mean of 11 tasks"].get_xydata().tolist() == [[3000, 0.5]]
    assert "goal1.1" not in named


def test_a_run_of_neither_training_nor_evaluations_is_drawn_as_the_matrix_alone(run_dir, monkeypatch):
    pytest.importorskip("matplotlib")
    (run_dir / "run.jsonl").write_text(json.dumps({"kind": "run", "trained": [[1], [2]]}) + "\n", encoding="utf-8")
    monkeypatch.delattr(report, "_draw_curves")

    report.draw_figure(run_dir, run_dir / "figure.png")

    assert (run_dir / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_a_figure_without_matplotlib_names_what_to_install(run_dir, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)

    with pytest.raises(ModuleNotFoundError, match=r"figures need matplotlib: pip install 'ctgraph_rl\[plot\]'"):
        report.draw_figure(run_dir, run_dir / "figure.png")


def test_the_command_prints_the_tables_of_a_run(run_dir, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["report", str(run_dir)])

    report.main()

    assert "goal1.2" in capsys.readouterr().out


def test_a_folder_without_a_finished_run_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path)])

    with pytest.raises(SystemExit) as end:
        report.main()

    assert end.value.code == 2
    assert f"{tmp_path} is no finished run: it has no metrics.json" in capsys.readouterr().err
