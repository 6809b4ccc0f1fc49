"""The search and the ladder: sentences of graphs whose episodes get longer, for `memory_cells`.

memory_ladder.csv has the runs of two experiments. ``memory_search`` tries some values of `SETTINGS` for each cell on
one graph with the seeds of `SEARCHED`; ``memory_ladder`` gives each cell the setting that did best there.
"""

from __future__ import annotations

from studies.memory.runs import LADDER_CELLS, SEEDS, SETTINGS, count, mean, ranking
from studies.raw import Raw, groups, read

NAME = "memory_ladder"

SEARCHED = ("100", "101")
"""Seeds of the search, which the ladder does not have."""

RUNGS = [(depth, length) for depth in "234" for length in (("6" if depth == "2" else "10"), "30", "100", "300")]
"""Depth and expected length of the ladder's graphs; the shortest are 6, 8 and 10, of which 8 was not run."""

SHORT = 10
"""A policy whose episodes take fewer steps on graphs of 100 or 300 steps does not wait."""


def searched() -> dict[str, dict[tuple[str, ...], Raw]]:
    """Return the lines of the search by agent and setting, settings in the order of the file, of finished settings."""
    lines = [line for line in read(NAME) if line["seed"] in SEARCHED]
    of = {agent: groups(own, *SETTINGS) for (agent,), own in groups(lines, "agent").items()}
    return {
        agent: {setting: own for setting, own in each.items() if len(own) == len(SEARCHED)}
        for agent, each in of.items()
    }


def score(lines: Raw) -> float:
    """Return what the search maximises: the mean over seeds of the greedy return and of that of acting in training."""
    return (mean(lines, "greedy_return") + mean(lines, "training_return")) / 2


def best(agent: str) -> tuple[str, ...]:
    """Return the setting that did best in the search, the first of equals."""
    of = searched()[agent]
    return max(of, key=lambda setting: score(of[setting]))


def finished() -> dict[tuple[str, str], dict[str, Raw]]:
    """Return the lines of each rung and cell with all seeds, which have one setting."""
    found: dict[tuple[str, str], dict[str, Raw]] = {}
    lines = [line for line in read(NAME) if line["seed"] not in SEARCHED]
    for (depth, length, agent, *_), own in groups(lines, "depth", "expected_length", "agent", *SETTINGS).items():
        if len(own) == SEEDS:
            found.setdefault((depth, length), {})[agent] = own
    return {rung: {agent: of[agent] for agent in LADDER_CELLS if agent in of} for rung, of in found.items()}


def texts() -> dict[str, str]:
    """Return the numbers and lists of the ladder within the text of the page."""
    of, search = finished(), searched()
    found = {f"ladder_2_{length}": ranking(of.get(("2", length), {})) for length in ("100", "300")}
    found["search_lstm"] = count(search["lstm_ppo"][best("lstm_ppo")])
    found["ladder_lstm"] = count(of.get(("2", "100"), {}).get("lstm_ppo"))
    found["stopped"] = stopped(
        [lines for (_, length), each in of.items() if length == "300" for lines in each.values()]
    )
    return found | {"stopped_100": stopped(list(of.get(("2", "100"), {}).values()))}


def stopped(rungs: list[Raw]) -> str:
    """Return how many runs end with training episodes of fewer than `SHORT` steps."""
    lengths = [float(line["training_length"]) for lines in rungs for line in lines]
    return f"{sum(length < SHORT for length in lengths)} of {len(lengths)}"
