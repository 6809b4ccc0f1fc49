"""An exact test whether scores of repeated runs are lower than the submitted ones, and its power."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

ALPHA, POWER = 0.05, 0.8
"""The largest chance to find a difference that is not there, and the chance to find one of the stated size."""

MOST_SPLITS = 1_000
"""Splits of the scores up to which all are tried; else as many random ones."""

SAMPLES = 4_000

ROUNDING = 1e-9
"""Sums of scores that differ by less are equal."""


class Difference(NamedTuple):
    """What a comparison found, and what it could have found."""

    submitted: float  # mean score
    found: float  # mean score of the runs that were made again
    p_value: float  # of scores that are lower by chance
    low: float  # the drop is larger, with a chance of 1 - `ALPHA`; infinite where so few scores do not say
    high: float  # the drop is smaller, with the same chance
    detectable: float  # the drop that is found with a chance of `POWER`, by the spread seen; infinite if none would be

    @property
    def is_lower(self) -> bool:
        """Whether the found scores are lower than by chance."""
        return self.p_value <= ALPHA

    @property
    def is_blind(self) -> bool:
        """Whether no scores could have been found to be lower."""
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
    """Test whether scores are lower than submitted ones, over all splits into groups of these sizes.

    The chance to call equal distributions different is at most `ALPHA`. The interval holds all drops that the test does
    not exclude, on either side. The stated power is of normal scores with the standard deviation within both groups.

    Args:
        submitted: at least one.
        found: at least one.
    """
    sizes = (len(submitted), len(found))
    before = np.array(submitted, dtype=np.float64)
    again = np.array(found, dtype=np.float64)
    squares = float(before.var()) * sizes[0] + float(again.var()) * sizes[1]
    spread = math.sqrt(squares / max(1, sum(sizes) - 2))
    reach = 2 * float(np.ptp([*submitted, *found])) + 1
    unit = detectable(*sizes)
    return Difference(
        float(before.mean()),
        float(again.mean()),
        float(_p_values(before, again)),
        low=find_least(lambda drop: _p_values(before, again + drop) > ALPHA, -reach, reach),
        high=-find_least(lambda drop: _p_values(-before, drop - again) > ALPHA, -reach, reach),
        detectable=unit if math.isinf(unit) else unit * spread,
    )


def runs_needed(submitted: int) -> int:
    """Return the fewest repeated runs with which the test can find a drop."""
    return next(n for n in range(1, math.ceil(1 / ALPHA) + 1) if 1 / math.comb(submitted + n, n) <= ALPHA)


@cache
def detectable(submitted: int, found: int) -> float:
    """Return the drop, in standard deviations of normal scores, found with a chance of `POWER`; infinite if none is."""
    if 1 / math.comb(submitted + found, found) > ALPHA:
        return math.inf
    noise = np.random.default_rng(0).standard_normal((SAMPLES, submitted + found))
    before = noise[:, :submitted]
    again = noise[:, submitted:]
    return find_least(lambda drop: (_p_values(before, again - drop) <= ALPHA).mean() >= POWER, 0.0, 4.0, halvings=14)


def _p_values(submitted: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Return the share of splits of scores [..., submitted] and [..., found] whose last group is as low, [...].

    scipy's ``permutation_test`` gives the same, but takes no group of one score.
    """
    splits = _splits(submitted.shape[-1] + found.shape[-1], found.shape[-1])
    sums = np.concatenate([submitted, found], axis=-1) @ splits.T
    return (sums <= sums[..., :1] + ROUNDING).mean(axis=-1)


@cache
def _splits(count: int, found: int) -> np.ndarray:
    """Return who is in the last group, float64 [splits, count]: first the true split, then all or many random ones."""
    if math.comb(count, found) <= MOST_SPLITS:
        chosen = np.array([*combinations(range(count), found)][::-1])  # the true one is the last
    else:
        rng = np.random.default_rng(0)
        drawn = [rng.permutation(count)[:found] for _ in range(MOST_SPLITS - 1)]
        chosen = np.array([np.arange(count - found, count), *drawn])
    member = np.zeros((len(chosen), count))
    np.put_along_axis(member, chosen, 1.0, axis=1)
    return member


def find_least(holds: Callable[[float], object], low: float, high: float, halvings: int = 40) -> float:
    """Return by halving the least value for which something holds, as for all above; minus infinity if for ``low``."""
    if holds(low):
        return -math.inf
    for _ in range(halvings):
        middle = (low + high) / 2
        if holds(middle):
            high = middle
        else:
            low = middle
    return high
