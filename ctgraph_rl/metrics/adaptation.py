"""Metrics of adaptation within a row of an evaluation, against the best search for one of n uniform goals.

A searcher that knows how to get to each of n end states, and nothing of the goal, tries each once and returns to the
goal. It succeeds in its i-th episode with probability min(1, i/n), and first in episode (n + 1)/2 on average. No
one does better over goals that are drawn uniformly.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import not_negative, of_performance, of_search_regret
from ctgraph_rl.metrics.record import HERE, defined


class Adaptation(NamedTuple):
    """The last evaluation with adaptation; a row for each task, a column for each episode of a row."""

    returns: Tensor  # float64 [tasks, episodes]: mean return
    success: Tensor  # float64 [tasks, episodes]: share of rows that reached the goal
    found: Tensor  # float64 [tasks, episodes]: share of rows that have reached it by then
    exact: Tensor  # float64 [tasks, episodes]: success rate of the best search


def exact_search(num_goals: int, num_episodes: int) -> Tensor:
    """Return the success rate of the best search in each of its episodes, min(1, i/n), float64 [num_episodes].

    Args:
        num_goals: n.
        num_episodes: episodes one after the other.

    Example:
        >>> exact_search(4, 5).tolist()
        [0.25, 0.5, 0.75, 1.0, 1.0]
    """
    episode = torch.arange(1, num_episodes + 1, dtype=torch.float64, device="cpu")
    return (episode / num_goals).clamp(max=1)


@defined("ctgraph_rl/adapted-return", "1/T sum_j return_j in the last episode of rows", HERE, bounds=of_performance)
def adapted_return(adaptation: Adaptation) -> Tensor:
    """Return the mean return on trained tasks in the last episode of a row, after all others."""
    return adaptation.returns[:, -1]


@defined(
    "ctgraph_rl/adapted-return-held-out",
    "as adapted-return, over held-out tasks",
    HERE,
    inputs={"adaptation": "held_out_adaptation"},
    bounds=of_performance,
)
def held_out_adapted_return(adaptation: Adaptation) -> Tensor:
    """Return the same on held-out tasks."""
    return adaptation.returns[:, -1]


@defined(
    "ctgraph_rl/search-regret",
    "1/T sum_j sum_i (min(1, i/n_j) - success_j in episode i of rows)",
    HERE,
    bounds=of_search_regret,
)
def search_regret(adaptation: Adaptation) -> Tensor:
    """Return the goals that a row misses beside the best search: the area between its curve and the exact one.

    0 is optimal. Below 0 is chance, or a task whose goals are not uniform.
    """
    return _regret(adaptation)


@defined(
    "ctgraph_rl/search-regret-held-out",
    "as search-regret, over held-out tasks",
    HERE,
    inputs={"adaptation": "held_out_adaptation"},
    bounds=of_search_regret,
)
def held_out_search_regret(adaptation: Adaptation) -> Tensor:
    """Return the same on held-out tasks."""
    return _regret(adaptation)


@defined(
    "ctgraph_rl/first-success",
    "1/T sum_j (mean episode of rows that reaches the goal first) / ((n_j + 1)/2)",
    HERE,
    missing="a row never reached the goal",
    bounds=not_negative,
    is_time=True,
)
def first_success(adaptation: Adaptation) -> Tensor:
    """Return the first success of rows over that of the best search, (n + 1)/2 episodes: 1 is optimal.

    Undefined for a task with a row that never reached the goal.
    """
    return _first(adaptation)


@defined(
    "ctgraph_rl/first-success-held-out",
    "as first-success, over held-out tasks",
    HERE,
    inputs={"adaptation": "held_out_adaptation"},
    missing="a row never reached the goal",
    bounds=not_negative,
    is_time=True,
)
def held_out_first_success(adaptation: Adaptation) -> Tensor:
    """Return the same on held-out tasks."""
    return _first(adaptation)


def _regret(adaptation: Adaptation) -> Tensor:
    return (adaptation.exact - adaptation.success).sum(dim=1)


def _first(adaptation: Adaptation) -> Tensor:
    first = 1 + (1 - adaptation.found[:, :-1]).sum(dim=1)
    num_goals = 1 / adaptation.exact[:, 0]
    return torch.where(adaptation.found[:, -1] == 1, first / ((num_goals + 1) / 2), torch.nan)
