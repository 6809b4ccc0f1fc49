"""Profiles of four agents on the paper's learning properties: profile.csv from runs, and profile.md from it."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from string import Template

import curricula
from ctgraph_rl.profile.properties import Measured
from ctgraph_rl.profile.scoring import Results, Score, score_of_results
from curricula.profile import PROPERTIES, Property
from studies.raw import HERE, TEMPLATES, Raw, groups, machines, read, table

NAME = "profile"
PAGE = HERE / "profile.md"
PICTURE = HERE / "profile.png"

AGENTS = {"ppo": "PPO", "lstm_ppo": "LSTM-PPO", "dqn": "DQN", "rl2": "RL^2"}
"""Agents in the order of tables."""


FRESH = "fresh"
"""Name of the lines with the frames after which a fresh copy solves the last block of the lives."""


def make() -> None:
    """Write the page and draw its figure."""
    PAGE.write_text(page(), encoding="utf-8")
    draw()


def raw() -> Raw:
    """Return the lines of seeds and gaps."""
    return [line for line in read(NAME) if line["property"] != FRESH]


def scores(lines: Raw | None = None) -> dict[str, dict[str, Score]]:
    """Return the scores by agent and property, in the order of tables."""
    found: dict[str, dict[str, Score]] = {agent: {} for agent in AGENTS}
    by_agent = groups(raw() if lines is None else lines, "agent", "property")
    for prop in properties():
        for agent in AGENTS:
            of = by_agent.get((agent, prop.title), [])
            seeds = {}
            for line in of:
                if line["value"]:
                    floors = tuple(map(float, line["floors"].split()))
                    own = (float(line["value"]), floors, float(line["optimum"]), float(line["highest"]))
                    seeds[int(line["seed"])] = Measured(*own, exact=not prop.controls)
            reason = of[0]["reason"] if of else "there is no run"
            found[agent][prop.title] = score_of_results(Results(seeds, reason, prop.controls))
    return {agent: by_title for agent, by_title in found.items() if (agent,) in groups(read(NAME), "agent")}


def properties() -> list[Property]:
    """Return the properties in the order of the paper."""
    return list(PROPERTIES.values())


def fresh_frames(agent: str) -> list[float]:
    """Return the frames after which fresh copies of an agent reach all goals of the lives' last block."""
    lines = [line for line in read(NAME) if line["property"] == FRESH and line["agent"] == agent]
    return [float(line["value"] or "inf") for line in lines]


def last_block() -> int:
    """Return the frames of the lives' last block."""
    return curricula.load("profile_fresh").num_frames


def above_floor(found: dict[str, dict[str, Score]], certain: bool) -> dict[str, list[str]]:
    """Return for each agent the properties with a score above 0: of the interval's lower end, or of the value."""
    named: dict[str, list[str]] = {}
    for agent, by_title in found.items():
        named[agent] = []
        for title, score in by_title.items():
            end = score.low if certain else score.value
            if end:
                named[agent].append(title)
    return named


def verdicts(found: dict[str, dict[str, Score]]) -> str:
    """Return a sentence for each agent: where its interval is above the floor, and where only its mean is."""
    certain = above_floor(found, True)
    mean = above_floor(found, False)
    lines = []
    for agent in found:
        seeds = max((score.n for score in found[agent].values()), default=0)
        only = [title for title in mean[agent] if title not in certain[agent]]
        line = f"- **{AGENTS[agent]}** ({seeds} seeds) is above the floor in {_listed(certain[agent])}."
        if only:
            line += f" Its mean, but not its interval, is above the floor in {_listed(only)}."
        lines.append(line)
    return "\n".join(lines)


def _listed(titles: Sequence[str]) -> str:
    return ", ".join(titles) if titles else "no property"


def four_times() -> str:
    """Return whether the last block of lives has four times the frames that a fresh PPO needs in the median."""
    needed = median(fresh_frames("ppo"))
    block = last_block()
    enough = "at least" if block >= 4 * needed else "less than"
    fresh = f"A fresh PPO reaches both goals of this block after {needed:,.0f} frames in the median"
    return f"{fresh}; the block has {block:,} frames, {enough} four times as many."


def page() -> str:
    """Return the page, made from the raw results and its template."""
    found = scores()
    rows = []
    absolute = []
    for prop in properties():
        rows.append([prop.title, *(str(by_title[prop.title]) for by_title in found.values())])
        absolute.append(measured(prop.title, [by_title[prop.title].absolute for by_title in found.values()]))
    head = ["property", *(AGENTS[agent] for agent in found)]
    gaps: dict[tuple[str, str], list[str]] = {}
    for agent, by_title in found.items():
        for title, score in by_title.items():
            if score.reason:
                gaps.setdefault((title, score.reason), []).append(AGENTS[agent])
    lines = []
    for (title, reason), agents in gaps.items():
        lines.append(f"- {title}: no score for {', '.join(agents)}. Reason: {reason}.")
    template = Template((TEMPLATES / "profile.md").read_text(encoding="utf-8"))
    return template.substitute(
        verdicts=verdicts(found),
        scores=table(head, rows),
        absolute=table(head, absolute),
        four_times=four_times(),
        gaps="\n".join(lines),
        machines=machines(NAME),
    )


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


def draw() -> None:
    """Draw the scores as bars with intervals."""
    from ctgraph_rl.draw.style import save_figure
    from ctgraph_rl.profile.profile_page import draw_profiles
    from ctgraph_rl.report.style import style

    with style():
        save_figure(draw_profiles({AGENTS[agent]: by_title for agent, by_title in scores().items()}), PICTURE)
