"""A run directory as tables on the terminal and as a figure.

``python -m ctgraph_rl.report RUN [--figure FILE]``
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ctgraph_rl.log import RunLog


def print_summary(run_dir: Path | str, console: Console | None = None) -> None:
    """Print the performance matrix and the metrics of a finished run."""
    console = Console() if console is None else console
    for table in (performance_table(run_dir), metrics_table(run_dir)):
        console.print(table)


def performance_table(run_dir: Path | str) -> Table:
    """The performance matrix: mean return on each task after each block."""
    with open(Path(run_dir) / "performance.csv", newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file))
    table = Table(title=f"{Path(run_dir).name}: mean return on each task after each block")
    for name in header:
        table.add_column(name, justify="right")
    for block, frames, *values in rows:
        table.add_row(block, f"{int(frames):,}", *(f"{float(value):.2f}" for value in values))
    return table


def metrics_table(run_dir: Path | str) -> Table:
    """The metrics with their definitions; an undefined one shows why."""
    metrics: dict[str, dict[str, Any]] = json.loads((Path(run_dir) / "metrics.json").read_text(encoding="utf-8"))
    table = Table(title="Metrics")
    for name, justify in (("metric", "left"), ("value", "right"), ("definition", "left")):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    for name, metric in metrics.items():
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
    labels = [m["label"] for m in log.of_kind("evaluation") if m["block"] == 0]
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    curve, matrix = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_curve(curve, log)
    low, high = min(0.0, performance.min().item()), max(1.0, performance.max().item())
    image = matrix.imshow(performance, cmap="viridis", vmin=low, vmax=high, aspect="auto")
    matrix.set_xticks(range(len(labels)), labels, rotation=30, ha="right", fontsize=7)
    matrix.set(ylabel="after block", yticks=range(len(performance)))
    matrix.set_title("Mean return on each task", fontsize=9)
    for i, row in enumerate(performance.tolist()):
        for j, value in enumerate(row):
            matrix.text(
                j,
                i,
                f"{value:.2f}",
                ha="center",
                va="center",
                color="white" if value < low + 0.6 * (high - low) else "black",
            )
    figure.colorbar(image, ax=matrix)
    figure.savefig(path, dpi=160)


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
