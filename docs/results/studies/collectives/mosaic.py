"""MOSAIC on nested goals: the section of collectives.md, made of the raw results of collectives.

`texts` gives what the page's template names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, variance

from studies.collectives.l2d2c import BLOCKS
from studies.raw import Raw, groups, mean_of, numbers_in, read, select, table

CURRICULUM, DEPTHS = "ct28_mosaic_skips_d5", range(2, 10)
"""The curriculum of MOSAIC's members, a task each, and the depths of its tasks."""

HALF, ALL = "14", "28"
"""Members of the collectives: of the first two families of tasks, or of all four."""

SECOND_HALF = 14_000
"""Seeds of isolated members of the other two families, which are run as a collective of 14 of their own: this much more
than the seed of all 28, since member i has the seed of its collective + 1000 i."""

ALONE = (0.98, 0.98, 0.34, 0.11, 0.0, 0.0, 0.0, 0.0)
SHARED = (1.0, 0.99, 0.98, 0.95, 0.97, 0.91, 0.74, 0.58)
"""Published final returns at these depths, means over families and five seeds of the public raw data."""

COLUMNS = (
    ("isolated", "isolated", HALF, ALONE),
    ("MOSAIC", "mosaic", ALL, SHARED),
    ("MOSAIC without similarity", "mosaic_no_similarity", ALL, ()),
)
"""Title, exchange, members of a collective and published returns of the columns of one epoch."""

NAMES = {"isolated": "isolated", "mosaic": "MOSAIC", "mosaic_no_similarity": "MOSAIC without similarity"}
"""Exchanges and their names, in the order of the page."""

SUMS = {"isolated": (9.5, 1.0), "mosaic": (25.7, 0.8), "mosaic_no_similarity": (19.9, None)}
"""Published sums of the 28 final returns, means over five seeds, with half the width of their 95 % t-interval."""

NUM_PUBLISHED = 5


def blocks(exchange: str, num_members: str) -> Raw:
    """Return the blocks of the members of some collectives, one epoch: one for each seed and member."""
    lines = select(read(BLOCKS), curriculum=CURRICULUM, exchange=exchange)
    return select(lines, num_epochs="1", num_members=num_members)


def by_depth(exchange: str, num_members: str) -> dict[int, list[float]]:
    """Return final returns by depth: isolated members' own values, of others means of a seed."""
    found: dict[int, list[float]] = {}
    for depth in DEPTHS:
        lines = [line for line in blocks(exchange, num_members) if 1 + line["task"].count(".") == depth]
        samples = groups(lines, "seed", "member") if exchange == "isolated" else groups(lines, "seed")
        found[depth] = [fmean(numbers_in(sample, "final_return")) for sample in samples.values()]
    return found


def sums(exchange: str, num_members: str) -> list[float]:
    """Return the sum of the final returns of all members of each seed; isolated members are run in two halves."""
    halves = exchange == "isolated"
    lines = blocks(exchange, HALF if halves else num_members)
    found = {int(seed): math.fsum(numbers_in(each, "final_return")) for (seed,), each in groups(lines, "seed").items()}
    if not halves:
        return list(found.values())
    first = [seed for seed in found if seed < SECOND_HALF]
    if num_members == HALF:
        return [found[seed] for seed in first]
    return [found[seed] + found[seed + SECOND_HALF] for seed in first if seed + SECOND_HALF in found]


def sums_table() -> str:
    """Return the sums of final returns beside the published ones, of all members with Welch's 95 % interval."""
    rows = []
    for number in (HALF, ALL):
        for exchange, name in NAMES.items():
            if found := sums(exchange, number):
                row = [number, name, str(len(found)), mean_of(found, (0, int(number)))]
                rows.append([*row, *(published(exchange, found) if number == ALL else ("not stated", ""))])
    head = ["members", "exchange", "seeds", "sum of final returns", "published", "difference"]
    return table(head, rows)


def published(exchange: str, found: Sequence[float]) -> tuple[str, str]:
    """Return a published sum, and the difference of ours from it with its interval."""
    value, half = SUMS[exchange]
    low, high = welch(found, value, half)
    stated = f"{value}" if half is None else f"{value} \u00b1 {half}"
    return stated, f"{fmean(found) - value:+.1f} [{low:+.1f}, {high:+.1f}]"


def welch(found: Sequence[float], value: float, half: float | None) -> tuple[float, float]:
    """Return Welch's 95 % interval of a mean less a published one, whose own interval is value +- half.

    A published value without an interval is taken as exact.
    """
    from scipy.stats import t

    ours, count = variance(found) / len(found), len(found) - 1
    theirs = 0.0 if half is None else (half / t.ppf(0.975, NUM_PUBLISHED - 1)) ** 2
    freedom = (ours + theirs) ** 2 / (ours**2 / count + theirs**2 / (NUM_PUBLISHED - 1))
    error = t.ppf(0.975, freedom) * math.sqrt(ours + theirs)
    return fmean(found) - value - error, fmean(found) - value + error


def returns_table() -> str:
    """Return the final returns of members by the depths of their tasks, beside the published ones."""
    rows = []
    returns = [by_depth(exchange, number) for _, exchange, number, _ in COLUMNS]
    for place, depth in enumerate(DEPTHS):
        row = [str(depth)]
        for of_depth, (*_, stated) in zip(returns, COLUMNS, strict=True):
            values = of_depth[depth]
            row.append((f"{stated[place]:.2f}; " if stated else "") + (mean_of(values, (0, 1)) if values else "-"))
        rows.append(row)
    return table(["depth", *(name for name, *_ in COLUMNS)], rows)


def texts() -> dict[str, str]:
    """Return the tables of the page."""
    return {"mosaic": returns_table(), "mosaic_sums": sums_table()}
