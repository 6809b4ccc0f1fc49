"""Whether scores of runs that were made again are lower than the submitted ones: an exact test, and its power."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ctgraph_rl.checks import fraction, is_int, require

ALPHA, POWER = 0.05, 0.8
"""The chance to find a difference where there is none, at most; and to find one of the size that is stated."""

MOST_SPLITS = 1_000
"""Ways to split the scores up to which all are tried; of more, as many random ones are."""

SAMPLES = 4_000
"""Of normal scores, for the power."""

ROUNDING = 1e-9
"""Means that differ by less are equal."""


class Difference(NamedTuple):
    """What a comparison found, and what it would have found."""

    submitted: float  # mean score
    found: float  # mean score of the runs that were made again
    p_value: float  # of scores that are lower by chance
    low: float  # the drop is larger, with a chance of 1 - `ALPHA`; infinite where so few scores do not say
    high: float  # the drop is smaller, with the same chance
    detectable: float  # the drop that is found with a chance of `POWER`, by the spread seen; infinite if none would be

    @property
    def is_lower(self) -> bool:
        """Whether the scores that were found are lower than chance explains."""
        return self.p_value <= ALPHA

    @property
    def is_blind(self) -> bool:
        """Whether no scores at all could have been found to be lower."""
        return math.isinf(self.detectable)

    def __str__(self) -> str:
        """Means, p-value and power in one sentence."""
        drop = f"a drop of {self.detectable:.3g}" if self.detectable else "as no scores differ within a group, any drop"
        power = (
            "so few runs cannot show any drop" if self.is_blind else f"{drop} would be found with {POWER:.0%} chance"
        )
        drops = (f"{round(drop, 6) + 0.0:.3g}" for drop in (self.submitted - self.found, self.low, self.high))
        interval = "drop {} [{}, {}]".format(*drops)
        return f"mean {self.found:.4g} against {self.submitted:.4g}: {interval}, p = {self.p_value:.3g}; {power}"


def compare_samples(submitted: Sequence[float], found: Sequence[float]) -> Difference:
    """Test whether scores are lower than submitted ones, by all ways to split them into groups of these sizes.

    The chance to call equal distributions different is at most `ALPHA`, whatever they are. The interval holds all drops
    that the test does not exclude, on either side. The stated power is of normal scores with the standard deviation
    within both groups.

    Args:
        submitted: scores of the submitted runs, one or more.
        found: scores of the runs that were made again, one or more.

    Raises:
        ValueError: for a group without scores.
    """
    sizes = (len(submitted), len(found))
    require((min(sizes) > 0, f"a comparison needs scores of both groups, got {sizes[0]} and {sizes[1]}"))
    scores = np.array([[*submitted, *found]], dtype=np.float64)
    squares = float(np.var(submitted)) * sizes[0] + float(np.var(found)) * sizes[1]
    spread = math.sqrt(squares / max(1, sum(sizes) - 2))
    unit = detectable(*sizes)
    return Difference(
        float(np.mean(submitted)),
        float(np.mean(found)),
        float(_p_values(scores, sizes[1])[0]),
        low=_least_drop(scores, sizes[1]),
        high=-_least_drop(-scores, sizes[1]),
        detectable=unit if math.isinf(unit) else unit * spread,
    )


def _least_drop(scores: np.ndarray, found: int) -> float:
    """Return the smallest drop of the last scores, [1, submitted + found], that the test does not exclude."""
    reach = 2 * float(np.ptp(scores)) + 1
    low = -reach
    high = reach

    def is_excluded(drop: float) -> bool:
        shifted = scores.copy()
        shifted[:, -found:] += drop
        return bool(_p_values(shifted, found)[0] <= ALPHA)

    if not is_excluded(low):
        return -math.inf
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if is_excluded(middle) else (low, middle)
    return high


def runs_needed(submitted: int) -> int:
    """Return how many runs must be made again at least, so that the test can find any drop."""
    require((is_int(submitted, 1), f"submitted must be an integer >= 1, got {submitted!r}"))
    return next(n for n in range(1, math.ceil(1 / ALPHA) + 1) if 1 / math.comb(submitted + n, n) <= ALPHA)


@cache
def detectable(submitted: int, found: int, power: float = POWER) -> float:
    """Return the drop, in standard deviations of normal scores, that the test finds with a given chance.

    Args:
        submitted: number of submitted scores.
        found: number of the others.
        power: the chance.

    Returns:
        The drop; infinite if the test can find none with so few scores.
    """
    require(*fraction(power=power))
    if 1 / math.comb(submitted + found, found) > ALPHA:
        return math.inf
    noise = np.random.default_rng(0).standard_normal((SAMPLES, submitted + found))
    low = 0.0
    high = 1.0
    while _share_found(noise, found, high) < power:
        low = high
        high = 2 * high
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (middle, high) if _share_found(noise, found, middle) < power else (low, middle)
    return high


def _share_found(noise: np.ndarray, found: int, drop: float) -> float:
    """Return the share of samples in which a drop of the last scores is found."""
    scores = noise.copy()
    scores[:, -found:] -= drop
    return float((_p_values(scores, found) <= ALPHA).mean())


def _p_values(scores: np.ndarray, found: int) -> np.ndarray:
    """Return for each row of scores [n, submitted + found] the share of splits whose last group is as low, [n]."""
    splits = _splits(scores.shape[1], found)
    sums = scores @ splits.T
    return (sums <= sums[:, :1] + ROUNDING).mean(axis=1)


@cache
def _splits(count: int, found: int) -> np.ndarray:
    """Return who is in the second group, float64 [splits, count]: first the true one, then all or many random ones."""
    if math.comb(count, found) <= MOST_SPLITS:
        chosen = np.array(list(combinations(range(count), found)))
        chosen = np.roll(chosen, 1, axis=0)  # the true one is the last
    else:
        rng = np.random.default_rng(0)
        chosen = np.array(
            [range(count - found, count), *(rng.permutation(count)[:found] for _ in range(MOST_SPLITS - 1))]
        )
    member = np.zeros((len(chosen), count))
    np.put_along_axis(member, chosen, 1.0, axis=1)
    return member
