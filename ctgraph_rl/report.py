"""A run directory as tables on the terminal and as a figure.

``python -m ctgraph_rl.report RUN [--figure FILE]``
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from pathlib import Path
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
"""Tasks that the figure has names and numbers for; more do not fit."""


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
    """A line for each task: its return before training, the best one after a block, and the last one."""
    table = Table(
        title=f"{name}: mean return on each task; performance.csv has it after each of {len(values) - 1} blocks"
    )
    for heading in ("task", "before", "best", "after block", "at the end"):
        table.add_column(heading, justify="left" if heading == "task" else "right")
    for task, label in enumerate(labels):
        column = [row[task] for row in values]
        known = [(value, -block) for block, value in enumerate(column) if block and not math.isnan(value)]
        best, block = max(known, default=(math.nan, 0))
        table.add_row(label, _shown(column[0]), _shown(best), str(-block) if known else "-", _shown(column[-1]))
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
    performance = log.performance()
    labels = list({m["task"]: m["label"] for m in log.of_kind("evaluation") if not m["held_out"]}.values())
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    curve, matrix = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_curve(curve, log)
    known = performance[~performance.isnan()]
    low, high = min(0.0, known.min().item()), max(1.0, known.max().item())
    image = matrix.imshow(performance, cmap="viridis", vmin=low, vmax=high, aspect="auto")
    matrix.set_ylabel("after block")
    matrix.set_title("Mean return on each task", fontsize=9)
    if len(labels) > MOST_NUMBERS:
        matrix.set_xlabel("task, counted from 0")
    else:
        matrix.set_xticks(range(len(labels)), labels, rotation=30, ha="right", fontsize=7)
        matrix.set_yticks(range(len(performance)))
        _write_numbers(matrix, performance.tolist(), low + 0.6 * (high - low))
    figure.colorbar(image, ax=matrix)
    figure.savefig(path, dpi=160)


def _write_numbers(axes: Any, rows: list[list[float]], bright: float) -> None:
    """Each value in its cell, dark on bright ones."""
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            axes.text(j, i, _shown(value), ha="center", va="center", color="white" if value < bright else "black")


def _draw_curve(axes: Any, log: RunLog) -> None:
    """Return while training over frames; dashed lines where the task changes."""
    training = [m for m in log.of_kind("training") if m["return_mean"] is not None]
    for block in dict.fromkeys(m["block"] for m in training):
        curve = [(m["frames"], m["return_mean"]) for m in training if m["block"] == block]
        axes.plot(*zip(*curve, strict=True), color="black", linewidth=1)
        axes.axvline(curve[-1][0], color="grey", linestyle="--", linewidth=0.8)
    axes.set(xlabel="frames", ylabel="return while training")
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -0.03), max(high, 1.03))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.tick_params(axis="x", labelsize=7)
    axes.set_title("Learning, task after task", fontsize=9)


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
