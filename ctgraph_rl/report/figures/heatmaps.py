"""Heat maps of an agent: its performance matrix, and what each block changed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ctgraph_rl.report.figures.gallery import INTERVAL, CaptionedFigure
from ctgraph_rl.report.figures.trees import Trees
from ctgraph_rl.report.sections import Estimates, Result, Section
from ctgraph_rl.report.style import beside, figure_width, ink, new_figure, short

MOST_NUMBERS = 10

MOST_INTERVALS = 5

MOST_NAMES = 32

NEGATIVE = -0.05
"""Share of the scale from which a cell without number is marked as negative."""

NO_VALUE = (0.85, 0.85, 0.85)


def transfer_maps(section: Section, result: Result, trees: Trees) -> CaptionedFigure | None:
    """Return an agent's performance matrix and what each block changed; None for a stream."""
    if "life" in section.one.about:
        return None
    count = len(section.labels)
    marks = "" if count <= MOST_NUMBERS else " A dash marks losses."
    intervals = f" In brackets: {INTERVAL}." if count <= MOST_INTERVALS else ""
    if count <= MOST_NAMES:
        intervals += " The tables below have all intervals, and n where a cell has fewer seeds."
    caption = (
        f"{result.agent}, means over n = {result.n} seeds. One map: mean return on each task after each block, block 0 "
        "before any training. The other: what each block's training did to each task, the difference of two successive "
        f"rows; purple is gain, orange is loss.{marks}{intervals} Framed: the tasks "
        "that the block trains. Grey: not evaluated."
    )
    title = f"{result.agent}: performance and transfer"
    return CaptionedFigure("transfer", title, caption, draw_matrices(section, result))


def draw_matrices(section: Section, result: Result) -> Any:
    """Performance and transfer side by side, or below each other for many tasks."""
    performance = result.performance()
    transfer = result.transfer()
    tasks = len(performance[0])
    rows = len(performance)
    few = tasks <= MOST_NUMBERS
    height = min(1.3 + 0.34 * rows, 6.0) if few else min(1.2 + 0.22 * rows, 6.5)
    if few and beside(2) == 2:
        left, right = new_figure(figure_width(), height).subplots(1, 2)
    else:
        left, right = new_figure(figure_width(), 2 * height).subplots(2, 1)
    draw_performance(left, performance, section.labels, section.trained)
    draw_transfer(right, transfer, section.labels, section.trained)
    return left.figure


def draw_performance(axes: Any, matrix: Estimates, labels: Sequence[str], trained: Sequence[Sequence[int]]) -> None:
    """The performance matrix on a scale from 0, or the lowest value, to 1, or the highest; row 0 is untrained."""
    values = _values(matrix)
    scale = (np.nanmin(values, initial=0.0), np.nanmax(values, initial=1.0))
    _draw(axes, matrix, "viridis", scale, labels)
    _box(axes, trained, 1)
    axes.set(ylabel="after block", title="mean return on each task")


def draw_transfer(axes: Any, matrix: Estimates, labels: Sequence[str], trained: Sequence[Sequence[int]]) -> None:
    """Changes of return, centred on zero; without numbers a dash marks losses for grey prints."""
    values = _values(matrix)
    largest = np.nanmax(abs(values), initial=0.0) or 1.0
    _draw(axes, matrix, "PuOr", (-largest, largest), labels, first=1)
    if len(labels) > MOST_NUMBERS:
        blocks, tasks = np.nonzero(values < NEGATIVE * largest)
        axes.plot(tasks, blocks, marker="_", linestyle="", color="black")
    _box(axes, trained, 0)
    axes.set(ylabel="training in block", title="change of return by the block's training")


def _values(matrix: Estimates) -> np.ndarray:
    return np.array([[cell.value for cell in row] for row in matrix], dtype=np.float64, ndmin=2)


def _draw(
    axes: Any,
    matrix: Estimates,
    colours: str,
    scale: tuple[float, float],
    labels: Sequence[str],
    first: int = 0,
) -> None:
    axes.set_facecolor(NO_VALUE)
    values = _values(matrix)
    cells = values if values.size else [[math.nan]]
    image = axes.imshow(cells, cmap=colours, vmin=scale[0], vmax=scale[1], aspect="auto", interpolation="none")
    axes.figure.colorbar(image, ax=axes, shrink=0.9, pad=0.02)
    axes.spines[:].set_visible(False)
    if len(labels) <= MOST_NAMES:
        upright = 90 if len(labels) > MOST_NUMBERS else 30
        side = "center" if upright == 90 else "right"
        axes.set_xticks(range(len(labels)), map(short, labels), rotation=upright, ha=side, rotation_mode="default")
    else:
        axes.set_xlabel("task, counted from 0")
    step = 1 + len(matrix) // 20
    axes.set_yticks(range(0, len(matrix), step), range(first, first + len(matrix), step))
    axes.tick_params(length=0)
    tasks = len(matrix[0]) if matrix else 0
    for i, row in enumerate(matrix if tasks <= MOST_NUMBERS else ()):
        for j, cell in enumerate(row):
            colour = ink(NO_VALUE if cell.value is None else image.to_rgba(cell.value)[:3])
            sign = "+" if first else ""
            words = "-" if cell.value is None else f"{cell.value:{sign}.2f}" if cell.value else "0"
            if cell.low is not None and cell.high is not None and tasks <= MOST_INTERVALS:
                words += f"\n[{cell.low:.2f}, {cell.high:.2f}]"
            axes.text(j, i, words, ha="center", va="center", color=colour, fontsize=7 if "\n" not in words else 6)


def _box(axes: Any, trained: Sequence[Sequence[int]], first: int) -> None:
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.6, foreground="white")]
    for row, tasks in enumerate(trained, first):
        for task in tasks:
            corner = task - 0.5, row - 0.5
            axes.add_patch(Rectangle(corner, 1, 1, fill=False, linewidth=1.2, clip_on=False, path_effects=halo))
