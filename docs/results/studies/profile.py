"""Profiles of four agents on the paper's learning properties: profile.csv from runs, and profile.md from it."""

from __future__ import annotations

from pathlib import Path
from statistics import median

import curricula
from ctgraph_rl.draw.style import save_figure
from ctgraph_rl.profile.profile_page import draw_profiles
from ctgraph_rl.profile.properties import Measured
from ctgraph_rl.profile.scoring import Score, score_of
from ctgraph_rl.report.style import style
from curricula.profile import PROPERTIES
from studies.raw import Raw, fill, groups, machines, read, select, table

NAME = "profile"

AGENTS = {"ppo": "PPO", "lstm_ppo": "LSTM-PPO", "dqn": "DQN", "rl2": "RL^2"}
"""Agents in the order of tables."""


FRESH = "fresh"
"""Name of the lines with the frames after which a fresh copy solves the last block of the lives."""


def raw() -> Raw:
    """Return the lines of seeds and gaps."""
    return [line for line in read(NAME) if line["property"] != FRESH]


def scores(lines: Raw | None = None) -> dict[str, dict[str, Score]]:
    """Return the scores by agent and property, in the order of tables."""
    by_agent = groups(raw() if lines is None else lines, "agent", "property")
    found: dict[str, dict[str, Score]] = {}
    for agent in AGENTS:
        found[agent] = {}
        for prop in PROPERTIES.values():
            of = by_agent[agent, prop.title]
            seeds = []
            for line in of:
                if line["value"]:
                    floors = tuple(map(float, line["floors"].split()))
                    own = (float(line["value"]), floors, float(line["optimum"]), float(line["highest"]))
                    seeds.append(Measured(*own, exact=not prop.controls))
            found[agent][prop.title] = score_of(seeds, prop.controls, of[0]["reason"])
    return found


def fresh_frames(agent: str) -> list[float]:
    """Return the frames after which fresh copies of an agent reach all goals of the lives' last block."""
    return [float(line["value"] or "inf") for line in select(read(NAME), property=FRESH, agent=agent)]


def above_floor(found: dict[str, dict[str, Score]], certain: bool) -> dict[str, list[str]]:
    """Return for each agent the properties with a score above 0: of the interval's lower end, or of the value."""
    named = {}
    for agent, by_title in found.items():
        named[agent] = [title for title, score in by_title.items() if (score.low if certain else score.value)]
    return named


def verdicts(found: dict[str, dict[str, Score]]) -> str:
    """Return a sentence for each agent: where its interval is above the floor, and where only its mean is."""
    certain = above_floor(found, True)
    mean = above_floor(found, False)
    lines = []
    for agent in found:
        seeds = max(score.n for score in found[agent].values())
        only = [title for title in mean[agent] if title not in certain[agent]]
        named = ", ".join(certain[agent]) or "no property"
        line = f"- **{AGENTS[agent]}** ({seeds} seeds) is above the floor in {named}."
        if only:
            line += f" Its mean, but not its interval, is above the floor in {', '.join(only)}."
        lines.append(line)
    return "\n".join(lines)


def four_times() -> str:
    """Return whether the last block of lives has four times the frames that a fresh PPO needs in the median."""
    needed = median(fresh_frames("ppo"))
    block = curricula.load("profile_fresh").num_frames
    enough = "at least" if block >= 4 * needed else "less than"
    fresh = f"A fresh PPO reaches both goals of this block after {needed:,.0f} frames in the median"
    return f"{fresh}; the block has {block:,} frames, {enough} four times as many."


def page() -> str:
    """Return the page."""
    found = scores()
    rows = []
    absolute = []
    gaps = []
    for prop in PROPERTIES.values():
        of_agents = {AGENTS[agent]: by_title[prop.title] for agent, by_title in found.items()}
        rows.append([prop.title, *map(str, of_agents.values())])
        absolute.append(measured(prop.title, [score.absolute for score in of_agents.values()]))
        for reason in dict.fromkeys(score.reason for score in of_agents.values() if score.reason):
            agents = ", ".join(agent for agent, score in of_agents.items() if score.reason == reason)
            gaps.append(f"- {prop.title}: no score for {agents}. Reason: {reason}.")
    head = ["property", *AGENTS.values()]
    texts = {
        "verdicts": verdicts(found),
        "scores": table(head, rows),
        "absolute": table(head, absolute),
        "four_times": four_times(),
        "gaps": "\n".join(gaps),
        "machines": machines(NAME),
    }
    return fill(NAME, texts)


def measured(title: str, cells: list[str]) -> list[str]:
    """Return a row of values; floor and optimum stand with the title where they are the same for all agents."""
    values = []
    others = set()
    for cell in cells:
        value, _, other = cell.partition(", ")
        values.append(value)
        others.add(other)
    if len(others) > 1 or others == {""}:
        return [title, *cells]
    return [f"{title}, {others.pop()}", *values]


def draw(folder: Path) -> None:
    """Draw the scores as bars with intervals."""
    with style():
        figure = draw_profiles({AGENTS[agent]: by_title for agent, by_title in scores().items()})
        save_figure(figure, folder / "profile.png")
