"""The figures of memory.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from studies.memory import ladder
from studies.memory.conditions import GIVEN, columns
from studies.memory.graphs import ceiling
from studies.memory.runs import AGENTS, LADDER_CELLS, SEEDS, returns, solved
from studies.raw import Raw

DPI = 220


def draw_returns(path: Path) -> None:
    """Draw the greedy return of every seed with first rewards given: a row of panels for each p."""
    from ctgraph_rl.draw.style import new_figure, save_figure

    figure = new_figure(7.2, 7.4)
    panels = figure.subplots(3, 4, sharex=True, sharey=True)
    for axes in panels[0, 1:]:
        axes.set_axis_off()
    shown = [panels[0, 0], *panels[1:].flat]
    for axes, (condition, of) in zip(shown, columns(GIVEN).items(), strict=True):
        _panel(axes, of)
        axes.set_title(f"p = {condition.wait_prob}\n{condition.graph}".replace("images, ", "images,\n"), fontsize=7)
    for axes in panels[:, 0]:
        axes.set_yticks(range(len(AGENTS)), list(AGENTS.values()), fontsize=6)
    for axes in [panels[0, 0], *panels[2]]:
        axes.set_xlabel("greedy return", fontsize=7)
        axes.tick_params(labelbottom=True)
    key = panels[0, 1].legend(*panels[0, 0].get_legend_handles_labels(), fontsize=7, loc="upper left", frameon=False)
    key.set_in_layout(False)  # so that it may reach into the empty panels beside it
    save_figure(figure, path, DPI)


def _panel(axes: Any, of: Mapping[str, Raw]) -> None:
    """Draw a row of seeds, their mean and the number that solves the task for each agent."""
    level = ceiling(of)
    if level < 1:
        axes.axvline(level, color="0.55", linewidth=0.8, linestyle="--", label="best policy without memory")
    for place, name in enumerate(AGENTS):
        values = returns(of.get(name, []))
        if not values:
            axes.text(0.5, place, "not run", ha="center", va="center", fontsize=5, color="0.4")
            continue
        shifts = [place + 0.6 * (seed / (SEEDS - 1) - 0.5) for seed in range(len(values))]
        axes.plot(
            values,
            shifts,
            "o",
            markersize=3,
            markeredgecolor="0.35",
            markerfacecolor="none",
            markeredgewidth=0.6,
            label="a seed" if place == 0 else None,
        )
        centre = sum(values) / len(values)
        axes.plot(centre, place, "|", color="0", ms=9, mew=1.6, label="mean" if place == 0 else None)
        number = sum(solved(of[name]))
        axes.text(1.17, place, str(number), ha="center", va="center", fontsize=6, color="0" if number else "0.6")
    axes.set(xlim=(-0.08, 1.26), ylim=(len(AGENTS) - 0.4, -0.6))
    axes.set_xticks([0, 0.5, 1])
    axes.tick_params(labelsize=6, length=2)


def draw_ladder(path: Path) -> None:
    """Draw how many seeds solve each rung of the ladder, a panel for each depth."""
    from ctgraph_rl.draw.style import new_figure, save_figure

    of = ladder.finished()
    figure = new_figure(7.2, 0.9 + 0.24 * len(LADDER_CELLS))
    panels = figure.subplots(1, 3, sharey=True)
    for axes, depth in zip(panels, "234", strict=True):
        lengths = [length for each, length in ladder.RUNGS if each == depth]
        for row, name in enumerate(LADDER_CELLS):
            for column, length in enumerate(lengths):
                _square(axes, (column, row), of.get((depth, length), {}).get(name))
        axes.set(xlim=(-0.5, len(lengths) - 0.5), ylim=(len(LADDER_CELLS) - 0.5, -0.5))
        axes.set_title(f"depth {depth}", fontsize=8)
        axes.set_xticks(range(len(lengths)), lengths, fontsize=7)
        axes.set_xlabel("expected episode length (steps)", fontsize=7)
        axes.tick_params(length=0)
    panels[0].set_yticks(range(len(LADDER_CELLS)), [AGENTS[name] for name in LADDER_CELLS], fontsize=7)
    save_figure(figure, path, DPI)


def _square(axes: Any, place: tuple[int, int], lines: Raw | None) -> None:
    """Draw the number of seeds that solve a rung on a grey that darkens with it; hatched where it was not run."""
    column, row = place
    left_right = [column - 0.48, column + 0.48]
    if not lines:
        axes.fill_between(left_right, row - 0.46, row + 0.46, facecolor="1", edgecolor="0.7", hatch="////", linewidth=0)
        return
    number = sum(solved(lines))
    share = number / len(lines)
    axes.fill_between(left_right, row - 0.46, row + 0.46, color=str(1 - 0.8 * share), linewidth=0)
    axes.text(column, row, str(number), ha="center", va="center", fontsize=7, color="1" if share > 0.6 else "0")
