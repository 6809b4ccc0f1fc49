"""Metrics that need what is known of CT-graphs in closed form: optimal values, P_R and E[kappa].

Training is intervals in time order: finished episodes and their mean return or success rate. The first of k successes
in n episodes, in any order, is on average at (n + 1) / (k + 1), which is taken; intervals of one episode are exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import between, from_failure_to_best, not_negative, of_regret
from ctgraph_rl.metrics.record import HERE, MASTERED, defined, float64, ratio

PAPER = "closed forms of Soltoggio et al. 2023 (arXiv 2302.10887)"

_FIRST_BLOCK = {"episodes": "first_episodes", "success_rates": "first_success_rates"}

STAGES = ("fails", "navigates", "solves")
"""An agent fails on the way, gets to end states, or to the goal."""


@defined(
    "ctgraph_rl/normalised-performance",
    "1/T sum_j (R[last,j] - zero_j) / (best_j - zero_j)",
    HERE,
    missing="an evaluation is missing or the best is the zero",
    bounds=from_failure_to_best(0, 1),
)
def normalised_performance(performance: Tensor, best: Tensor, zero: Tensor | float = 0.0) -> Tensor:
    """Mean performance after the last block as a share of what is possible: 1 is optimal.

    No range is taken from data, so runs are comparable.

    Args:
        performance: float64 [blocks + 1, tasks], mean undiscounted returns.
        best: each task's `Task.optimal_value(1.0)`.
        zero: what counts as 0, such as the return of a failure.
    """
    return ratio(performance[-1] - zero, best - zero)


@defined("ctgraph_rl/stage", "1/T sum_j stage_j, 0 fails, 1 navigates, 2 solves", HERE, bounds=between(0, 2))
def stage_reached(end_rates: Tensor, success_rates: Tensor, mastered: float = MASTERED) -> Tensor:
    """Mean over tasks of the stage that the agent reached, by `STAGES`.

    Args:
        end_rates: share of evaluation episodes that got to any end state, [tasks].
        success_rates: share that got to the goal.
        mastered: share that counts as having reached a stage.
    """
    stages = (end_rates >= mastered).double() + (success_rates >= mastered).double()
    return torch.where(end_rates.isnan() | success_rates.isnan(), torch.nan, stages)


@defined(
    "ctgraph_rl/regret",
    "sum over training intervals k of episodes_k * (best_k - return_k)",
    HERE,
    aggregate=torch.sum,
    inputs={"best": "interval_best"},
    bounds=of_regret,
)
def regret(episodes: Tensor, returns: Tensor, best: Tensor) -> Tensor:
    """Return lost while learning, against the optimal policy in every finished episode.

    Episodes that a block's end cut are not counted.

    Args:
        episodes: finished episodes of each interval, [intervals].
        returns: their mean return; NaN without episodes.
        best: optimal value of the interval's task; NaN where tasks differ in it.
    """
    return torch.where(episodes == 0, 0.0, episodes * (best - returns))


of_first_success = partial(defined, source=PAPER, missing="a goal was never reached")


@of_first_success(
    "ctgraph_rl/first-reward",
    "1/T sum_j frames_j to the first reward / (E[frames of a random episode] / P_R)",
    inputs=_FIRST_BLOCK | {"frames": "first_frames"},
    bounds=not_negative,
    is_time=True,
)
def frames_to_first_reward(
    frames: Sequence[Tensor],
    episodes: Sequence[Tensor],
    success_rates: Sequence[Tensor],
    random_frames: Sequence[float],
) -> Tensor:
    """Frames until a goal was first reached, over the random policy's mean: 1 is no better.

    Undefined if a goal was never reached; the terms show the others.

    Args:
        frames: by task, frames since its start at each interval's end, [intervals].
        episodes: by task, finished episodes of each interval.
        success_rates: by task, share of each interval's episodes at the goal; NaN without episodes.
        random_frames: by task, `ctgraph_rl.tasks.values.random_frames_to_goal`.
    """
    return _at_first_success(frames, episodes, success_rates) / float64(random_frames)


@of_first_success(
    "ctgraph_rl/search-efficiency",
    "1/T sum_j E[kappa_j] / episodes_j to the first reward",
    inputs=_FIRST_BLOCK | {"expected_episodes": "search_episodes"},
    bounds=not_negative,
)
def search_efficiency(
    episodes: Sequence[Tensor], success_rates: Sequence[Tensor], expected_episodes: Sequence[float]
) -> Tensor:
    """Mean episodes of a search without repetition, over those until a goal was first reached.

    1 is as good as trying each end state once; the random policy is far below. Undefined if a goal was never reached;
    the terms show the others.

    Args:
        episodes: by task, finished episodes of each interval, [intervals].
        success_rates: by task, share of each interval's episodes at the goal; NaN without episodes.
        expected_episodes: by task E[kappa], `CTGraph.expected_search_episodes`.
    """
    played = [each.cumsum(0) for each in episodes]
    first = _at_first_success(played, episodes, success_rates)
    return float64(expected_episodes) / first


def _at_first_success(counts: Sequence[Tensor], episodes: Sequence[Tensor], success_rates: Sequence[Tensor]) -> Tensor:
    first = []
    for count, played, rates in zip(counts, episodes, success_rates, strict=True):
        found = (rates > 0).nonzero().flatten().tolist()
        if not found:
            first.append(math.nan)
            continue
        i = found[0]
        before = count[i - 1].item() if i else 0
        finished = played[i].item()
        position = (finished + 1) / (round(finished * rates[i].item()) + 1)
        first.append(before + (count[i].item() - before) * position / finished)
    return float64(first)
