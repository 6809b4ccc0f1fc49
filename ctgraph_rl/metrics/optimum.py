"""Metrics that need what is known of CT-graphs in closed form: optimal values, P_R and E[kappa].

Training is given as intervals in time order: finished episodes and their mean return or success rate. Where in its
interval the first reward was is not known; of k successes in n episodes, in any order, the first is on average at
(n + 1) / (k + 1), which is taken. Intervals of one episode each make the numbers exact.
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
"""Stages of an agent on a task: it fails on the way, gets to end states, or gets to the goal."""


@defined(
    "ctgraph_rl/normalised-performance",
    "1/T sum_j (R[last,j] - zero_j) / (best_j - zero_j)",
    HERE,
    missing="an evaluation is missing or the best is the zero",
    bounds=from_failure_to_best(0, 1),
)
def normalised_performance(performance: Tensor, best: Tensor, zero: Tensor | float = 0.0) -> Tensor:
    """Mean performance after the last block as a share of what is possible: 1 is optimal.

    No range is taken from data, so numbers of two runs are comparable.

    Args:
        performance: float64 [blocks + 1, tasks], mean undiscounted returns.
        best: each task's `Task.optimal_value(1.0)`.
        zero: what counts as nothing, such as the return of a failure.
    """
    return ratio(performance[-1] - zero, best - zero)


@defined("ctgraph_rl/stage", "1/T sum_j stage_j, 0 fails, 1 navigates, 2 solves", HERE, bounds=between(0, 2))
def stage_reached(end_rates: Tensor, success_rates: Tensor, mastered: float = MASTERED) -> Tensor:
    """Mean of the stage that the agent reached on each task, by `STAGES`; the terms are the tasks' stages.

    Args:
        end_rates: share of a task's evaluation episodes that got to an end state, the goal's or another, [tasks].
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
    """Return that was lost while learning, against the optimal policy in every finished episode.

    Episodes that a block's end cut are not counted. Intervals without a finished episode add 0, whatever their mean.

    Args:
        episodes: finished episodes of each interval, [intervals].
        returns: their mean return; NaN without episodes.
        best: optimal value of the interval's task; NaN where tasks with different ones took turns.
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
    """Frames until a goal was reached first, over those that the random policy needs on average: 1 is no better.

    Undefined if a goal was never reached; the terms show the others.

    Args:
        frames: for each task, frames since its start at the end of each interval, [intervals].
        episodes: for each task, finished episodes of each interval.
        success_rates: for each task, share of each interval's episodes that reached the goal; NaN without episodes.
        random_frames: for each task, `ctgraph_rl.tasks.values.random_frames_to_goal`.
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
    """Episodes that a search without repetition needs on average, over those until a goal was reached first.

    1 is as good as trying end states one after the other, each once; the random policy is far below. Undefined if a
    goal was never reached; the terms show the others.

    Args:
        episodes: for each task, finished episodes of each interval, [intervals].
        success_rates: for each task, share of each interval's episodes that reached the goal; NaN without episodes.
        expected_episodes: for each task E[kappa], `CTGraph.expected_search_episodes`.
    """
    played = [each.cumsum(0) for each in episodes]
    first = _at_first_success(played, episodes, success_rates)
    return float64(expected_episodes) / first


def _at_first_success(counts: Sequence[Tensor], episodes: Sequence[Tensor], success_rates: Sequence[Tensor]) -> Tensor:
    """For each task, the count at the first success, float64 [tasks]; NaN without one."""
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
