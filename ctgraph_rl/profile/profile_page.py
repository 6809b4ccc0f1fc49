"""The page of a profile: tables, bars with intervals, and gaps, also as CSV and LaTeX."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctgraph_rl.disk import make_folder, write_whole
from ctgraph_rl.log.escape import csv_text, markdown_table, markdown_text
from ctgraph_rl.log.files import locked
from ctgraph_rl.profile.scoring import Profiles, profile_scores
from ctgraph_rl.report.figures.gallery import CaptionedFigure, Gallery, left_out
from ctgraph_rl.report.latex import Table, as_cell, document
from ctgraph_rl.report.style import MOST_AGENTS, WIDTH, agent_style, new_figure, require_packages, short
from ctgraph_rl.runs.read import Problem, Run

MEANING = (
    "A score is 0 at the floor of an agent without the property and 1 at the optimum. Intervals are at 95 % over all "
    "seeds; one seed has none. A dash is a gap: the agent was not measured there, which is no 0."
)

COLUMNS = ("agent", "property", "score", "low", "high", "n", "reason", "measured", "floor", "optimum", "controls")


def write_profile(
    runs: Sequence[Run], problems: Sequence[Problem], folder: Path, agents: Sequence[str] = ()
) -> Profiles:
    """Write ``profile.md`` with its figure, ``profile.csv`` and ``profile.tex``; return `profile_scores`.

    Raises:
        ModuleNotFoundError: before any work, without what the extra ``report`` installs.
        ValueError: if there is no run of a profile curriculum.
        BlockingIOError: if another process writes into the folder.
    """
    require_packages()
    scores = profile_scores(runs, problems, agents)
    titles = list(next(iter(scores.values())))
    rows: list[Sequence[Any]] = [COLUMNS]
    cells = []
    gaps = []
    for agent, of_agent in scores.items():
        cells.append((agent, [as_cell(str(score)) for score in of_agent.values()]))
        for title, each in of_agent.items():
            rows.append((agent, title, *each))
            if each.reason:
                gaps.append(markdown_text(f"{agent}, {title}: {each.reason}"))
    head = ["property", *map(markdown_text, scores)]
    shown = [[title, *(str(of_agent[title]) for of_agent in scores.values())] for title in titles]
    measured = [[title, *(of_agent[title].absolute for of_agent in scores.values())] for title in titles]
    table = Table(f"Profile. {MEANING}", "profile", "agent", titles, cells)
    with locked(make_folder(folder)):
        write_whole(folder / "profile.csv", csv_text(rows))
        write_whole(folder / "profile.tex", document([table]) + "\n")
        [drawn] = Gallery(folder).write((), _figures(scores))  # which draws them in the report's style
        page = ["# Profile", f"![{drawn.alt}]({drawn.path})", drawn.caption, markdown_table(head, shown)]
        page += ["## What was measured", markdown_table(head, measured), *gaps]
        write_whole(folder / "profile.md", "\n\n".join(page) + "\n")
    return scores


def text_table(scores: Profiles) -> str:
    """Return the scores for a terminal, a line for each agent and property."""
    lines = []
    for agent, of_agent in scores.items():
        lines.append(agent)
        for title, each in of_agent.items():
            why = f"  ({each.reason})" if each.reason else ""
            lines.append(f"  {title:16}  {each!s:17}  {each.absolute}{why}")
    return "\n".join(lines)


def _figures(scores: Profiles) -> Iterator[CaptionedFigure]:
    caption = f"{MEANING}{left_out(len(scores), MOST_AGENTS, 'agents')}"
    yield CaptionedFigure("profile", "Profile", caption, draw_profiles(scores))


def draw_profiles(scores: Profiles) -> Any:
    """Return a figure of bars with intervals, in the paper's order and the present style; a gap has no bar."""
    shown = list(scores.items())[:MOST_AGENTS]
    titles = list(shown[0][1])
    figure = new_figure(WIDTH, 0.25 * WIDTH + 0.1 * WIDTH * len(shown))
    bars = figure.add_subplot()
    numbers = np.arange(1, len(titles) + 1)
    height = 0.8 / len(shown)
    for position, (agent, of_agent) in enumerate(shown):
        look = agent_style(position, agent)
        found = np.array([each[:3] for each in of_agent.values()], dtype=float)  # None is not a number
        values = found[:, 0]
        lows = found[:, 1]
        highs = found[:, 2]
        places = numbers + (position + 0.5) * height - 0.4
        bars.barh(places, values, height, color=look["color"], label=short(agent))
        bars.hlines(places, lows, highs, color="black", linewidth=0.8)
        for place in places[np.isnan(values)]:
            bars.text(0.01, place, "no value", va="center", fontsize=5, color=look["color"])
    bars.set_yticks(numbers, [f"{number} {title}" for number, title in enumerate(titles, 1)])
    bars.set(xlim=(0, 1), xlabel="score", ylim=(len(titles) + 0.5, 0.5))
    figure.legend(loc="outside upper center", ncols=4)
    return figure
