"""Parts of figures that several studies have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from ctgraph_rl.report.style import ink


def draw_grid(
    axes: Any,
    values: Sequence[Sequence[float]],
    form: str,
    rows: Sequence[str],
    columns: Sequence[str],
    colours: str = "viridis",
    most: float = 1.0,
) -> None:
    """Draw numbers on colours from 0 on.

    Args:
        values: by row and column.
        form: of a number, such as ``{:.2f}``.
        rows: names.
        columns: names.
        colours: a colour map of matplotlib.
        most: the value of the last colour.
    """
    image = axes.imshow(values, vmin=0, vmax=most, cmap=colours, aspect="auto")
    for row, of_row in enumerate(values):
        for column, value in enumerate(of_row):
            colour = ink(image.to_rgba(value)[:3])
            axes.text(column, row, form.format(value), ha="center", va="center", fontsize=7, color=colour)
    axes.set_xticks(range(len(columns)), columns, fontsize=7)
    axes.set_yticks(range(len(rows)), rows, fontsize=7)
    axes.tick_params(length=0)


def draw_seeds(axes: Any, seeds: Mapping[str, Sequence[float]]) -> None:
    """Draw a row for each name: a dot for each seed and a bar for their mean, within [0, 1]."""
    for row, values in enumerate(seeds.values()):
        rows = [row + 0.6 * (seed / (len(values) - 1) - 0.5) for seed in range(len(values))]
        axes.plot(values, rows, "o", color="0.35", markersize=3, markerfacecolor="none", markeredgewidth=0.6)
        axes.plot(fmean(values), row, "|", color="0", markersize=9, markeredgewidth=1.6)
    axes.set(xlim=(-0.05, 1.05), ylim=(len(seeds) - 0.4, -0.6))
    axes.set_xticks([0, 0.5, 1], ["0", "0.5", "1"], fontsize=7)
    axes.set_yticks(range(len(seeds)), seeds, fontsize=7)
