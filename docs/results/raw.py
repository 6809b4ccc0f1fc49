"""Raw results as CSV files beside this one, and what tables are made of."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent

Raw = list[dict[str, str]]


def read(name: str) -> Raw:
    """The raw results of a table; none if it was not run."""
    path = HERE / f"{name}.csv"
    if not path.exists():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(name: str, lines: Sequence[dict[str, Any]]) -> None:
    """Write the raw results of a table.

    Raises:
        ValueError: where there are none, before the file is touched.
    """
    if not lines:
        raise ValueError(f"no raw results of {name}, whose file stays as it was: give the folder of its runs")
    with open(HERE / f"{name}.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)


def groups(raw: Raw, *keys: str) -> dict[tuple[str, ...], Raw]:
    """Lines with the same values under some keys, in order of appearance."""
    found: dict[tuple[str, ...], Raw] = {}
    for line in raw:
        found.setdefault(tuple(line[key] for key in keys), []).append(line)
    return found


def mean_of(values: Sequence[float | None]) -> str:
    """Mean over seeds with half of its interval; seeds without a value are counted, not averaged."""
    from ctgraph_rl.report import statistics

    found = statistics.mean(values)
    if found.value is None:
        return "-"
    interval = "" if found.low is None else f" ± {(found.high - found.low) / 2:.2f}"  # type: ignore[operator]
    missing = f" (n={found.n}/{len(values)})" if found.n_undefined else ""
    return f"{found.value:.2f}{interval}{missing}".replace("-0.00", "0.00")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
