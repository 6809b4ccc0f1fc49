"""The verdict on a sentence: computed from effects in the direction of the sentence, one a seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import Comparison, Estimate
from studies.raw import Raw, shown

AGREES = "agrees"
DISAGREES = "disagrees"
UNKNOWN = "cannot be said"
VERDICTS = (AGREES, DISAGREES, UNKNOWN)

SHARES = (-1.0, 1.0)
"""Bounds of a difference of two shares, and of the shares of pairs for a sentence less those against it."""

ALPHA = 0.05
"""Of all tests."""

MOST_SEEDS = 200
STEPS = 40
"""Halvings that find the smallest effect."""


@dataclass(frozen=True)
class Effect:
    """What runs say of a sentence.

    Args:
        values: the effect in the direction of the sentence, one for each independent seed; None for a seed without.
        counts: the smallest effect that counts as what the sentence claims, > 0.
        room: the largest effect that these runs could have had, such as what a return of the others leaves below 1.
        bounds: the lowest and the highest possible effect.
        absent: whether the sentence says that there is no such effect.
    """

    values: Sequence[float | None]
    counts: float
    room: float
    bounds: tuple[float, float] = SHARES
    absent: bool = False

    @property
    def estimate(self) -> Estimate:
        """The mean with its interval."""
        return statistics.mean(self.values, bounds=self.bounds)

    @property
    def verdict(self) -> str:
        """Whether the runs agree with the sentence, disagree, or cannot say."""
        found = self.estimate
        if found.low is None or found.high is None or self.room < self.counts:
            return UNKNOWN
        if found.low > 0:
            return DISAGREES if self.absent else AGREES
        if found.high < self.counts:
            return AGREES if self.absent else DISAGREES
        return UNKNOWN

    @property
    def smallest(self) -> float | None:
        """The smallest mean that would have had an interval above 0 with these seeds, moved together; None for none."""
        known = [value for value in self.values if value is not None]
        low, high = self.bounds

        def moved(by: float) -> list[float]:
            return [min(high, max(low, value + by)) for value in known]

        def is_seen(by: float) -> bool:
            found = statistics.mean(moved(by), bounds=self.bounds).low
            return found is not None and found > 0

        least, most = low - high, high - low
        if len(known) < 2 or not is_seen(most):
            return None
        for _ in range(STEPS):
            middle = (least + most) / 2
            if is_seen(middle):
                most = middle
            else:
                least = middle
        return fmean(moved(most))

    @property
    def seeds(self) -> int | None:
        """Seeds that would see the smallest effect that counts: with this spread, and if all had just this effect.

        None where fewer than `MOST_SEEDS` that all had this effect would not see it.
        """
        equal = next((n for n in range(2, MOST_SEEDS) if _sees_equal(self.counts, n, self.bounds)), None)
        known = [value for value in self.values if value is not None]
        spread = statistics.compare(known, [0.0] * len(known)).std
        if equal is None or not spread:
            return equal
        return max(equal, statistics.seeds_needed(self.counts, spread, paired=True))


def _sees_equal(effect: float, n: int, bounds: tuple[float, float]) -> bool:
    """Return whether n seeds that all have an effect have an interval above 0."""
    low = statistics.mean([effect] * n, bounds=bounds).low
    return low is not None and low > 0


def undecided(found: Comparison, number: int = 1) -> str:
    """Return a difference that a test did not find, with its interval and the pairs that would do.

    Args:
        found: the comparison.
        number: of all comparisons that p-values are corrected for.

    Raises:
        ValueError: for a difference that was found, p <= 0.05 after the correction.
    """
    p_value = found.p_value if found.holm is None else found.holm
    if p_value is None or p_value <= ALPHA:
        raise ValueError(f"a difference of p = {p_value} is not undecided: the page says otherwise")
    needed = seeds_that_would_do(found, number)
    return shown(found.difference) + (f" ({needed:,} pairs would do)" if needed else "")


def seeds_that_would_do(found: Comparison, number: int = 1) -> int | None:
    """Return the pairs that a t-test needs to find a difference like this, and at least those of a test by signs.

    None where there is no difference.

    Args:
        found: the comparison.
        number: of all comparisons that p-values are corrected for; Bonferroni's level, which Holm's is not below.
    """
    alpha = ALPHA / number
    least = math.ceil(math.log2(2 / alpha))
    if not found.difference.value:
        return None
    if not found.std:
        return least
    needed = statistics.seeds_needed(abs(found.difference.value), found.std, paired=True, level=1 - alpha)
    return max(least, needed)


def pairs(first: Raw, second: Raw) -> list[tuple[dict[str, str], dict[str, str]]]:
    """Return the runs of two sets with equal seeds.

    Raises:
        ValueError: where a set has two runs of a seed, or the seeds differ.
    """
    seeds = [[line["seed"] for line in lines] for lines in (first, second)]
    if not first or seeds[0] != seeds[1] or len(set(seeds[0])) < len(seeds[0]):
        raise ValueError(f"pairs need the same seeds, each once, got {seeds[0]} and {seeds[1]}")
    return list(zip(first, second, strict=True))


def differences(first: Raw, second: Raw, column: str) -> list[float]:
    """Return the differences of a column, first less second, for each seed."""
    return [float(one[column]) - float(other[column]) for one, other in pairs(first, second)]


def time(text: str) -> float:
    """Return a time of a table; empty is a time that was not reached, later than all that were."""
    return float(text) if text else math.inf


def later(first: str, second: str) -> int:
    """Return 1 where the first time is later than the second, -1 where it is earlier, and 0 where neither is."""
    return (time(first) > time(second)) - (time(first) < time(second))


def shares_later(first: Raw, second: Raw, columns: Sequence[str]) -> list[float]:
    """Return for each seed the share of its times that are later in the first runs, less the share of earlier ones."""
    signs = [[later(one[column], other[column]) for column in columns] for one, other in pairs(first, second)]
    return [fmean(of_seed) for of_seed in signs]


def share_reached(first: Raw, second: Raw, columns: Sequence[str]) -> float:
    """Return the share of pairs of times of which at least one was reached: the others are ties, whatever is true."""
    return fmean(bool(one[column] or other[column]) for one, other in pairs(first, second) for column in columns)
