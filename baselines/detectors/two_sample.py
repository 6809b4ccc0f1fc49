"""A one-sided two-sample Kolmogorov-Smirnov test with exact p-values: SciPy, which has one, is optional here."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

MOST_VALUES = 1000
"""Of both samples together; with more the number of ways to mix them overflows a float64."""


def ks_greater(first: ArrayLike, second: ArrayLike) -> float:
    """Return the p-value of the hypothesis that the values of two samples have the same distribution.

    It is small where the second sample has larger values: the statistic is the largest F(x) - G(x), with the empirical
    distribution functions F and G of the samples. It is exact for continuous distributions, and the same as
    ``scipy.stats.ks_2samp(first, second, alternative="greater", method="exact")``.

    Args:
        first: real numbers [m], at least one.
        second: real numbers [n], at least one; m + n is at most `MOST_VALUES`.
    """
    x = np.sort(np.asarray(first, dtype=np.float64))
    y = np.sort(np.asarray(second, dtype=np.float64))
    both = np.concatenate([x, y])
    below_x = np.searchsorted(x, both, side="right")
    below_y = np.searchsorted(y, both, side="right")
    most = (below_x * len(y) - below_y * len(x)).max()
    return _exact(len(x), len(y), int(most))


@lru_cache(maxsize=4096)
def _exact(m: int, n: int, most: int) -> float:
    """Return the probability that F - G reaches most / (m n).

    The order of all values is a path from (0, 0) to (m, n), and all paths are equally likely. ``after[i]`` counts the
    paths from (i, j) on that reach i n - j m >= most, for j from n down to 0.
    """
    after: NDArray[Any] = np.zeros(m + 1)
    for j in range(n, -1, -1):
        smallest = -(-(most + j * m) // n)  # i that reaches it
        reached = min(max(smallest, 0), m + 1)
        all_paths = [math.comb(m - i + n - j, n - j) for i in range(reached, m + 1)]
        after = np.append(after[:reached], all_paths)
        inside = np.append(after[:reached], after[reached : reached + 1])
        after[:reached] = inside[::-1].cumsum()[::-1][:reached]
    return float(after[0] / math.comb(m + n, n))
