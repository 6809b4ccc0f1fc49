"""MOSAIC on nested goals: the section of collectives.md, made of the raw results of collectives.

`texts` gives what the page's template names.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from statistics import median

from collective_runs import BLOCKS
from raw import Raw, groups, mean_of, numbers_in, read, table

CURRICULUM, DEPTHS, BATCH = "ct28_mosaic_skips_d5", range(2, 9), 512
"""The curriculum of MOSAIC's members, the depths of its first two families, a member each, and frames of a batch."""

ALONE = (0.98, 0.98, 0.34, 0.11, 0.0, 0.0, 0.0)
SHARED = (1.0, 0.99, 0.98, 0.95, 0.97, 0.91, 0.74)
"""Published final returns at these depths, means over four families and five seeds of the public raw data."""

PUBLISHED = (
    ("isolated, 1 epoch", "isolated", "1", ALONE),
    ("isolated, 8 epochs", "isolated", "8", ALONE),
    ("MOSAIC, 1 epoch", "mosaic", "1", SHARED),
    ("MOSAIC, 8 epochs", "mosaic", "8", SHARED),
)
"""Title, exchange, epochs and published returns of the columns with which a published number is compared."""

NAMES = {"isolated": "isolated", "mosaic": "MOSAIC", "mosaic_no_similarity": "MOSAIC without similarity"}
"""Exchanges and their names, in the order of the page."""

SUMS = {"isolated": "9.5", "mosaic": "25.7", "mosaic_no_similarity": "19.9"}
"""Published sums of the 28 final returns, means over five seeds."""

HALF, ALL = "14", "28"
"""Members of the collectives: of the first two families, or of all four."""

FOUND_ALONE = ("13", "34", "69, 7 of 20", *["not stated"] * 4)
FOUND_SHARED = ("not stated", "not stated", "32", "42", "48", "58", "68")
"""Published batches until a return of 0.9 at these depths, medians over the runs that reached it."""


def blocks(exchange: str, num_epochs: str, num_members: str = HALF) -> Raw:
    """Return the blocks of the members of some collectives: one for each seed and member."""
    cell = (CURRICULUM, exchange, num_epochs, num_members)
    return groups(read(BLOCKS), "curriculum", "exchange", "num_epochs", "num_members").get(cell, [])


def by_depth(exchange: str, num_epochs: str, column: str = "final_return") -> dict[int, list[float]]:
    """Return a column of blocks by depth: isolated members' own values, of others means of a seed."""
    found: dict[int, dict[tuple[str, str], list[float]]] = {}
    for line in blocks(exchange, num_epochs):
        if line[column]:
            sample = (line["seed"], line["member"] if exchange == "isolated" else "")
            depth = 1 + line["task"].count(".")
            found.setdefault(depth, {}).setdefault(sample, []).append(float(line[column]))
    return {depth: [sum(each) / len(each) for each in found[depth].values()] for depth in sorted(found)}


def sums(exchange: str, num_members: str) -> list[float]:
    """Return the sum of the final returns of all members of each seed."""
    seeds = groups(blocks(exchange, "1", num_members), "seed")
    return [sum(numbers_in(seed, "final_return")) for seed in seeds.values()]


def sums_table() -> str:
    """Return the sums of final returns beside the published ones."""
    rows = []
    for number in (HALF, ALL):
        for exchange, name in NAMES.items():
            if found := sums(exchange, number):
                published = SUMS[exchange] if number == ALL else "not stated"
                rows.append([number, name, str(len(found)), mean_of(found, (0, int(number))), published])
    return table(["members", "exchange", "seeds", "sum of final returns", "published"], rows)


def returns_table() -> str:
    """Return the final returns of members by the depths of their tasks, beside the published ones."""
    head, rows = ["depth", *(name for name, *_ in PUBLISHED), "MOSAIC without similarity"], []
    columns = [*((exchange, epochs) for _, exchange, epochs, _ in PUBLISHED), ("mosaic_no_similarity", "1")]
    returns = [by_depth(*column) for column in columns]
    for depth in DEPTHS:
        cells = [mean_of(each[depth], (0, 1)) if depth in each else "not run" for each in returns]
        stated = [f"{values[depth - 2]:.2f}; " for *_, values in PUBLISHED]
        rows.append([str(depth), *(there + cell for there, cell in zip([*stated, ""], cells, strict=True))])
    return table(head, rows)


def times_table() -> str:
    """Return the batches until members first have a return of 0.9, by depth, beside the published ones."""
    found: dict[tuple[str, int], list[str]] = {}
    for exchange in NAMES:
        for line in blocks(exchange, "1"):
            found.setdefault((exchange, 1 + line["task"].count(".")), []).append(line["frames_to_learn"])
    rows = []
    for depth, alone, shared in zip(DEPTHS, FOUND_ALONE, FOUND_SHARED, strict=True):
        ours = [_batches(found.get((exchange, depth), [])) for exchange in NAMES]
        rows.append([str(depth), f"{alone}; {ours[0]}", f"{shared}; {ours[1]}", ours[2]])
    return table(["depth", *NAMES.values()], rows)


def _batches(frames: Sequence[str]) -> str:
    """Return the median number of batches of those who reached it, and how many did where not all did."""
    reached = sorted(int(each) // BATCH for each in frames if each)
    middle = f"{median(reached):g}" if reached else "never"
    return f"{middle}, {len(reached)} of {len(frames)}" if 0 < len(reached) < len(frames) else middle


def agreements() -> str:
    """Return which published returns lie in the intervals of our own, and which do not."""
    from ctgraph_rl.report import statistics

    lines = []
    for name, exchange, epochs, published in PUBLISHED:
        within, beyond = [], []
        for depth, values in by_depth(exchange, epochs).items():
            found = statistics.mean(values, bounds=(0, 1))
            if found.low is not None and found.high is not None:
                inside = found.low - 0.005 <= published[depth - 2] <= found.high + 0.005
                (within if inside else beyond).append(str(depth))
        if within or beyond:
            inside, outside = (", ".join(depths) or "none" for depths in (within, beyond))
            lines.append(f"- {name}: in the interval at depth {inside}; not at {outside}.")
    return "\n".join(lines)


def settled(num_epochs: str) -> tuple[float, int]:
    """Return the mean share of batches below 0.9 of isolated members that once had more, and their number."""
    shares = [each for values in by_depth("isolated", num_epochs, "share_below").values() for each in values]
    return sum(shares) / len(shares), len(shares)


def runs() -> str:
    """Return how many seeds there are of each exchange."""
    kinds = product((HALF, ALL), ("1", "8"), NAMES)
    counts = {kind: len({line["seed"] for line in blocks(kind[2], kind[1], kind[0])}) for kind in kinds}
    parts = [
        f"{count} of {NAMES[exchange]} with {number} members and {epochs} epoch{'s' * (epochs != '1')}"
        for (number, epochs, exchange), count in counts.items()
        if count
    ]
    return ", ".join(parts)


def texts() -> dict[str, str]:
    """Return what the template of the page names."""
    found = {
        "mosaic": returns_table(),
        "mosaic_times": times_table(),
        "agreements": agreements(),
        "mosaic_sums": sums_table(),
        "mosaic_runs": runs(),
    }
    for epochs in ("1", "8"):
        share, count = settled(epochs)
        found |= {f"below_{epochs}": f"{share:.2f}", f"below_n_{epochs}": str(count)}
    return found
