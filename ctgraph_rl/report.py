"""A run directory as tables on the terminal and as a figure.

``python -m ctgraph_rl.report RUN [--figure FILE]``
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.table import Table

from ctgraph_rl.log import RunLog

ALWAYS = ("average_performance", "forward_transfer", "backward_transfer", "forgetting")
WITH_EXPERTS = ("continual_world_forward_transfer", "relative_performance", "sample_efficiency")
"""Metrics that are shown; the others are in the file."""

MOST_COLUMNS = 6
"""Tasks that the performance matrix is printed for; more do not fit on a terminal."""

MOST_NUMBERS = 10
"""Tasks that the figure has names, numbers and curves for; more do not fit."""

MARKERS = "os^vDPX*<>"
"""One for each of `MOST_NUMBERS` curves."""

Curve = list[tuple[int, float]]
"""Returns after numbers of frames."""


def print_summary(run_dir: Path | str, console: Console | None = None) -> None:
    """Print the performance matrix and the metrics of a finished run."""
    console = Console() if console is None else console
    for table in (performance_table(run_dir), metrics_table(run_dir)):
        console.print(table)


def performance_table(run_dir: Path | str) -> Table:
    """The performance matrix: mean return on each task after each block; for many tasks, what matters of each."""
    with open(Path(run_dir) / "performance.csv", newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file))
    values = [[float(value) for value in row[2:]] for row in rows]
    if len(header) > 2 + MOST_COLUMNS:
        return _task_table(Path(run_dir).name, header[2:], values)
    table = Table(title=f"{Path(run_dir).name}: mean return on each task after each block")
    for name in header:
        table.add_column(name, justify="right")
    for (block, frames, *_), row in zip(rows, values, strict=True):
        table.add_row(block, f"{int(frames):,}", *map(_shown, row))
    return table


def _task_table(name: str, labels: list[str], values: list[list[float]]) -> Table:
    """A line for each task: its return before training, the best one after a block, and the last one.

    The block of a best that is not above 0 is left out: that is of no block.
    """
    table = Table(
        title=f"{name}: mean return on each task; performance.csv has it after each of {len(values) - 1} blocks"
    )
    for heading in ("task", "before", "best", "after block", "at the end"):
        table.add_column(heading, justify="left" if heading == "task" else "right")
    for task, label in enumerate(labels):
        column = [row[task] for row in values]
        known = [(value, -block) for block, value in enumerate(column) if block and not math.isnan(value)]
        best, block = max(known, default=(math.nan, 0))
        after = str(-block) if best > 0 else "-"
        table.add_row(label, _shown(column[0]), _shown(best), after, _shown(column[-1]))
    return table


def _shown(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"


def metrics_table(run_dir: Path | str) -> Table:
    """The main metrics with their definitions; an undefined one shows why. Those against experts only where defined."""
    metrics: dict[str, dict[str, Any]] = json.loads((Path(run_dir) / "metrics.json").read_text(encoding="utf-8"))
    table = Table(title=f"Metrics; metrics.json has all {len(metrics)}")
    for name, justify in (("metric", "left"), ("value", "right"), ("definition", "left")):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    for name in (*ALWAYS, *(name for name in WITH_EXPERTS if metrics.get(name, {}).get("value") is not None)):
        metric = metrics[name]
        value = "undefined" if metric["value"] is None else f"{metric['value']:.2f}"
        table.add_row(name.replace("_", " "), value, metric["undefined"] or metric["formula"].replace("[", r"\["))
    return table


def draw_figure(run_dir: Path | str, path: Path | str) -> None:
    """Draw learning curves over frames with block boundaries, and the performance matrix beside them.

    The curves are the returns while training; with evaluations during blocks, or without training, those of the
    evaluations. A run that has neither is drawn as the matrix alone.

    Args:
        run_dir: a finished run.
        path: the picture to write; its ending decides the format.

    Raises:
        ModuleNotFoundError: without matplotlib; names the extra to install.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("figures need matplotlib: pip install 'ctgraph_rl[plot]'") from error
    log = RunLog.read(Path(run_dir) / "run.jsonl")
    training, evaluations = _training_curves(log), _evaluation_curves(log)
    if not (training or evaluations):
        figure = Figure(figsize=(4.5, 3.2), layout="constrained")
        matrix = figure.subplots()
    else:
        figure = Figure(figsize=(9, 3.8 if evaluations else 3.2), layout="constrained")
        curves, matrix = figure.subplots(1, 2, width_ratios=(3, 2))
        _draw_curves(curves, training, evaluations, log.ends()[1:])
    figure.colorbar(_draw_matrix(matrix, log), ax=matrix)
    figure.savefig(path, dpi=160)


def _labels(log: RunLog) -> dict[int, str]:
    """Names of the curriculum's tasks by number, as far as they were evaluated."""
    return {m["task"]: m["label"] for m in log.of_kind("evaluation") if not m["held_out"]}


def _draw_matrix(axes: Any, log: RunLog) -> Any:
    """The performance matrix as an image, which is returned; few tasks have names and numbers."""
    performance, labels = log.performance(), _labels(log)
    known = performance[~performance.isnan()].tolist()
    low, high = min([0.0, *known]), max([1.0, *known])
    axes.set_ylabel("after block")
    axes.set_title("Mean return on each task", fontsize=9)
    num_rows, num_tasks = performance.shape
    if num_tasks > MOST_NUMBERS:
        axes.set_xlabel("task, counted from 0")
    else:
        names = [labels.get(task, f"task {task}") for task in range(1, num_tasks + 1)]
        axes.set_xticks(range(num_tasks), names, rotation=30, ha="right", fontsize=7)
        axes.set_yticks(range(num_rows))
        _write_numbers(axes, performance.tolist(), low + 0.6 * (high - low))
    return axes.imshow(performance.numpy(), cmap="viridis", vmin=low, vmax=high, aspect="auto")


def _write_numbers(axes: Any, rows: list[list[float]], bright: float) -> None:
    """Each value in its cell, dark on bright ones."""
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            axes.text(j, i, _shown(value), ha="center", va="center", color="white" if value < bright else "black")


def _training_curves(log: RunLog) -> list[Curve]:
    """Return while training, a curve for each block with a finished episode."""
    training = [m for m in log.of_kind("training") if m["return_mean"] is not None]
    blocks = dict.fromkeys(m["block"] for m in training)
    return [[(m["frames"], m["return_mean"]) for m in training if m["block"] == block] for block in blocks]


def _evaluation_curves(log: RunLog) -> dict[str, Curve]:
    """Evaluations where they tell more than the training: a curve by the name of each task; of many, their mean."""
    evaluations = [m for m in log.of_kind("evaluation") if not m["held_out"] and m["return_mean"] is not None]
    if _training_curves(log) and all(m["moment"] != "during" for m in evaluations):
        return {}
    labels, by_task, by_frames = _labels(log), defaultdict(list), defaultdict(list)
    for m in evaluations:
        by_task[m["label"]].append((m["frames"], m["return_mean"]))
        by_frames[m["frames"]].append(m["return_mean"])
    if len(labels) <= MOST_NUMBERS:
        return dict(by_task)
    mean = [(frames, fmean(returns)) for frames, returns in by_frames.items() if len(returns) == len(labels)]
    return {f"mean of {len(labels)} tasks": mean} if mean else {}


def _draw_curves(axes: Any, training: list[Curve], evaluations: dict[str, Curve], ends: Sequence[int]) -> None:
    """Return over frames; dashed lines where a block ends."""
    style: dict[str, Any] = {"color": "0.6", "linewidth": 0.7} if evaluations else {"color": "black", "linewidth": 1}
    _draw_evaluations(axes, evaluations)
    for i, curve in enumerate(training):
        name = None if i else "while training"
        axes.plot(*zip(*curve, strict=True), marker="." if len(curve) == 1 else None, label=name, zorder=1, **style)
    if evaluations:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=5, fontsize=7, frameon=False)
    for end in ends:
        axes.axvline(end, color="grey", linestyle="--", linewidth=0.8, zorder=0)
    axes.set(xlabel="frames", ylabel="mean return" if evaluations else "return while training")
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -0.03), max(high, 1.03))
    axes.locator_params(axis="x", integer=True, nbins=6)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.tick_params(axis="x", labelsize=7)
    axes.set_title("Evaluations, task after task" if evaluations else "Learning, task after task", fontsize=9)


def _draw_evaluations(axes: Any, evaluations: dict[str, Curve]) -> None:
    """A curve each, the lighter above the darker and with smaller marks: a grey print keeps them apart, too."""
    from matplotlib import colormaps

    for i, (name, curve) in enumerate(evaluations.items()):
        place = i / max(1, len(evaluations) - 1)
        line = {"color": colormaps["viridis"](0.9 * place), "linestyle": ("-", "--", ":")[i % 3], "linewidth": 1.2}
        mark = {"marker": MARKERS[i], "markersize": 7 - 4 * place, "markevery": 1 + len(curve) // 20}
        axes.plot(*zip(*curve, strict=True), label=name, **line, **mark)


def main() -> None:
    """Print a run's tables, and draw its figure where asked."""
    parser = argparse.ArgumentParser(prog="python -m ctgraph_rl.report", description=__doc__)
    parser.add_argument("run", type=Path, help="a run directory")
    parser.add_argument("--figure", type=Path, help="also draw a figure into this file (.png, .pdf, .svg)")
    arguments = parser.parse_args()
    if not (arguments.run / "metrics.json").is_file():
        parser.error(f"{arguments.run} is no finished run: it has no metrics.json")
    print_summary(arguments.run)
    if arguments.figure is not None:
        try:
            draw_figure(arguments.run, arguments.figure)
        except (ModuleNotFoundError, OSError, ValueError) as error:
            parser.error(str(error))
        print(f"figure: {arguments.figure}")


if __name__ == "__main__":
    main()
