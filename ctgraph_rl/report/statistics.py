"""Statistics over seeds: what n runs of one agent say, and what they leave open.

Returns of solved and stuck runs have two humps. For such, Student's interval of a mean covers what it should from about
ten seeds on, and bootstraps of few seeds are too narrow; so means have Student's, shares of solved seeds the exact
interval, and the interquartile mean has a bootstrap from ten seeds on. A seed without a value is counted, never
replaced. Quantiles are scipy's: ``pip install 'ctgraph_rl[stats]'``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from ctgraph_rl.checks import fraction, is_int, positive, require

LEVEL = 0.95
LEAST_FOR_BOOTSTRAP = 10
RESAMPLES = 10_000
MOST_FLIPPED = 13
"""Pairs up to which all flips of signs are tried."""

ROUNDING = 1e-12
"""Sums that differ by less are equal."""

MOST_SEEDS = 2**20
"""Number of seeds at which `seeds_needed` gives up."""

Values = Sequence[float | None]


@dataclass(frozen=True)
class Estimate:
    """A number over seeds with its interval.

    Args:
        value: the estimate; None without enough seeds.
        low: lower end of the interval; None without one.
        high: upper end of the interval.
        n: seeds with a value.
        n_undefined: seeds without one.
        method: what the value and the interval are.
        reason: why value or interval are missing.
    """

    value: float | None
    low: float | None
    high: float | None
    n: int
    n_undefined: int
    method: str
    reason: str | None = None

    def __str__(self) -> str:
        """Value, interval and seeds, such as ``0.50 [0.25, 0.75] n = 9/10``."""
        value = "-" if self.value is None else f"{self.value:.2f}"
        interval = "" if self.low is None or self.high is None else f" [{self.low:.2f}, {self.high:.2f}]"
        missing = f"/{self.n + self.n_undefined}" if self.n_undefined else ""
        return f"{value}{interval} n = {self.n}{missing}"


@dataclass(frozen=True)
class Comparison:
    """Two agents on the same seeds.

    Args:
        difference: mean of first minus second, with Student's interval; pairs without both values are undefined.
        std: standard deviation of the differences, for `seeds_needed`; None below two pairs.
        p_value: of the test that flips signs of differences at random; exact up to `MOST_FLIPPED` pairs.
        wins: pairs in which the first is better.
        ties: pairs without a difference.
        losses: pairs in which the second is better.
    """

    difference: Estimate
    std: float | None
    p_value: float | None
    wins: int
    ties: int
    losses: int


def mean(values: Values, level: float = LEVEL) -> Estimate:
    """Mean with Student's t interval.

    One seed has no interval, nor have seeds that are all equal: theirs would have no width, which they do not support.

    Args:
        values: one per seed; None or NaN for a seed without.
        level: coverage of the interval.
    """
    _scipy_stats()
    require(*fraction(level=level))
    known, missing = _known(values)
    method = f"mean, Student t {level:.0%}"
    if len(known) == 0:
        return Estimate(None, None, None, 0, missing, method=method, reason="no seed has a value")
    centre = math.fsum(known) / len(known)
    if len(known) == 1 or min(known) == max(known):
        reason = "one seed has no interval" if len(known) == 1 else "all seeds are equal: no spread to estimate"
        return Estimate(centre, None, None, len(known), missing, method=method, reason=reason)
    half = _student(level, len(known) - 1) * np.std(known, ddof=1) / math.sqrt(len(known))
    return Estimate(centre, float(centre - half), float(centre + half), len(known), missing, method=method)


def solved_rate(solved: Sequence[bool | None], level: float = LEVEL) -> Estimate:
    """Share of seeds that solved a task, with the exact interval of Clopper and Pearson.

    Args:
        solved: one per seed; None for a seed without result.
        level: coverage of the interval.
    """
    stats = _scipy_stats()
    require(*fraction(level=level))
    known = [each for each in solved if each is not None]
    n, k, missing = len(known), sum(known), len(solved) - len(known)
    method = f"share, Clopper-Pearson {level:.0%}"
    if n == 0:
        return Estimate(None, None, None, 0, missing, method=method, reason="no seed has a result")
    interval = stats.binomtest(k, n).proportion_ci(level, method="exact")
    return Estimate(k / n, low=float(interval.low), high=float(interval.high), n=n, n_undefined=missing, method=method)


def interquartile_mean(
    values: Sequence[Values], level: float = LEVEL, resamples: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Mean of the middle half of all values of all tasks, with a percentile bootstrap stratified by task.

    Only from ten seeds on: with fewer the interval covers far less than it says.

    Args:
        values: for each task, one value per seed; None or NaN for a seed without.
        level: coverage of the interval.
        resamples: bootstrap samples.
        seed: of the bootstrap.
    """
    require(*fraction(level=level), (is_int(resamples, 100), f"resamples must be an integer >= 100, got {resamples!r}"))
    require((len(values) > 0, "interquartile_mean needs the values of at least one task"))
    known, missing = zip(*(_known(task) for task in values), strict=True)
    n, undefined = min(map(len, known)), max(missing)
    method = f"IQM, stratified percentile bootstrap {level:.0%}"
    if n < LEAST_FOR_BOOTSTRAP:
        reason = f"needs {LEAST_FOR_BOOTSTRAP} seeds of each task, got {n}"
        return Estimate(None, low=None, high=None, n=n, n_undefined=undefined, method=method, reason=reason)
    rng = np.random.default_rng(seed)
    samples = [rng.choice(task, (resamples, len(task))) for task in known]
    low, high = np.quantile(_middle_mean(np.concatenate(samples, axis=1)), [(1 - level) / 2, (1 + level) / 2])
    value = _middle_mean(np.concatenate(known)[None])[0]
    return Estimate(float(value), low=float(low), high=float(high), n=n, n_undefined=undefined, method=method)


def compare(first: Values, second: Values, level: float = LEVEL) -> Comparison:
    """The paired comparison of two agents.

    Args:
        first: one value per seed.
        second: the other agent's on the same seeds in the same order, with the same curriculum.
        level: coverage of the interval.

    Raises:
        ValueError: for different numbers of seeds.
    """
    require((len(first) == len(second), f"pairs need equally many seeds, got {len(first)} and {len(second)}"))
    pairs = [(_number(a), _number(b)) for a, b in zip(first, second, strict=True)]
    differences = [None if a is None or b is None else a - b for a, b in pairs]
    known, _ = _known(differences)
    signs = [(each > 0) - (each < 0) for each in known]
    std, p_value = (float(np.std(known, ddof=1)), _sign_flip(known)) if len(known) > 1 else (None, None)
    wins, ties, losses = (signs.count(sign) for sign in (1, 0, -1))
    return Comparison(mean(differences, level), std, p_value, wins=wins, ties=ties, losses=losses)


def seeds_needed(difference: float, std: float, paired: bool = False, level: float = LEVEL, power: float = 0.8) -> int:
    """Seeds of each agent that a t-test needs to find a difference of means with a given power.

    Args:
        difference: true difference of means, > 0.
        std: standard deviation over seeds, of one agent; of the differences if paired.
        paired: both agents on the same seeds.
        level: 1 - level is the chance to find a difference that is not there.
        power: the chance to find one that is.

    Raises:
        ValueError: for values out of range, and if `MOST_SEEDS` are not enough.
    """
    stats = _scipy_stats()
    require(*positive(difference=difference, std=std), *fraction(level=level, power=power))

    def finds(n: int) -> bool:
        freedom = n - 1 if paired else 2 * n - 2
        shift = difference / std * math.sqrt(n if paired else n / 2)
        limit = stats.t.ppf((1 + level) / 2, freedom)
        return float(stats.nct.sf(limit, freedom, shift) + stats.nct.cdf(-limit, freedom, shift)) >= power

    low, high = 1, 2
    while not finds(high):
        low, high = high, 2 * high
        require((high <= MOST_SEEDS, f"{MOST_SEEDS} seeds do not find a difference of {difference} at std {std}"))
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if finds(middle) else (middle, high)
    return high


@cache
def _student(level: float, freedom: int) -> float:
    """Half the width of Student's interval in standard errors; a report asks for it thousands of times."""
    return float(_scipy_stats().t.ppf((1 + level) / 2, freedom))


def _sign_flip(differences: Sequence[float]) -> float:
    """Two-sided p-value of the sum under all flips of signs, or under many random ones and the one found."""
    count = len(differences)
    if count <= MOST_FLIPPED:
        signs = np.array(list(product((1, -1), repeat=count)))
    else:
        signs = np.random.default_rng(0).choice((1, -1), (RESAMPLES, count))
        signs[0] = 1
    sums = np.abs(signs @ np.array(differences))
    return float((sums >= sums[0] * (1 - ROUNDING)).mean())


def _middle_mean(samples: np.ndarray) -> np.ndarray:
    """Mean of each row without its lowest and highest quarter, rounded down."""
    cut = samples.shape[1] // 4
    return np.sort(samples, axis=1)[:, cut : samples.shape[1] - cut].mean(axis=1)


def _known(values: Values) -> tuple[list[float], int]:
    """Values of seeds that have one, and the number of others."""
    known = [number for number in map(_number, values) if number is not None]
    return known, len(values) - len(known)


def _number(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else float(value)


def _scipy_stats() -> Any:
    """``scipy.stats``.

    Raises:
        ModuleNotFoundError: without scipy; names the extra to install.
    """
    try:
        from scipy import stats
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("statistics over seeds need scipy: pip install 'ctgraph_rl[stats]'") from error
    return stats
