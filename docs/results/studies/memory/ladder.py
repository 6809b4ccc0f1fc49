"""The search and the ladder: sentences of graphs whose episodes get longer, for `memory_cells`.

memory_ladder.csv has the runs of two experiments. ``memory_search`` tries some values of `SETTINGS` for each cell on
one graph with the seeds of `SEARCHED`; ``memory_ladder`` gives each cell the setting that did best there.
"""

from __future__ import annotations

from collections.abc import Sequence

from studies.memory.conditions import AGENTS, count, ranking
from studies.raw import Raw, groups, numbers_in, read, select

NAME = "memory_ladder"

SETTINGS = ("num_envs", "num_steps", "learning_rate", "entropy_coeff")
"""What differs between runs: the environments, the steps of a sequence, learning rate, entropy bonus."""

CELLS = [name for name in AGENTS if name.startswith("lstm_ppo") and name != "lstm_ppo-attention"]

SEARCHED = ("100", "101")
"""Seeds of the search, which the ladder does not have."""

LENGTHS = {"2": ("6", "30", "100", "300"), "3": ("10", "30", "100", "300"), "4": ("10", "30", "100", "300")}
"""Expected lengths of the ladder's graphs by depth; the shortest are 6, 8 and 10, of which 8 was not run."""

SHORT = 10
"""A policy whose episodes take fewer steps on graphs of 100 or 300 steps does not wait."""


def searched(agent: str) -> dict[tuple[str, ...], Raw]:
    """Return the lines of an agent's search by setting, in the order of the file."""
    lines = [line for line in select(read(NAME), agent=agent) if line["seed"] in SEARCHED]
    return groups(lines, *SETTINGS)


def score(lines: Raw) -> float:
    """Return what the search maximises: the greedy return and that of acting in training, over all seeds."""
    return sum(numbers_in(lines, "greedy_return") + numbers_in(lines, "training_return"))


def on_rung(depth: str, length: str) -> dict[str, Raw]:
    """Return the lines of each cell on a rung."""
    lines = [line for line in select(read(NAME), depth=depth, expected_length=length) if line["seed"] not in SEARCHED]
    return {agent: select(lines, agent=agent) for agent in CELLS}


def texts() -> dict[str, str]:
    """Return the numbers and lists of the ladder within the text of the page."""
    hundred = on_rung("2", "100")
    found = {f"ladder_2_{length}": ranking(on_rung("2", length)) for length in ("100", "300")}
    found["search_lstm"] = count(max(searched("lstm_ppo").values(), key=score))
    found["ladder_lstm"] = count(hundred["lstm_ppo"])
    found["stopped"] = stopped([lines for depth in LENGTHS for lines in on_rung(depth, "300").values()])
    found["stopped_100"] = stopped(list(hundred.values()))
    return found


def stopped(runs: Sequence[Raw]) -> str:
    """Return how many runs end with training episodes of fewer than `SHORT` steps."""
    lengths = [length for lines in runs for length in numbers_in(lines, "training_length")]
    return f"{sum(length < SHORT for length in lengths)} of {len(lengths)}"
