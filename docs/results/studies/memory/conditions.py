"""The graphs and agents of the experiment ``memory_cells``, and what is finished on each."""

from __future__ import annotations

from typing import NamedTuple

from studies.raw import Raw, groups, numbers_in, read

NAME = "memory_cells"
LADDER = "memory_ladder"

SEEDS = 5

SOLVED = 0.9
"""The least greedy return of a seed that solves a task; the optimum is 1."""

GUIDED = "204800"
"""The frames over which a policy that navigates gives the first rewards."""

AGENTS = {
    "lstm_ppo": "LSTM",
    "lstm_ppo-gru": "GRU",
    "lstm_ppo-min_gru": "minGRU",
    "lstm_ppo-amrl_max": "AMRL-Max",
    "lstm_ppo-amrl_avg": "AMRL-Avg",
    "lstm_ppo-backpropamine": "Backpropamine",
    "lstm_ppo-attention": "attention",
    "lstm_ppo-frames": "frame stacking",
    "lstm_ppo-none": "PPO (no memory)",
    "a2c, 8 steps": "A2C (8 steps)",
    "a2c, 32 steps": "A2C (32 steps)",
    "reinforce, 8 steps": "REINFORCE (8 steps)",
    "reinforce, 128 steps": "REINFORCE (128 steps)",
    "dqn, 1 step": "DQN (1 step)",
    "dqn, 6 steps": "DQN (6 steps)",
    "qrdqn_lstm": "QRDQN+LSTM",
    "mohqa": "MOHQA",
}
"""Names of agents with their cells, in the order of the page; PPO where no other algorithm is named."""


class Condition(NamedTuple):
    """What an agent learned from, as the columns of memory_cells.csv have it."""

    wait_prob: str
    unique_decisions: str
    num_wait_images: str
    guide_frames: str = GUIDED
    read_noise: str = "0"

    @property
    def decisions(self) -> str:
        """Return how decision states look."""
        return "unique" if self.unique_decisions == "True" else "shared"


GRAPHS = [("False", "100"), ("False", "500"), ("True", "100"), ("True", "500")]
"""Unique decisions and wait images of the graphs with random waiting."""

GIVEN = [
    Condition("0", "False", "100"),
    *(Condition(wait_prob, *graph) for wait_prob in ("0.5", "0.9") for graph in GRAPHS),
]
"""The conditions with first rewards given, in the order of the page; the first one is CT-CO-B1."""

TO_FIND = [Condition("0.9", unique, "500", "0") for unique in ("False", "True")]
SHARED, UNIQUE = Condition("0.9", "False", "500"), Condition("0.9", "True", "500")
"""The graphs that the published claim can be about, with first rewards given."""


def finished() -> dict[Condition, dict[str, Raw]]:
    """Return the lines of each condition and agent, agents in the order of the page."""
    found: dict[Condition, dict[str, Raw]] = {}
    for condition, lines in groups(read(NAME), *Condition._fields).items():
        of = groups(lines, "agent")
        found[Condition(*condition)] = {agent: of[agent,] for agent in AGENTS if (agent,) in of}
    return found


def solved(lines: Raw) -> list[bool]:
    """Return for each seed whether it solves the task after training."""
    return [value >= SOLVED for value in numbers_in(lines, "greedy_return")]


def solved_once(lines: Raw) -> list[bool]:
    """Return for each seed whether it solves the task at any evaluation."""
    return [bool(line["frames_to_90"]) for line in lines]
