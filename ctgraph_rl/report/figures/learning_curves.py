"""Learning curves over seeds: mean return on each task, and return while training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ctgraph_rl.checks import NamedValues
from ctgraph_rl.log.escape import figure_text, terminal_text
from ctgraph_rl.report.figures.gallery import CaptionedFigure, left_out
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.report.sections import (
    FEWEST_FOR_BANDS,
    Point,
    Result,
    Section,
    mean_curve,
    over_seeds,
    training_curve,
)
from ctgraph_rl.report.style import MOST_AGENTS, agent_style, agents_legend, beside, frames_axis, panels, short
from ctgraph_rl.runs.read import UNIT_METRICS, histories

MOST_TASKS = 32

MANY_BLOCKS = 12

MOST_SEEDS = 20

BANDS = f"from {FEWEST_FOR_BANDS} seeds on the 95 % interval of their mean"
LabelPlaces = Sequence[tuple[float, float]]

COLUMNS = 4

MOST_EXPERIMENTS, EXPERIMENTS_BESIDE = 12, 3

MARGIN = 0.03
"""Share of the frames that an axis shows beside them."""

PLACES = 160
"""Means that a curve of the return while training has, in all blocks together."""


def learning_curves(section: Section) -> CaptionedFigure | None:
    """Return all agents' curves at evaluations, a panel for each task; None without a finished run, and of a stream."""
    if not section.finished or "life" in section.one.about:
        return None
    tasks = left_out(len(section.labels), MOST_TASKS, "tasks")
    caption = (
        f"Mean return on each task at every evaluation, over the frames learned from.{tasks} {_agents(section)} Lines: "
        f"means over seeds, where all have a value; bands: {BANDS}; thin lines: single seeds, up to {MOST_SEEDS}. "
        "Grey: blocks that train the task; dashed: ends of blocks."
    )
    labels = section.labels[:MOST_TASKS]
    width = min(max(0.5, len(labels) / beside(COLUMNS)), 1)
    grid = panels(len(labels), COLUMNS, 1.45, width, sharex=True, sharey=True)
    for task, (axes, label) in enumerate(zip(grid.ravel(), labels, strict=False)):
        _mark_blocks(axes, section, task)
        for result, look in choose_looks(section):
            seeds = [history.evaluations.get(label, []) for history in histories(result.finished)]
            points = over_seeds(seeds, result.bounds.of_task(label))
            _draw(axes, look, [points], seeds if len(seeds) <= MOST_SEEDS else [])
        axes.set_title(short(label))
    return CaptionedFigure("curves", "Learning curves", caption, _finished(grid, section, "mean return"))


def mean_curves(section: Section) -> CaptionedFigure | None:
    """Return all agents' mean return over tasks at evaluations; None without a finished run, and of a stream."""
    if not section.finished or "life" in section.one.about:
        return None
    caption = (
        f"Mean return over all {len(section.labels)} tasks at every evaluation of all of them, over the frames learned "
        f"from. {_agents(section)} Lines: means over seeds, where all have a value; bands: {BANDS}; thin lines: single "
        f"seeds, up to {MOST_SEEDS}. Dashed: ends of blocks."
    )
    grid = panels(1, 1, 2.3, room=0)
    draw_means(grid[0, 0], section, {result.agent: look for result, look in choose_looks(section)})
    figure = _finished(grid, section, "mean return over all tasks")
    return CaptionedFigure("mean", "Mean return over all tasks", caption, figure)


def training_curves(section: Section) -> CaptionedFigure | None:
    """Return all agents' return while training; None where no run measured it."""
    if not any(history.training for history in histories(section.finished)):
        return None
    caption = (
        f"Return of the episodes that were finished while training, means over equal numbers of frames. "
        f"{_agents(section)} Lines: means over seeds; bands: {BANDS}; thin lines: single seeds, of fewer. Dashed: ends "
        "of blocks."
    )
    grid = panels(1, 1, 2.3, room=0)
    [[axes]] = grid
    _mark_blocks(axes, section, None)
    blocks = list(enumerate(zip(section.ends, section.ends[1:], strict=False), 1))
    places = max(4, PLACES // max(len(blocks), 1))
    for result, look in choose_looks(section):
        pieces = _training(result, blocks, places)
        seeds = []
        for run in result.finished if len(result.finished) < FEWEST_FOR_BANDS else ():
            for piece in _training(replace(result, by_seed={run.seed: run}), blocks, places):
                seeds += [[(point.frames, point.value) for point in piece]] if piece else []
        _draw(axes, look, pieces, seeds)
    figure = _finished(grid, section, "return while training")
    return CaptionedFigure("training", "Return while training", caption, figure)


def unit_curves(section: Section) -> CaptionedFigure | None:
    """Return all agents' silent units and ranks over the life; None where no run measured units."""
    if not any(history.units for history in histories(section.finished)):
        return None
    caption = (
        f"Hidden units on 256 fresh images, as shares of all units and of the largest rank. {_agents(section)} Lines: "
        f"means over seeds; bands: {BANDS}; thin lines: single seeds, up to {MOST_SEEDS}. Dashed: ends of blocks."
    )
    grid = panels(len(UNIT_METRICS), len(UNIT_METRICS), 1.9, sharex=True, sharey=True)
    for axes, (name, title) in zip(grid.ravel(), UNIT_METRICS.items(), strict=True):
        _mark_blocks(axes, section, None)
        for result, look in choose_looks(section):
            seeds = [history.units[name] for history in histories(result.finished) if name in history.units]
            _draw(axes, look, [over_seeds(seeds, Bounds(0, 1))], seeds if len(seeds) <= MOST_SEEDS else [])
        axes.set_title(title)
    return CaptionedFigure("units", "Hidden units", caption, _finished(grid, section, "share"))


def _training(result: Result, blocks: Sequence[tuple[int, tuple[int, int]]], places: int) -> list[list[Point]]:
    curves = []
    for block, (start, end) in blocks:
        bounds = result.bounds.of_training
        curves.append(training_curve(result.finished, block, start=start, end=end, places=places, bounds=bounds))
    return curves


def draw_means(axes: Any, section: Section, looks: Mapping[str, dict[str, Any]]) -> None:
    """Draw the mean return over all tasks of a section's agents with a look."""
    _mark_blocks(axes, section, None)
    for result in section.results:
        if result.agent in looks:
            seeds = list(filter(None, map(mean_curve, histories(result.finished))))
            points = over_seeds(seeds, result.bounds.of_returns)
            _draw(axes, looks[result.agent], [points], seeds if len(seeds) <= MOST_SEEDS else [])


def experiments(found: Sequence[Section]) -> CaptionedFigure | None:
    """Return the mean returns on several curricula; None for fewer than two with a finished run."""
    measured = [section for section in found if section.finished]
    if len(measured) < 2:
        return None
    agents = left_out(len(_agents_on(measured)), MOST_AGENTS, "agents")
    cut = left_out(len(measured), MOST_EXPERIMENTS, "curricula") + agents
    caption = (
        "Mean return over all tasks of each curriculum at its evaluations, over the frames learned from. Lines: means "
        f"over seeds; bands: {BANDS}; thin lines: single seeds. Dashed: ends of blocks.{cut}"
    )
    shown = measured[:MOST_EXPERIMENTS]
    looks = {agent: agent_style(position, agent) for position, agent in enumerate(_agents_on(shown)[:MOST_AGENTS])}
    grid = panels(len(shown), EXPERIMENTS_BESIDE, 1.7, sharey=True)
    figure = grid[0, 0].figure
    for axes, section in zip(grid.ravel(), shown, strict=False):
        draw_means(axes, section, looks)
        axes.set_title(short(section.name))
        frames_axis(axes)
    for row in grid:
        row[0].set_ylabel("mean return")
    figure.supxlabel("frames", fontsize=8)
    agents_legend(figure, list(zip(map(short, looks), looks.values(), strict=True)))
    return CaptionedFigure("experiments", "All experiments", caption, figure)


def choose_looks(section: Section) -> list[tuple[Result, NamedValues]]:
    """Return the agents that figures show, each with the look of its curve."""
    shown = section.results[:MOST_AGENTS]
    return [(result, agent_style(position, result.agent)) for position, result in enumerate(shown)]


def _agents_on(found: Sequence[Section]) -> list[str]:
    agents: dict[str, None] = {}
    for section in found:
        agents |= dict.fromkeys(result.agent for result in section.results)
    return list(agents)


def _agents(section: Section) -> str:
    shown = ", ".join(f"{result.agent} (n = {result.n})" for result in section.results[:MOST_AGENTS])
    return f"Agents: {shown}.{left_out(len(section.results), MOST_AGENTS, 'agents')}"


def _mark_blocks(axes: Any, section: Section, task: int | None) -> None:
    many = len(section.ends) > MANY_BLOCKS
    for end in section.ends[1:-1]:
        axes.axvline(end, color="0.55", linestyle=(0, (3, 2)), linewidth=0.25 if many else 0.6, zorder=0)
    for start, end, tasks in zip(section.ends, section.ends[1:], section.trained, strict=False):
        if task in tasks:
            axes.axvspan(start, end, color="0.9", zorder=-1, linewidth=0)


def _draw(axes: Any, look: Mapping[str, Any], pieces: Sequence[list[Point]], seeds: Sequence[LabelPlaces]) -> None:
    if len(seeds) > 1:
        for curve in seeds:
            axes.plot(*zip(*curve, strict=True), color=look["color"], linestyle="-", linewidth=0.4, marker="", zorder=1)
    for points in pieces:
        if points:
            frames, values, lows, highs, _ = zip(*points, strict=True)
            axes.plot(frames, values, markevery=1 + len(points) // 8, zorder=3, **look)
            if lows[0] is not None:
                axes.fill_between(frames, lows, highs, color=look["color"], alpha=0.18, linewidth=0, zorder=2)


def _finished(grid: Any, section: Section, ylabel: str) -> Any:
    low = 0.0
    high = 1.0
    for axes in grid.ravel():
        frames_axis(axes)
        for line in axes.lines:
            if len(line.get_xdata()) > 2:
                heights = np.array(line.get_ydata(), dtype=float)
                low = np.nanmin(heights, initial=low)
                high = np.nanmax(heights, initial=high)
    room = 0.05 * (high - low)
    last = max(section.ends[-1], 1)
    x = -MARGIN * last, (1 + MARGIN) * last  # room for marks at the ends
    grid[0, 0].set(xlim=x, ylim=(low - room, high + room))
    for row in grid:
        row[0].set_ylabel(ylabel)
    figure = grid[0, 0].figure
    figure.supxlabel("frames", fontsize=8)
    agents_legend(figure, [(named(result), look) for result, look in choose_looks(section)])
    return figure


def named(result: Result) -> str:
    """Return an agent's name in a legend, with its number of seeds."""
    agent = terminal_text(result.agent)
    return figure_text(f"{agent if len(agent) <= 60 else agent[:59] + '…'} (n = {result.n})")
