"""One-hot tasks and tables of action probabilities, for the tests of exact values."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ctgraph_rl import CTGraph, Needle, Observations, OneHot, StateType, Task
from ctgraph_rl.core.rewards import Arrival

F64 = torch.float64

GRAPHS = [(2, 1, 0.0), (2, 2, 0.5), (3, 2, 0.25), (2, 4, 0.9), (3, 3, 0.0), (4, 2, 0.75)]

GAMMAS = [0.0, 0.5, 0.99, 1.0]


@dataclass(frozen=True)
class OneAtTheGoal:
    """Needle under another name, so that every state is visited."""

    def __call__(self, arrival: Arrival) -> Tensor:
        return (arrival.leaf == arrival.goal_leaf).to(torch.float32)


@dataclass(frozen=True)
class Mixed:
    """Other end states pay too, some of them less than nothing: exact in float32."""

    def __call__(self, arrival: Arrival) -> Tensor:
        return torch.where(arrival.leaf == arrival.goal_leaf, 1.0, (arrival.leaf * 5 % 7 - 2) / 8)


def make_task(
    b: int, d: int, p: float = 0.0, *, waits: int = 1, decisions: int = 1, unique: str = "", **fields
) -> Task:
    """A one-hot task; ``unique`` names the kinds whose states have ids of their own: "", "w", "d" or "wd"."""
    graph = CTGraph(b, d, p)
    waits = graph.num_wait_states if "w" in unique else waits
    decisions = graph.num_decision_states if "d" in unique else decisions
    first_end = 2 + waits + decisions
    ids = Observations(
        wait_ids=(2, 1 + waits),
        decision_ids=(2 + waits, first_end - 1),
        end_ids=(first_end, first_end),
        unique_waits="w" in unique,
        unique_decisions="d" in unique,
        unique_ends=False,
    )
    fields.setdefault("goal", tuple(1 + (k + 1) % b for k in range(d)))
    return Task(graph, observations=ids, images=OneHot(first_end + 1), **fields)


def rows_of(task: Task, kind: StateType) -> range:
    first, last = task.observations.ids(kind)
    return range(first, last + 1)


def table(task: Task, wait: Iterable[float], decide: Iterable[float]) -> Tensor:
    """One row of action probabilities for all wait ids and one for all decision ids."""
    wait, decide = torch.tensor(list(wait), dtype=F64), torch.tensor(list(decide), dtype=F64)
    policy = torch.full((task.images.num_images, len(wait)), 1 / len(wait), dtype=F64)
    policy[list(rows_of(task, StateType.WAIT))] = wait
    policy[list(rows_of(task, StateType.DECISION))] = decide
    return policy


def uniform(task: Task) -> Tensor:
    num_actions = task.graph.branching_factor + 1
    return torch.full((task.images.num_images, num_actions), 1 / num_actions, dtype=F64)


def random_policy(task: Task, num_actions: int, generator: torch.Generator, power: float = 1.0) -> Tensor:
    weights = torch.rand(task.images.num_images, num_actions, generator=generator, dtype=F64) ** power
    return weights / weights.sum(-1, keepdim=True)


def success_prob(task: Task, policy: Tensor) -> float:
    """The exact probability that action probabilities by observation id reach the goal."""
    paid = replace(task, reward_fn=Needle(), goal_reward=1.0, fail_reward=0.0, step_reward=0.0)
    return paid.policy_value(policy)
