"""Raw results in CSV files, and what tables are made of."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from string import Template

from ctgraph_rl.report import statistics
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.report.statistics import Estimate

HERE = Path(__file__).resolve().parents[1]
"""Where raw results, pages and pictures are."""

Raw = list[dict[str, str]]

MACHINE = ("machine", "cpu")
"""Columns for the kind of machine, with its instruction set, and the CPU's model; earlier files lack them."""

NOT_RECORDED = "not recorded"


def read(name: str) -> Raw:
    """The raw results of a table; none if there are none."""
    path = HERE / f"{name}.csv"
    if not path.exists():
        return []
    return [dict(line) for line in _lines(path, path.stat().st_mtime_ns)]


@lru_cache(maxsize=8)
def _lines(path: Path, changed: int) -> Raw:
    """Return the lines of a file, which are read again where it has changed."""
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def machines(*names: str) -> str:
    """A sentence about the machines that the rows of tables are of."""
    rows = [line for name in names for line in read(name)]
    counts = Counter(", ".join(dict.fromkeys(line.get(key) or NOT_RECORDED for key in MACHINE)) for line in rows)
    return "; ".join(f"{count:,} rows: {what}" for what, count in sorted(counts.items()))


def fill(name: str, texts: Mapping[str, object]) -> str:
    """Return a page: its template with the texts that it names."""
    return Template((HERE / "templates" / f"{name}.md").read_text(encoding="utf-8")).substitute(texts)


def select(lines: Raw, **values: str) -> Raw:
    """Return the lines with some values."""
    return [line for line in lines if all(line[key] == value for key, value in values.items())]


def groups(raw: Raw, *keys: str) -> dict[tuple[str, ...], Raw]:
    """Lines with the same values under some keys, in order of appearance."""
    found: dict[tuple[str, ...], Raw] = {}
    for line in raw:
        found.setdefault(tuple(str(line[key]) for key in keys), []).append(line)
    return found


def numbers_in(lines: Raw, column: str) -> list[float]:
    """A column, one number for each seed."""
    return [float(line[column]) for line in lines]


def mean_of(values: Sequence[float | None], bounds: tuple[float, float] | Bounds) -> str:
    """Mean over seeds with its interval; seeds without a value are counted, not averaged.

    Args:
        values: one per seed; None for a seed without.
        bounds: the lowest and the highest possible value.
    """
    return shown(statistics.mean(values, bounds=bounds))


def share_of(solved: Sequence[bool]) -> str:
    """How many of the seeds, with the exact interval of their share."""
    return f"{sum(solved)} of {len(solved)}{interval_of(statistics.solved_rate(solved))}"


def shown(found: Estimate) -> str:
    """A value and its interval, such as ``1.00 [0.48, 1]``."""
    if found.value is None:
        return "-"
    missing = f" (n={found.n}/{found.n + found.n_undefined})" if found.n_undefined else ""
    return f"{_number(found.value)}{interval_of(found)}{missing}"


def interval_of(found: Estimate) -> str:
    """The interval in brackets; nothing without one."""
    if found.low is None or found.high is None:
        return ""
    low, high = (_number(end).removesuffix(".00") for end in (found.low, found.high))
    return f" [{low}, {high}]"


def _number(value: float) -> str:
    return f"{value:.0f}" if 100 <= abs(value) < math.inf else f"{value:.2f}".replace("-0.00", "0.00")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    texts = [f"| {' | '.join(line)} |" for line in (head, *rows)]
    texts.insert(1, f"|{'---|' * len(head)}")
    return "\n".join(texts)
