"""A stream by windows of its tasks: return, regret, tasks solved, and retention over lag."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import Any

import numpy as np

from ctgraph_rl.report.bounds_of_runs import curriculum_of
from ctgraph_rl.report.figures.gallery import CaptionedFigure, left_out
from ctgraph_rl.report.figures.learning_curves import choose_looks, named
from ctgraph_rl.report.sections import Section
from ctgraph_rl.report.style import MOST_AGENTS, agents_legend, panels
from ctgraph_rl.runs.read import histories
from ctgraph_rl.tasks.curriculum import LAGS, Stream
from ctgraph_rl.tasks.gain import reached_by_policies

GREY = {"color": "0.55", "linewidth": 0.8}

LINES = {"optimal": "-", "search": "-.", "memoryless": "--", "random": ":"}

PANELS = {
    "window_return": "return at the block's end",
    "window_solved": "share of tasks solved",
    "frame_regret": "regret per frame",
}


def life_windows(section: Section) -> CaptionedFigure | None:
    """Return all agents' means over windows of a stream; None for other curricula, and without a finished run."""
    if not section.finished or "life" not in section.one.about:
        return None
    shown = choose_looks(section)
    frames = section.one.about["num_frames"] / section.one.about["life"]
    policies = _reached(curriculum_of(section.one))
    caption = (
        "Means over windows of successive tasks; retention is the share of a task's return, from failure to optimum, "
        "that is left a number of blocks later. Lines: means over seeds, where all have a value; dots: seeds. Grey: "
        "what policies without learning reach and lose, in closed form; each block starts a new search."
        f"{left_out(len(section.results), MOST_AGENTS, 'agents')}"
    )
    grid = panels(len(PANELS) + 1, 2, 2.2)
    *of_windows, last = grid.ravel()[: len(PANELS) + 1]
    for axes, (metric, title) in zip(of_windows, PANELS.items(), strict=True):
        for result, look in shown:
            ends = next((history.ends for history in histories(result.finished)), ())
            rows: list[Any] = [run.windows(metric) for run in result.finished]
            if metric == "frame_regret":
                rows = [np.divide(row, np.diff(ends)) for row in rows]
            _draw(axes, np.divide(ends[1:], frames), rows, look)
        for name, values in policies.items():
            if metric in values:
                axes.axhline(values[metric], zorder=0, **GREY, linestyle=LINES[name])
        axes.set(xlabel="tasks so far", ylabel=title)
    of_windows[1].set_ylim(-0.05, 1.05)
    for result, look in shown:
        kept = [[run.metrics.get(f"retention_{lag}", {}).get("value") for lag in LAGS] for run in result.finished]
        _draw(last, LAGS, np.array(kept, np.float64).tolist(), look)
    last.set(xlabel="blocks later", xscale="log", ylabel="retention")
    last.set_xticks(LAGS, [str(lag) for lag in LAGS])
    last.minorticks_off()
    figure = grid[0, 0].figure
    looks = [(named(result), look) for result, look in shown]
    agents_legend(figure, [*looks, *((name, {**GREY, "linestyle": LINES[name]}) for name in policies)])
    return CaptionedFigure("life", "A life by windows", caption, figure)


def _reached(stream: Any) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = {}
    if not isinstance(stream, Stream):
        return found
    frames = stream.blocks.num_frames
    of_tasks = [reached_by_policies(task, frames, int(stream.protocol.hides_episodes)) for task in stream.examples]
    for name in LINES:
        if all(name in reached for reached in of_tasks):
            at_end = fmean(reached[name].at_end for reached in of_tasks)
            lost = fmean(reached[name].in_frames for reached in of_tasks)
            found[name] = {"window_return": at_end, "frame_regret": lost / frames}
    return found


def _draw(axes: Any, places: Any, rows: Sequence[Any], look: dict[str, Any]) -> None:
    if rows:
        for row in rows:
            axes.plot(places, row, color=look["color"], linestyle="", marker=".", markersize=2)
        axes.plot(places, np.mean(rows, axis=0), **look)
