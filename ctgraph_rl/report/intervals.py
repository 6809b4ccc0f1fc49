"""Intervals of a mean and of a median, and bounds of values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from importlib import import_module
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from ctgraph_rl.metrics.bounds import NOISE


class Bounds(NamedTuple):
    """The lowest and highest value that a seed can have, infinite where unknown.

    Bounds of the mean over seeds, such as the optimum, bound no seed; with them the interval would miss the mean.
    """

    low: float
    high: float

    def widened(self, noise: float) -> Bounds:
        """Return the bounds of values with normal noise; all but 1 of 15,000 values at a bound are within.

        Args:
            noise: standard deviation in a seed's value, such as ``reward_std`` over the root of the episodes.
        """
        return Bounds(self.low - NOISE * noise, self.high + NOISE * noise)

    def of_differences(self) -> Bounds:
        """Return the bounds of the difference of two values."""
        return Bounds(self.low - self.high, self.high - self.low)


UNBOUNDED = Bounds(-math.inf, math.inf)

ROUNDING = 1e-6
"""How far a value may exceed its bounds, as a share of them: rewards are float32."""

SCALED_DIGITS = 12
"""Digits of scaled values: the last bits decide nothing."""

GRID = 65
"""Places at which a distribution is computed to find a quantile, `REFINEMENTS` times."""

REFINEMENTS = 3


@cache
def student(level: float, freedom: int) -> float:
    """Half the width of Student's interval in standard errors."""
    return float(scipy("stats").t.ppf((1 + level) / 2, freedom))


def gaffke(values: Sequence[float], bounds: Bounds, level: float) -> tuple[float, float]:
    """Return Gaffke's interval of a mean of values within bounds."""
    low, high = bounds
    spread = high - low
    if spread == 0:
        return low, high
    scaled = np.sort(np.clip((np.array(values) - low) / spread, 0, 1).round(SCALED_DIGITS))
    tail = (1 - level) / 2
    least = _least_mean(tuple(scaled.tolist()), tail)
    most = 1 - _least_mean(tuple((1 - scaled[::-1]).round(SCALED_DIGITS).tolist()), tail)
    return low + spread * least, low + spread * most


@lru_cache(maxsize=2**16)
def _least_mean(values: tuple[float, ...], tail: float) -> float:
    """Return a quantile of the mean of values and one more 0, with uniform weights that sum to 1.

    The mean has the density of a B-spline with the values as knots (Curry and Schoenberg 1966). For zeros and ones it
    is a beta distribution, as of Clopper and Pearson.

    Args:
        values: in [0, 1], rising.
        tail: the probability below.
    """
    n = len(values)
    if values[0] == values[-1]:
        return values[0] * tail ** (1 / n)
    ones = values.count(1)
    if ones + values.count(0) == n:
        return float(scipy("special").betaincinv(ones, n - ones + 1, tail))
    below = scipy("interpolate").BSpline.basis_element([0.0, *values]).antiderivative()
    grid = np.linspace(0, values[-1], GRID)
    for _ in range(REFINEMENTS):
        shares = below(grid) * (n / values[-1])
        place = int(np.clip(np.searchsorted(shares, tail), 1, GRID - 1))
        lower = grid[place - 1]
        upper = grid[place]
        at = shares[place - 1]
        to = shares[place]
        grid = np.linspace(lower, upper, GRID)
    return float(lower + (upper - lower) * (tail - at) / (to - at)) if to > at else float(lower)


def within_bounds(known: Sequence[float], bounds: Bounds) -> bool:
    """Return whether values are within bounds, but for rounding."""
    low, high = bounds
    slack = ROUNDING * max([1.0, *(abs(bound) for bound in (low, high) if math.isfinite(bound))])
    return all(low - slack <= value <= high + slack for value in known)


@cache
def median_ranks(n: int, level: float) -> int:
    """Return the largest k for which the k-th smallest and largest of n values cover the median; 0 for none."""
    tails = accumulate(math.comb(n, i) / 2**n for i in range((n + 1) // 2))
    return sum(tail <= (1 - level) / 2 for tail in tails)


def scipy(part: str) -> Any:
    """Return a module of scipy.

    Raises:
        ModuleNotFoundError: without scipy; names the extra to install.
    """
    try:
        import_module("scipy")
        return import_module(f"scipy.{part}")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("statistics over seeds need scipy: pip install 'ctgraph_rl[stats]'") from error
