"""Statistics over seeds: what n runs of one agent say, and what they leave open.

``docs/explanation/statistics.md`` has the coverage of these intervals by simulation:

- A share, and a mean of values with known bounds: Gaffke's interval, that of Clopper and Pearson for two outcomes.
- A mean of values without two known bounds: Student's interval, cut at a known bound.
- A time: the interval of the median by order statistics, where a seed that never got there took infinitely long.

Other papers show `mean` without bounds (Student's interval), `mean_and_std` and `iqm`, rliable's interquartile mean. A
seed without a value is counted, never replaced. Quantiles are scipy's: ``pip install 'ctgraph_rl[stats]'``.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from statistics import fmean, median
from typing import Any

import numpy as np

from ctgraph_rl.checks import at_least_one, fraction, is_int, not_negative, positive, require, takes_numbers
from ctgraph_rl.report.intervals import UNBOUNDED, Bounds, gaffke, median_ranks, scipy, student, within_bounds

LEVEL = 0.95
LEAST_FOR_BOOTSTRAP = 10
RESAMPLES = 10_000
BATCH = 1000

MOST_FLIPPED = 16
"""Pairs up to which all flips of signs are tried."""

ROUNDING = 1e-12

EQUAL_SEEDS = "all seeds are equal; few seeds leave other means possible, and the interval shows which"

MOST_SEEDS = 2**20
"""Seeds at which `seeds_needed` gives up."""


Values = Sequence[float | None]
LowHigh = tuple[float, float] | Bounds
"""Lowest and highest possible value; infinite where unknown."""


@dataclass(frozen=True)
class Estimate:
    """A number over seeds with its interval.

    Args:
        value: None without enough seeds.
        n: seeds with a value.
        n_undefined: seeds without one.
        method: what value and interval are.
        reason: why value or interval are missing, or why an interval of equal seeds is wide.
        low: lower end of the interval, if any.
        high: upper end.
        std: standard deviation over seeds, shown in place of an interval.
        digits: after the point, where it is shown.

    Raises:
        ValueError: for an interval without a value, with one end, or that excludes its value.
    """

    value: float | None
    n: int
    n_undefined: int
    method: str
    reason: str | None = None
    low: float | None = None
    high: float | None = None
    std: float | None = None
    digits: int = 2

    def __post_init__(self) -> None:
        if (self.low, self.high) != (None, None):
            has_all = None not in (self.low, self.value, self.high)
            holds = has_all and self.low <= self.value <= self.high  # type: ignore[operator]
            got = f"{self.value} and [{self.low}, {self.high}]"
            require((holds, f"an interval must have two ends around its value, got {got}"))

    def __str__(self) -> str:
        """Value, interval and seeds, such as ``0.50 [0.25, 0.75] n = 9/10``, or ``0.50 ± 0.10 n = 10``."""
        return f"{self.shown} n = {self.seeds}"

    @property
    def shown(self) -> str:
        """The value, with its interval or standard deviation."""
        form = f"z.{self.digits}f"
        value = "-" if self.value is None else f"{self.value:{form}}"
        if self.std is not None:
            return f"{value} ± {self.std:{form}}"
        return value if self.low is None or self.high is None else f"{value} [{self.low:{form}}, {self.high:{form}}]"

    @property
    def seeds(self) -> str:
        """The seeds with a value, and all if some have none."""
        return f"{self.n}/{self.n + self.n_undefined}" if self.n_undefined else f"{self.n}"


@dataclass(frozen=True)
class Comparison:
    """Two agents on the same seeds.

    Args:
        difference: mean of first minus second, with its interval; pairs without both values are undefined.
        std: standard deviation of the differences; None below two pairs.
        p_value: of random flips of the differences' signs; exact up to `MOST_FLIPPED` pairs.
        wins: pairs in which the first is better.
        ties: pairs without a difference.
        losses: pairs in which the second is better.
        holm: the p-value corrected for all comparisons, if these are known.
        needed: pairs that would find such a difference, from `pairs_needed`; None where it was found, is 0, or the
            number of comparisons is unknown.
    """

    difference: Estimate
    std: float | None
    p_value: float | None
    wins: int
    ties: int
    losses: int
    holm: float | None = None
    needed: int | None = None


@takes_numbers
def mean(values: Values, level: float = LEVEL, bounds: LowHigh = UNBOUNDED) -> Estimate:
    """Return the mean with Gaffke's interval where both bounds are known, else with Student's.

    One seed has no interval, nor have equal seeds without both bounds.

    Args:
        values: one per seed; None or NaN for a seed without.
        bounds: lowest and highest value of a seed (`Bounds`); a value outside makes them none.
    """
    require(*fraction(level=level))
    known, missing = _known(values)
    limits = _checked(bounds)
    within = within_bounds(known, limits)
    bounded = within and math.isfinite(limits.high - limits.low)
    method = f"mean, {'Gaffke' if bounded else 'Student t'} {level:.0%}"
    if len(known) == 0:
        return _nothing(missing, method)
    centre = fmean(known)
    reason = None if within else f"a value is outside [{limits.low:g}, {limits.high:g}]"
    low: float | None = None
    high: float | None = None
    if len(known) == 1:
        reason = "one seed has no interval"
    elif bounded:
        low, high = gaffke(known, limits, level)
        low = min(low, centre)
        high = max(high, centre)
        if min(known) == max(known) and limits.low < limits.high:
            reason = EQUAL_SEEDS
    elif min(known) == max(known):
        reason = "all seeds are equal: no spread to estimate"
    else:
        half = float(student(level, len(known) - 1) * np.std(known, ddof=1) / math.sqrt(len(known)))
        lowest, highest = limits if within else UNBOUNDED
        low = min(max(lowest, centre - half), centre)
        high = max(min(highest, centre + half), centre)
    return Estimate(centre, len(known), missing, method, reason, low=low, high=high)


def constant(values: Values) -> Estimate:
    """Return a number that follows from the curriculum: exact, without an interval."""
    known, missing = _known(values)
    if not known:
        return _nothing(missing, "exact")
    return Estimate(fmean(known), len(known), missing, "exact")


@takes_numbers
def mean_and_std(values: Values) -> Estimate:
    """Return the mean with the standard deviation over seeds, with n - 1 in its denominator.

    Args:
        values: one per seed; None or NaN for a seed without.
    """
    known, missing = _known(values)
    method = "mean, standard deviation over seeds"
    if not known:
        return _nothing(missing, method)
    std = float(np.std(known, ddof=1)) if len(known) > 1 else None
    reason = "one seed has no standard deviation" if std is None else None
    return Estimate(fmean(known), len(known), missing, method, reason, std=std)


@takes_numbers
def iqm(values: Sequence[Values], level: float = LEVEL, resamples: int = RESAMPLES, seed: int = 0) -> Estimate:
    """Return the interquartile mean with a stratified bootstrap, as rliable (Agarwal et al. 2021).

    The value is `scipy.stats.trim_mean` of a quarter at each side of all values together. The interval has percentiles
    of `scipy.stats.bootstrap`, which draws the seeds of each task apart; with few seeds it covers less than stated.

    Args:
        values: for each task, one value per seed; None or NaN for a seed without.
    """
    stats = scipy("stats")
    known, n, undefined = _of_tasks(values, "iqm", level, resamples)
    method = f"IQM, percentiles of a stratified bootstrap {level:.0%}"
    if n == 0:
        return _nothing(undefined, method)
    value = float(stats.trim_mean(np.concatenate(known), 0.25))
    if n == 1:
        return Estimate(value, 1, undefined, method, "one seed has no interval")

    def middle(*tasks: np.ndarray, axis: int) -> np.ndarray:
        return np.asarray(stats.trim_mean(np.concatenate(tasks, axis=axis), 0.25, axis=axis))

    found = stats.bootstrap(
        known,
        middle,
        n_resamples=resamples,
        batch=BATCH,
        vectorized=True,
        confidence_level=level,
        method="percentile",
        random_state=np.random.default_rng(seed),
    )
    low = min(value, float(found.confidence_interval.low))
    high = max(value, float(found.confidence_interval.high))
    reason = "the bootstrap samples are equal: no spread to estimate" if low == high else None
    return Estimate(value, n, undefined, method, reason, low=low, high=high)


@takes_numbers
def solved_rate(solved: Sequence[bool | None], level: float = LEVEL) -> Estimate:
    """Return the share of seeds that solved a task, with the exact interval of Clopper and Pearson.

    Args:
        solved: one per seed; None for a seed without result.
    """
    require(*fraction(level=level))
    known = [float(each) for each in solved if each is not None]
    missing = len(solved) - len(known)
    method = f"share, Clopper-Pearson {level:.0%}"
    if not known:
        return _nothing(missing, method, "no seed has a result")
    low, high = gaffke(known, Bounds(0.0, 1.0), level)
    return Estimate(sum(known) / len(known), len(known), missing, method, low=low, high=high)


@takes_numbers
def median_time(times: Values, level: float = LEVEL) -> Estimate:
    """Return the median of times, with the interval from the k-th smallest to the k-th largest.

    k is the largest that keeps the level. At 95 % fewer than six seeds have an interval from 0 to infinity.

    Args:
        times: one per seed, >= 0; infinite for a seed that never got there, None or NaN for one without result.
    """
    require(*fraction(level=level))
    known, missing = _known(times)
    require((min(known, default=0.0) >= 0, f"times must be >= 0, got {min(known, default=0.0)}"))
    n = len(known)
    method = f"median, order statistics {level:.0%}"
    if n == 0:
        return _nothing(missing, method)
    ordered = [0.0, *sorted(known), math.inf]
    k = median_ranks(n, level)
    reason = None if k else f"the range of the times covers {1 - 0.5 ** (n - 1):.0%}"
    return Estimate(median(known), n, missing, method, reason, low=ordered[k], high=ordered[n + 1 - k])


@takes_numbers
def interquartile_mean(
    values: Sequence[Values],
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
    *,
    bounds: LowHigh = UNBOUNDED,
) -> Estimate:
    """Return the mean of the middle half of all tasks' values, with a bootstrap stratified by task.

    Seeds have random weights for each task; one more value stands at known bounds, as in Gaffke's interval. Fewer than
    ten seeds have no value, as their interval would cover far less than stated.

    Args:
        values: for each task, one value per seed; None or NaN for a seed without.
    """
    known, n, undefined = _of_tasks(values, "interquartile_mean", level, resamples)
    lowest, highest = _checked(bounds)
    method = f"IQM, stratified bootstrap {level:.0%}"
    if n < LEAST_FOR_BOOTSTRAP:
        reason = f"needs {LEAST_FOR_BOOTSTRAP} seeds of each task, got {n}"
        return Estimate(None, n, undefined, method, reason)
    rng = np.random.default_rng(seed)
    limits = []
    for bound, tail in ((lowest, (1 - level) / 2), (highest, (1 + level) / 2)):
        added = [bound] if math.isfinite(bound) else []
        tasks = [[*task, *added] for task in known]
        weights = [rng.dirichlet(np.ones(len(task)), resamples) / len(tasks) for task in tasks]
        together = np.concatenate(tasks)
        order = np.argsort(together)
        below = np.cumsum(np.concatenate(weights, axis=1)[:, order], axis=1).clip(0.25, 0.75)
        parts = np.diff(below, axis=1, prepend=0.25)  # of the middle half
        limits.append(float(np.quantile(2 * parts @ together[order], tail)))
    pooled = np.sort(np.concatenate(known))
    cut = len(pooled) // 4
    value = float(pooled[cut : len(pooled) - cut].mean())
    low = min(limits[0], value)
    high = max(limits[1], value)
    return Estimate(value, n, undefined, method, low=low, high=high)


@takes_numbers
def compare(first: Values, second: Values, level: float = LEVEL, bounds: LowHigh = UNBOUNDED) -> Comparison:
    """Return the paired comparison of two agents.

    Args:
        first: one value per seed.
        second: the other agent's on the same seeds and curriculum, in the same order.

    Raises:
        ValueError: for different numbers of seeds.
    """
    require((len(first) == len(second), f"pairs need equally many seeds, got {len(first)} and {len(second)}"))
    differences = []
    for a, b in zip(map(_number, first), map(_number, second), strict=True):
        differences.append(None if a is None or b is None else a - b)
    known, _ = _known(differences)
    signs = [(each > 0) - (each < 0) for each in known]
    std = float(np.std(known, ddof=1)) if len(known) > 1 else None
    p_value = _sign_flip(known) if len(known) > 1 else None
    difference = mean(differences, level, _checked(bounds).of_differences())
    return Comparison(difference, std, p_value, wins=signs.count(1), ties=signs.count(0), losses=signs.count(-1))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Return p-values corrected for their number by Holm's procedure, at most 1; None does not count.

    The chance that any is below 0.05 without a difference is at most 5 %.
    """
    known = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, i) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * p))
        corrected[i] = largest
    return corrected


def corrected(found: Mapping[Any, Comparison]) -> dict[Any, Comparison]:
    """Return comparisons with corrected p-values and needed pairs."""
    p_values = holm([each.p_value for each in found.values()])
    count = sum(p is not None for p in p_values)
    complete = {}
    for (pair, each), p in zip(found.items(), p_values, strict=True):
        needed = None
        seen = each.difference.value
        if seen and each.std is not None and p is not None and p > 1 - LEVEL:
            with suppress(ValueError):  # more than `MOST_SEEDS`
                needed = pairs_needed(seen, each.std, count)
        complete[pair] = replace(each, holm=p, needed=needed)
    return complete


@takes_numbers
def pairs_needed(difference: float, std: float, comparisons: int = 1, level: float = LEVEL) -> int:
    """Return with how many pairs `compare` finds a difference with a chance of 80 %.

    They are those of `seeds_needed`, and enough that the test's smallest p-value, 2 / 2^n, suffices. Both are corrected
    for the number of comparisons (Bonferroni).

    Args:
        difference: true difference of means, other than 0.
        std: standard deviation of the pairs' differences, >= 0.
        comparisons: how many are made.
        level: 1 - level is the chance to find a false difference in any of them.

    Raises:
        ValueError: for values out of range, and if `MOST_SEEDS` are not enough.
    """
    require(*at_least_one(comparisons=comparisons), *not_negative(std=std), *fraction(level=level))
    chance = (1 - level) / comparisons
    fewest = 2
    while 2 / 2**fewest > chance:
        fewest += 1
    return max(fewest, seeds_needed(abs(difference), std, paired=True, level=1 - chance)) if std else fewest


@takes_numbers
def seeds_needed(difference: float, std: float, paired: bool = False, level: float = LEVEL, power: float = 0.8) -> int:
    """Return the seeds of each agent that a t-test needs to find a difference of means with a given power.

    Args:
        difference: true difference of means, > 0.
        std: standard deviation over one agent's seeds; of the differences if paired.
        paired: both agents on the same seeds.
        level: 1 - level is the chance to find a false difference.
        power: the chance to find a true one.

    Raises:
        ValueError: for values out of range, and if `MOST_SEEDS` are not enough.
    """
    stats = scipy("stats")
    require(*positive(difference=difference, std=std), *fraction(level=level, power=power))

    def finds(n: int) -> bool:
        freedom = n - 1 if paired else 2 * n - 2
        shift = difference / std * math.sqrt(n if paired else n / 2)
        limit = stats.t.ppf((1 + level) / 2, freedom)
        return float(stats.nct.sf(limit, freedom, shift) + stats.nct.cdf(-limit, freedom, shift)) >= power

    high = 2
    while not finds(high):
        high *= 2
        require((high <= MOST_SEEDS, f"{MOST_SEEDS} seeds do not find a difference of {difference} at std {std}"))
    return bisect_left(range(high), True, lo=high // 2 + 1, key=finds)


def _nothing(missing: int, method: str, reason: str = "no seed has a value") -> Estimate:
    return Estimate(None, 0, missing, method, reason)


def _of_tasks(values: Sequence[Values], who: str, level: float, resamples: int) -> tuple[list[list[float]], int, int]:
    require(*fraction(level=level), (is_int(resamples, 100), f"resamples must be an integer >= 100, got {resamples!r}"))
    require((len(values) > 0, f"{who} needs the values of at least one task"))
    known, missing = zip(*map(_known, values), strict=True)
    return list(known), min(map(len, known)), max(missing)


def _checked(bounds: LowHigh) -> Bounds:
    found = Bounds(*bounds)
    require((found.low <= found.high, f"bounds must be a lowest and a highest value, got {tuple(bounds)}"))
    return found


def _sign_flip(differences: Sequence[float]) -> float:
    count = len(differences)
    if count <= MOST_FLIPPED:
        signs = np.array(list(product((1, -1), repeat=count)))
    else:
        signs = np.random.default_rng(0).choice((1, -1), (RESAMPLES, count))
        signs[0] = 1
    sums = np.abs(signs @ np.array(differences))
    return float((sums >= sums[0] * (1 - ROUNDING)).mean())


def _known(values: Values) -> tuple[list[float], int]:
    known = [number for number in map(_number, values) if number is not None]
    return known, len(values) - len(known)


def _number(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else float(value)
