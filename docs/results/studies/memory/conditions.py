"""The graphs of the experiment ``memory_cells``, and what is finished on each."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

from studies.memory.runs import AGENTS, SEEDS
from studies.raw import Raw, groups, read

NAME = "memory_cells"

NOISE = "25"
"""The largest addition to each pixel in the conditions with noise."""

GUIDED = "204800"
"""The frames over which a policy that navigates gives the first rewards."""


class Condition(NamedTuple):
    """What an agent learned from, as the columns of memory_cells.csv have it."""

    wait_prob: str
    unique_decisions: str
    num_wait_images: str
    guide_frames: str = GUIDED
    read_noise: str = "0"

    def __str__(self) -> str:
        """Return the condition in words."""
        noise = f", noise up to {self.read_noise}" if self.read_noise != "0" else ""
        return f"p = {self.wait_prob}, {self.graph}, {self.rewards}{noise}"

    @property
    def graph(self) -> str:
        """Return what differs between graphs with the same waits, in words."""
        return f"{self.num_wait_images} wait images, {self.decisions} decisions"

    @property
    def decisions(self) -> str:
        """Return how decision states look."""
        return "unique" if self.unique_decisions == "True" else "shared"

    @property
    def rewards(self) -> str:
        """Return where the first rewards come from."""
        return "first rewards given" if self.guide_frames != "0" else "first rewards to be found"


GRAPHS = list(product(("False", "True"), ("100", "500")))
"""Unique decisions and wait images of the graphs with random waiting."""

GIVEN = [
    Condition("0", "False", "100"),
    *(Condition(wait_prob, *graph) for wait_prob in ("0.5", "0.9") for graph in GRAPHS),
]
"""The conditions with first rewards given, in the order of the page; the first one is CT-CO-B1."""

TO_FIND = [Condition("0.9", unique, "500", "0") for unique in ("False", "True")]
NOISY = [
    Condition(wait_prob, "False", images, GUIDED, NOISE) for wait_prob in ("0.5", "0.9") for images in ("100", "500")
]
NOISY_AGENTS = ("lstm_ppo", "lstm_ppo-gru")
SHARED, UNIQUE = Condition("0.9", "False", "500"), Condition("0.9", "True", "500")
"""The graphs that the published claim can be about, with first rewards given."""


def finished() -> dict[Condition, dict[str, Raw]]:
    """Return the lines of each condition and agent with all seeds, agents in the order of the page."""
    found: dict[Condition, dict[str, Raw]] = {}
    for condition, lines in groups(read(NAME), *Condition._fields).items():
        of = {agent: each for (agent,), each in groups(lines, "agent").items() if len(each) == SEEDS}
        found[Condition(*condition)] = {agent: of[agent] for agent in AGENTS if agent in of}
    return found


def columns(conditions: list[Condition]) -> dict[Condition, dict[str, Raw]]:
    """Return what is finished of some conditions, in their order."""
    of = finished()
    return {condition: of.get(condition, {}) for condition in conditions}
