"""The interval of a number of two groups of seeds, such as runs and experts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctgraph_rl.report.statistics import LEVEL, RESAMPLES, Estimate


def two_groups(
    first: np.ndarray,
    second: np.ndarray,
    measure: Callable[[np.ndarray, np.ndarray], np.ndarray],
    bounds: tuple[float, float] = (0.0, 1.0),
) -> Estimate:
    """Return a number of the means of two groups of seeds, such as forward transfer, with the uncertainty of both.

    The seeds of each group have random weights, and one more seed stands at the bound that makes the number small for
    its lower limit, and large for its upper one: Gaffke's interval for two groups. Groups are weighted independently,
    which is too wide rather than too narrow where seeds of both are alike.

    Args:
        first: what the number rises with, float64 [seeds, tasks].
        second: what it falls with, float64 [other seeds, tasks].
        measure: the number of two means, [..., tasks] and [..., tasks] to [...]; monotone, and may be infinite.
        bounds: the lowest and the highest possible value of either group.
    """
    lowest, highest = bounds
    method = f"two groups, weighted {LEVEL:.0%}"
    n = min(len(first), len(second))
    value = float(measure(first.mean(0), second.mean(0)))
    if n < 2:
        return Estimate(value, n, 0, method, "one seed has no interval")
    rng = np.random.default_rng(0)
    limits = []
    for ends, tail in (((lowest, highest), (1 - LEVEL) / 2), ((highest, lowest), (1 + LEVEL) / 2)):
        means = []
        for group, end in zip((first, second), ends, strict=True):
            weights = rng.dirichlet(np.ones(len(group) + 1), RESAMPLES)
            means.append(weights @ np.vstack([group, np.full(group.shape[1], end)]))
        limits.append(float(np.quantile(measure(*means), tail, method="lower" if tail < 0.5 else "higher")))
    return Estimate(value, n, 0, method, low=min(limits[0], value), high=max(limits[1], value))
