"""The verdict on a sentence: computed from effects in the direction of the sentence, one a seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from ctgraph_rl.board.two_samples import find_least
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

OF_PAIRS = 0.5
"""The smallest effect on times that counts: three of four pairs are later and one is earlier."""

MOST_SEEDS = 200


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
        """`verdict_at` a level of 0.95."""
        return self.verdict_at(ALPHA)

    def verdict_at(self, alpha: float) -> str:
        """Return whether the runs agree with the sentence, disagree, or cannot say, by an interval of 1 - alpha."""
        found = statistics.mean(self.values, level=1 - alpha, bounds=self.bounds)
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

        if len(known) < 2 or not is_seen(high - low):
            return None
        return fmean(moved(find_least(is_seen, low - high, high - low)))

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


def kept_by_holm(effects: Sequence[Effect]) -> set[int]:
    """Return the places of the effects whose verdicts stand after Holm's correction for their number."""
    kept: set[int] = set()
    found: set[int] | None = None
    while found is None or found - kept:
        kept |= found or set()
        alpha = ALPHA / max(1, len(effects) - len(kept))
        decided = [(place, each) for place, each in enumerate(effects) if each.verdict != UNKNOWN]
        found = {place for place, each in decided if each.verdict_at(alpha) == each.verdict}
    return kept


def _sees_equal(effect: float, n: int, bounds: tuple[float, float]) -> bool:
    """Return whether n seeds that all have an effect have an interval above 0."""
    low = statistics.mean([effect] * n, bounds=bounds).low
    return low is not None and low > 0


def undecided(found: Comparison) -> str:
    """Return a difference that a test did not find, with its interval and the pairs that would do.

    Args:
        found: the comparison; one that is not corrected for others is the only one.

    Raises:
        ValueError: for a difference that was found, p <= 0.05 after the correction.
    """
    if found.holm is None:
        found = statistics.corrected({"": found})[""]
    if found.holm is None or found.holm <= ALPHA:
        raise ValueError(f"a difference of p = {found.holm} is not undecided: the page says otherwise")
    return shown(found.difference) + (f" ({found.needed:,} pairs would do)" if found.needed else "")


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


def compare_times(first: Raw, second: Raw, columns: Sequence[str]) -> tuple[str, Effect]:
    """Return the effect "the first runs are later" in words, and as a value for each seed."""
    signs = []
    reached = []
    for one, other in pairs(first, second):
        signs.append([later(one[column], other[column]) for column in columns])
        reached += [bool(one[column] or other[column]) for column in columns]
    return effect_of_signs(signs, fmean(reached))


def effect_of_signs(signs: Sequence[Sequence[int]], reached: float) -> tuple[str, Effect]:
    """Return the share of later times less that of earlier ones, in words and as an effect.

    Args:
        signs: of each seed, what `later` returns.
        reached: the share of pairs of which at least one time was reached: the others are ties, whatever is true.
    """
    all_signs = [sign for of_seed in signs for sign in of_seed]
    words = f"later in {all_signs.count(1)} of {len(all_signs)} pairs, earlier in {all_signs.count(-1)}"
    return words, Effect([fmean(of_seed) for of_seed in signs], OF_PAIRS, reached)
