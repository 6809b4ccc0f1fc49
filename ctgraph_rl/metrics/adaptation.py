"""Metrics of adaptation within a row of an evaluation, against the best search for one of n uniform goals.

The best searcher knows the way to each of n end states, tries each once and returns to the goal. It succeeds in its
i-th episode with probability min(1, i/n), and first in episode (n + 1)/2 on average.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import not_negative, of_performance, of_search_regret
from ctgraph_rl.metrics.record import HERE, defined


class Adaptation(NamedTuple):
    """The last evaluation with adaptation; [tasks, episodes of a row]."""

    returns: Tensor  # float64 [tasks, episodes]: mean return
    success: Tensor  # float64 [tasks, episodes]: share of rows that reached the goal
    found: Tensor  # float64 [tasks, episodes]: share of rows that have reached it by then
    exact: Tensor  # float64 [tasks, episodes]: success rate of the best search


def exact_search(num_goals: int, num_episodes: int) -> Tensor:
    """Return the best search's success rate in each episode, min(1, i/n), float64 [num_episodes].

    Example:
        >>> exact_search(4, 5).tolist()
        [0.25, 0.5, 0.75, 1.0, 1.0]
    """
    episode = torch.arange(1, num_episodes + 1, dtype=torch.float64, device="cpu")
    return (episode / num_goals).clamp(max=1)


@defined("ctgraph_rl/adapted-return", "1/T sum_j return_j in the last episode of rows", HERE, bounds=of_performance)
def adapted_return(adaptation: Adaptation) -> Tensor:
    """Return the mean return on trained tasks in a row's last episode."""
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
    """Return the goals that a row misses against the best search: the area between their curves.

    0 is optimal; below 0 is by chance, or goals are not uniform.
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
    """Return rows' first success over the best search's, (n + 1)/2 episodes: 1 is optimal.

    Undefined if a row never reached the goal.
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
