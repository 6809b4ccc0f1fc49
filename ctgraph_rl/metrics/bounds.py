"""Lowest and highest values of metrics, known before a run starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

NOISE = 4
"""Standard deviations by which a mean return may be off."""


class Known(NamedTuple):
    """Bounds on what a run measures, without the optimum, which is no mean over episodes."""

    low: float  # lowest return of an evaluation of any task, with the noise of rewards; -inf where nothing bounds it
    high: float  # highest one
    tasks: int
    evaluations: int  # of each task, after those before training
    lowest_share: float = -math.inf  # lowest of (return - failure) / (optimum - failure) of any task's evaluation
    highest_share: float = math.inf  # highest one: 1 where no evaluation is better than the optimum
    lowest_search_regret: float = -math.inf  # of a row of any task, that reaches the goal in all its episodes
    highest_search_regret: float = math.inf  # of one that never reaches it


LowAndHigh = tuple[float, float]
BoundsOf = Callable[[Known], LowAndHigh]
"""A metric's bounds; infinite if there are none."""


def unbounded(known: Known) -> LowAndHigh:
    """Return infinite bounds."""
    return -math.inf, math.inf


def not_negative(known: Known) -> LowAndHigh:
    """Return the bounds of ratios and losses against the best."""
    return 0.0, math.inf


def at_most_1(known: Known) -> LowAndHigh:
    """Return the bounds of a share of the possible gain."""
    return -math.inf, 1.0 if known.highest_share <= 1 else math.inf


def of_regret(known: Known) -> LowAndHigh:
    """Return the bounds of losses against the optimum; chance may gain, where an episode can."""
    return 0.0 if known.highest_share <= 1 else -math.inf, math.inf


def of_losses(known: Known) -> LowAndHigh:
    """Return the bounds of a mean over tasks of optimum less return."""
    return 0.0 if known.highest_share <= 1 else -math.inf, known.high - known.low


def of_kept_shares(known: Known) -> LowAndHigh:
    """Return the bounds of what is left of a gain over failure."""
    return 0.0 if known.lowest_share >= 0 else -math.inf, math.inf


def of_search_regret(known: Known) -> LowAndHigh:
    """Return the bounds of goals missed against the best search."""
    return known.lowest_search_regret, known.highest_search_regret


def between(low: float, high: float) -> BoundsOf:
    """Return the same bounds for every run."""
    return lambda known: (low, high)


def of_performance(known: Known) -> LowAndHigh:
    """Return the bounds of means of performance."""
    return known.low, known.high


def of_changes(known: Known) -> LowAndHigh:
    """Return the bounds of differences of two performances."""
    return known.low - known.high, known.high - known.low


def of_changes_but_one(known: Known) -> LowAndHigh:
    """Return the bounds of means over tasks of differences, one of which is 0."""
    share = (known.tasks - 1) / known.tasks
    return share * (known.low - known.high) if share else 0.0, share * (known.high - known.low) if share else 0.0


def of_gains(known: Known) -> LowAndHigh:
    """Return the bounds of a change's positive part."""
    return 0.0, known.high - known.low


def of_remembering(known: Known) -> LowAndHigh:
    """Return the bounds of 1 less the size of a loss."""
    return 1 + known.low - known.high, 1.0


def of_scaled_changes(known: Known) -> LowAndHigh:
    """Return the bounds of changes over the largest size of a performance."""
    largest = 1.0 if known.low >= 0 or known.high <= 0 else 2.0
    return -largest, largest


def of_lost_shares(known: Known) -> LowAndHigh:
    """Return the bounds of the lost share of the best performance."""
    return 0.0, 1.0 if known.low >= 0 else math.inf


def of_sums(known: Known) -> LowAndHigh:
    """Return the bounds of a sum of performance over tasks."""
    return known.tasks * known.low, known.tasks * known.high


def of_sums_over_time(known: Known) -> LowAndHigh:
    """Return the bounds of a sum of performance over tasks and evaluations."""
    count = known.tasks * known.evaluations
    return count * known.low, count * known.high


def of_counts(known: Known) -> LowAndHigh:
    """Return the bounds of a number of tasks."""
    return 0.0, float(known.tasks)


def from_failure_to_best(low: float, high: float) -> BoundsOf:
    """Return the bounds of performance where a failure is ``low`` and the optimum ``high``."""
    scale = high - low
    return lambda known: (low + scale * known.lowest_share, low + scale * known.highest_share)


def of_changes_on_scale(scale: float) -> BoundsOf:
    """Return the bounds of differences on a scale of length ``scale`` from failure to optimum."""

    def bounds(known: Known) -> LowAndHigh:
        widest = scale * (known.highest_share - known.lowest_share)
        return -widest, widest

    return bounds
