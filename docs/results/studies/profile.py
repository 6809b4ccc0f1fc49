"""Profiles of four agents on the paper's learning properties: profile.csv from runs, and profile.md from it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from string import Template
from typing import TYPE_CHECKING, Any

from studies.raw import HERE, TEMPLATES, Raw, groups, machine_of, machines, read, table, write

if TYPE_CHECKING:
    from ctgraph_rl.log.run_log import RunLog
    from ctgraph_rl.profile.scoring import Results, Score
    from curricula.profile import Property

NAME = "profile"
PAGE = HERE / "profile.md"
PICTURE = HERE / "profile.png"

AGENTS = {"ppo": "PPO", "lstm_ppo": "LSTM-PPO", "dqn": "DQN", "rl2": "RL^2"}
"""Agents in the order of tables."""

CLASSES = {"PPO": "ppo", "LSTMPPO": "lstm_ppo", "DQN": "dqn", "RL2": "rl2"}

FRESH = "fresh"
"""Name of the lines with the frames after which a fresh copy solves the last block of the lives."""

GAP = ""


def collect(name: str, folders: Sequence[Path]) -> None:
    """Write a line for each seed of an agent in a property, one for each gap, and one for each fresh copy."""
    from ctgraph_rl.profile.scoring import profile_results

    lines = []
    for agent, by_title in profile_results(folders).items():
        for title, results in by_title.items():
            for line in _lines(results):
                lines.append({"agent": CLASSES[agent], "property": title, **line})
    lines += _fresh_lines(folders)
    for line in lines:
        line.update(_machine(folders))
    write(name, lines)


def _lines(results: Results) -> list[dict[str, Any]]:
    if not results.seeds:
        return [{"seed": GAP, "value": GAP, "floors": GAP, "optimum": GAP, "highest": GAP, "reason": results.reason}]
    lines = []
    for seed, each in results.seeds.items():
        floors = " ".join(f"{floor:.6g}" for floor in each.floors)
        line = {"seed": seed, "value": f"{each.value:.6g}", "floors": floors, "optimum": f"{each.optimum:.6g}"}
        lines.append({**line, "highest": f"{each.highest:.6g}", "reason": results.reason})
    return lines


def _fresh_lines(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Return the frames after which each fresh copy reaches all goals; nothing where it does not."""
    from ctgraph_rl.log.files import LOG
    from ctgraph_rl.log.run_log import RunLog

    lines = []
    for path in sorted(path for folder in folders for path in folder.glob("profile_fresh/*/metrics.json")):
        log = RunLog.read(path.parent / LOG)
        config = log.of_kind("run")[0]["config"]
        agent = CLASSES[config["agent"]["_target_"].rpartition(".")[2]]
        value = _frames_to_all(log)
        lines.append({"agent": agent, "property": FRESH, "seed": config["seed"], "value": value or GAP})
    order = list(AGENTS)
    return sorted(lines, key=lambda line: (order.index(line["agent"]), line["seed"]))


def _frames_to_all(log: RunLog) -> int | None:
    lowest: dict[int, float] = {}
    for m in log.of_kind("evaluation"):
        lowest[m["frames"]] = min(lowest.get(m["frames"], 1.0), m["return_mean"])
    return next((frames for frames, value in lowest.items() if value >= 0.9), None)


def _machine(folders: Sequence[Path]) -> dict[str, str]:
    from ctgraph_rl.log.files import LOG
    from ctgraph_rl.log.run_log import RunLog

    first = next(path for folder in folders for path in folder.rglob(LOG))
    return machine_of(RunLog.begun(first) or {})


def make() -> None:
    """Write the page and draw its figure."""
    PAGE.write_text(page(), encoding="utf-8")
    draw()


def raw() -> Raw:
    """Return the lines of seeds and gaps."""
    return [line for line in read(NAME) if line["property"] != FRESH]


def scores(lines: Raw | None = None) -> dict[str, dict[str, Score]]:
    """Return the scores by agent and property, in the order of tables."""
    from ctgraph_rl.profile.properties import Measured
    from ctgraph_rl.profile.scoring import Results, score_of_results

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
    from curricula.profile import PROPERTIES

    return list(PROPERTIES.values())


def fresh_frames(agent: str) -> list[float]:
    """Return the frames after which fresh copies of an agent reach all goals of the lives' last block."""
    lines = [line for line in read(NAME) if line["property"] == FRESH and line["agent"] == agent]
    return [float(line["value"] or "inf") for line in lines]


def last_block() -> int:
    """Return the frames of the lives' last block."""
    import curricula

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
        parts = [f"its interval is above the floor in {_listed(certain[agent])}"]
        if only:
            parts.append(f"only its mean in {_listed(only)}")
        lines.append(f"- **{AGENTS[agent]}** ({seeds} seeds): {'; '.join(parts)}.")
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
        absolute.append([prop.title, *(by_title[prop.title].absolute for by_title in found.values())])
    head = ["property", *(AGENTS[agent] for agent in found)]
    gaps = []
    for agent, by_title in found.items():
        for title, score in by_title.items():
            if score.reason:
                gaps.append(f"- {AGENTS[agent]}, {title}: {score.reason}.")
    template = Template((TEMPLATES / "profile.md").read_text(encoding="utf-8"))
    return template.substitute(
        verdicts=verdicts(found),
        scores=table(head, rows),
        absolute=table(head, absolute),
        four_times=four_times(),
        gaps="\n".join(dict.fromkeys(gaps)),
        machines=machines(NAME),
    )


def draw() -> None:
    """Draw the scores as bars with intervals."""
    from ctgraph_rl.draw.style import save_figure
    from ctgraph_rl.profile.profile_page import draw_profiles
    from ctgraph_rl.report.style import style

    with style():
        save_figure(draw_profiles({AGENTS[agent]: by_title for agent, by_title in scores().items()}), PICTURE)
