"""A one-sided two-sample Kolmogorov-Smirnov test with exact p-values, as SciPy is optional here."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

MOST_VALUES = 1000
"""Of both samples together; with more, float64 overflows."""


def ks_greater(first: ArrayLike, second: ArrayLike) -> float:
    """Return the exact p-value of the hypothesis that two samples of real numbers have the same distribution.

    It is small where the second sample is larger: the statistic is the largest F(x) - G(x) of the empirical
    distribution functions. The same as ``scipy.stats.ks_2samp(first, second, alternative="greater", method="exact")``
    for continuous distributions.

    Args:
        first: [m], at least one.
        second: [n], at least one; m + n is at most `MOST_VALUES`.
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

    The order of all values is a path from (0, 0) to (m, n); all paths are equally likely. ``after[i]`` counts paths
    from (i, j) that reach i n - j m >= most, for j from n down to 0.
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
