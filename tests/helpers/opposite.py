"""Raw results that say the opposite: with the sign turned, with groups that changed their names, or emptied."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from helpers.paths import CHECKOUT

FOLDER = CHECKOUT / "docs" / "results"

Lines = list[dict[str, str]]


class Table(NamedTuple):
    """A table of raw results: its columns of outcomes, and those that tell groups apart."""

    name: str
    outcomes: tuple[str, ...]
    groups: tuple[str, ...]


def mirror(lines: Lines, table: Table) -> None:
    """Turn the sign: the highest value of a column becomes its lowest."""
    for column in table.outcomes:
        known = {line[column] for line in lines if line[column] not in ("", "not recorded")}
        ends = min(map(float, known)) + max(map(float, known))
        for line in lines:
            if line[column] in known:
                line[column] = str(ends - float(line[column]))


def shuffle(lines: Lines, table: Table) -> None:
    """Give each group the name of the next one."""
    for column in table.groups:
        names = sorted({line[column] for line in lines if line[column]})
        following = dict(zip(names, [*names[1:], names[0]], strict=True))
        for line in lines:
            line[column] = following.get(line[column], line[column])


def empty(lines: Lines, table: Table) -> None:
    """Empty the columns of outcomes."""
    for line in lines:
        line.update(dict.fromkeys(table.outcomes, ""))


def write_changed(tables: Sequence[Table], change: Callable[[Lines, Table], None], folder: Path) -> None:
    """Write the stored tables to a folder with a change."""
    lines = {}
    for table in tables:
        with open(FOLDER / f"{table.name}.csv", newline="", encoding="utf-8") as file:
            lines[table.name] = list(csv.DictReader(file))
    for table in tables:
        change(lines[table.name], table)
    for name, of in lines.items():
        write(name, of, folder)


def write(name: str, lines: Sequence[Mapping[str, object]], folder: Path) -> None:
    """Write raw results."""
    path = folder / f"{name}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)
