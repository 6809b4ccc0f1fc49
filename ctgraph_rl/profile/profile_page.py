"""The page of a profile: a table, a radar with bars beside it, the same numbers as CSV and in LaTeX, and gaps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ctgraph_rl.disk import made_folder, write_whole
from ctgraph_rl.log.escape import csv_text, markdown_text
from ctgraph_rl.profile.scoring import Profiles, Score, profile_scores
from ctgraph_rl.report.figures.gallery import CaptionedFigure, Gallery, left_out
from ctgraph_rl.report.latex import PREAMBLE, Table, TableCell, latex
from ctgraph_rl.report.style import MOST_AGENTS, WIDTH, agent_style, new_figure, require_packages, short

MEANING = (
    "A score is 0 at the floor of an agent without the property and 1 at the optimum. Intervals are at 95 % over "
    "seeds. A dash is a gap: the agent was not measured there, which is no 0."
)

COLUMNS = ("agent", "property", "score", "low", "high", "n", "reason")


def write_profile(paths: Sequence[Path | str], folder: Path | str, agents: Sequence[str] = ()) -> Profiles:
    """Write ``profile.md`` with its figure, ``profile.csv`` and ``profile.tex``, and return the scores.

    Args:
        paths: see `profile_scores`.
        folder: where the page goes.
        agents: see `profile_scores`.

    Raises:
        ModuleNotFoundError: before any work, without what the extra ``report`` installs.
        ValueError: see `profile_scores`.
    """
    require_packages()
    scores = profile_scores(paths, agents)
    folder = made_folder(Path(folder))
    rows = [
        [agent, title, each.value, each.low, each.high, each.n, each.reason]
        for agent, of_agent in scores.items()
        for title, each in of_agent.items()
    ]
    write_whole(folder / "profile.csv", csv_text([COLUMNS, *rows]))
    cells = [(agent, [_cell(each) for each in of_agent.values()]) for agent, of_agent in scores.items()]
    titles = list(next(iter(scores.values())))
    table = Table(f"Profile. {MEANING}", "profile", "agent", titles, cells)
    write_whole(folder / "profile.tex", f"{PREAMBLE}\n\n{latex(table)}\n")
    caption = f"{MEANING}{left_out(len(scores), MOST_AGENTS, 'agents')}"
    figures = (CaptionedFigure("profile", "Profile", caption, _draw(each, titles)) for each in [scores])
    drawn = Gallery(folder).write((), figures)  # which draws them in the report's style
    images = [f"![{each.alt}]({each.path})\n\n{each.caption}" for each in drawn]
    page = ["# Profile", *images, _markdown(scores, titles), *_gaps(scores)]
    write_whole(folder / "profile.md", "\n\n".join(page) + "\n")
    return scores


def text_table(scores: Profiles) -> str:
    """Return the scores for a terminal, a line for each agent and property."""
    wide = max(len(title) for of_agent in scores.values() for title in of_agent)
    lines = []
    for agent, of_agent in scores.items():
        lines.append(agent)
        lines += [f"  {title:{wide}}  {each}{_why(each)}" for title, each in of_agent.items()]
    return "\n".join(lines)


def _why(score: Score) -> str:
    return f"  ({score.reason})" if score.reason else ""


def _cell(score: Score) -> TableCell:
    value, _, interval = str(score).partition(" ")
    return TableCell(value, interval)


def _markdown(scores: Profiles, titles: Sequence[str]) -> str:
    head = ["| property | " + " | ".join(map(markdown_text, scores)) + " |", "|---" * (1 + len(scores)) + "|"]
    rows = [[title, *(str(of_agent[title]) for of_agent in scores.values())] for title in titles]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([*head, *lines])


def _gaps(scores: Profiles) -> Iterator[str]:
    for agent, of_agent in scores.items():
        for title, each in of_agent.items():
            if each.reason:
                yield markdown_text(f"{agent}, {title}: {each.reason}")


def _draw(scores: Profiles, titles: Sequence[str]) -> Any:
    """Draw a radar, and bars with intervals in the order of the paper; a gap has neither corner nor bar."""
    figure = new_figure(WIDTH, 0.5 * WIDTH)
    left, right = figure.add_gridspec(1, 2)
    radar = figure.add_subplot(left, projection="polar")
    bars = figure.add_subplot(right)
    numbers = list(range(1, len(titles) + 1))
    angles = [2 * math.pi * (number - 1) / len(titles) for number in numbers]
    shown = list(scores.items())[:MOST_AGENTS]
    for position, (agent, of_agent) in enumerate(shown):
        look = agent_style(position, agent)
        values = [math.nan if each.value is None else each.value for each in of_agent.values()]
        radar.plot([*angles, angles[0]], [*values, values[0]], markersize=3, label=short(agent), **look)
        _draw_bars(bars, list(of_agent.values()), look["color"], position, count=len(shown))
    radar.set_theta_zero_location("N")
    radar.set_theta_direction(-1)
    radar.set_xticks(angles, list(map(str, numbers)))
    radar.set_rgrids((0.5, 1.0), angle=18, fontsize=6)
    radar.set_ylim(0, 1)
    bars.set_yticks(numbers, [f"{number} {title}" for number, title in zip(numbers, titles, strict=True)])
    bars.set(xlim=(0, 1), xlabel="score", ylim=(len(titles) + 0.5, 0.5))
    figure.legend(loc="outside upper center", ncols=3)
    return figure


def _draw_bars(axes: Any, scores: Sequence[Score], colour: str, position: int, count: int) -> None:
    """Draw the scores of an agent, one of ``count`` bars beside each other for each property."""
    height = 0.8 / count
    for number, each in enumerate(scores, 1):
        place = number + (position + 0.5) * height - 0.4
        if each.value is None:
            axes.text(0.01, place, "no value", va="center", fontsize=5, color=colour)
            continue
        axes.barh(place, each.value, height, color=colour)
        if each.low is not None and each.high is not None:
            axes.plot([each.low, each.high], [place, place], color="black", linewidth=0.8)
