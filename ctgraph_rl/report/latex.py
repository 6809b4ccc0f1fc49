"""Tables for papers: LaTeX with booktabs that stays within the margins of ``article``, with caption and label.

A cell is a value over its interval. Values of a column end in the same number of decimals and stand at its right side,
so that their decimal points are below each other. Wide tables have several parts below each other, and long ones are
several tables. A part that is still wider than a line, as for long names, is scaled down to it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from string import ascii_lowercase
from typing import NamedTuple

from ctgraph_rl.log.escape import latex_text

PREAMBLE = r"% needs \usepackage{booktabs,graphicx}, and \usepackage[T1]{fontenc} for names with < or >"

LINE_WIDTH = 345.0
"""Points of a line of ``article`` with its usual letters of 10 points."""

COLUMN_SEPARATION = 8.0
"""Points between two columns."""

LETTER = 5.2
"""Points of a letter in a name, in letters of 8 points; those of a digit are 4.3."""

COLUMN = 58.0
"""Points of a column of numbers: of its heading, broken into lines, and of an interval such as [-0.84, 0.84]."""

HEADING = 12
"""Characters of a heading's line."""

MOST_LINES = 40
"""Lines of numbers in a table."""


class TableCell(NamedTuple):
    """A value with its interval, each as text, and the number of its note, from 1; 0 for none."""

    value: str
    interval: str = ""
    note: int = 0


TableRows = Sequence[tuple[str, Sequence[TableCell]]]
"""Rows with their names."""


class Table(NamedTuple):
    """A table: the heading of the first column, those of the others, rows, and notes."""

    caption: str
    label: str
    first: str
    head: Sequence[str]
    rows: TableRows
    notes: Sequence[str] = ()


def latex(table: Table) -> str:
    """Return a table in LaTeX, or several where it is long."""
    columns = _columns(table)
    parts = [(start, min(start + columns, len(table.head))) for start in range(0, max(len(table.head), 1), columns)]
    most = max(1, MOST_LINES // (2 * len(parts)))
    floats: list[str] = []
    for start in range(0, max(len(table.rows), 1), most):
        floats.append(_float(table, table.rows[start : start + most], parts, len(floats) + 1))
    return "\n\n".join(floats)


def _columns(table: Table) -> int:
    """Return how many columns of numbers fit beside the names of the rows."""
    names = max((len(name) for name, _ in table.rows), default=0)
    room = LINE_WIDTH - LETTER * max(names, len(table.first))
    return max(2, int(room // (COLUMN + COLUMN_SEPARATION)))


def _float(table: Table, rows: TableRows, parts: Sequence[tuple[int, int]], number: int) -> str:
    """Return one table with its parts."""
    again = f" (part {number})" if number > 1 else ""
    label = f"{table.label}-{number}" if number > 1 else table.label
    used: set[int] = set()
    for _, cells in rows:
        used.update(cell.note for cell in cells)
    notes = []
    for i in sorted(used - {0}):
        note = latex_text(table.notes[i - 1])
        notes.append(rf"\par\smallskip\raggedright\textsuperscript{{{letters(i)}}} {note}")
    bodies = [_tabular(table, rows, part) for part in parts]
    head = [r"\begin{table}[htbp]", r"\centering", r"\setlength{\belowcaptionskip}{6pt}"]
    head += [rf"\caption{{{latex_text(table.caption + again)}}}"]
    head += [rf"\label{{tab:{label}}}", r"\footnotesize", r"\setlength{\tabcolsep}{4pt}"]
    return "\n".join([*head, "\n\\par\\medskip\n".join(bodies), *notes, r"\end{table}"])


def _tabular(table: Table, rows: TableRows, part: tuple[int, int]) -> str:
    """Return some columns of a table, scaled down where they are wider than a line."""
    start, end = part
    heads = [latex_text(table.first), *map(_heading, table.head[start:end])]
    lines: list[str] = []
    for name, cells in rows:
        lines += _lines(name, cells[start:end])
    inner = [
        rf"\begin{{tabular}}{{@{{}}l{'r' * (end - start)}@{{}}}}",
        r"\toprule",
        " & ".join(heads) + r" \\",
        r"\midrule",
    ]
    inner += [*lines, r"\bottomrule", r"\end{tabular}%"]
    fitted = r"\ifdim\wd2>\linewidth\resizebox{\linewidth}{!}{\usebox2}\else\usebox2\fi"
    return "\n".join([r"\sbox2{%", *inner, "}%", fitted])


def _heading(name: str) -> str:
    """Return a heading of several lines, right-aligned as its column is."""
    lines: list[str] = []
    for word in name.split():
        fits = lines and len(lines[-1]) + 1 + len(word) <= HEADING
        lines[-1:] = [f"{lines[-1]} {word}"] if fits else [*lines[-1:], word]
    shown = r" \\ ".join(map(latex_text, lines))
    return shown if len(lines) < 2 else rf"\begin{{tabular}}[b]{{@{{}}r@{{}}}}{shown}\end{{tabular}}"


def _lines(name: str, cells: Sequence[TableCell]) -> Iterator[str]:
    """Yield the line of a row's values, and that of their intervals where there are any."""
    yield " & ".join([latex_text(name), *map(_value, cells)]) + r" \\"
    if any(cell.interval for cell in cells):
        intervals = (rf"{{\scriptsize {signed(cell.interval)}}}" if cell.interval else "" for cell in cells)
        yield " & ".join(["", *intervals]) + r" \\"


def _value(cell: TableCell) -> str:
    """Return a value; the letter of its note takes no room, so that decimal points stay below each other."""
    mark = rf"\rlap{{\textsuperscript{{{letters(cell.note)}}}}}" if cell.note else ""
    return signed(cell.value) + mark


def signed(value: str) -> str:
    """Return numbers with minus, plus-minus and infinity as formulas, and a dash for none."""
    formula = value.replace("-", "$-$").replace("inf", r"$\infty$").replace("±", r"$\pm$")
    return "--" if value == "-" else formula


def letters(number: int) -> str:
    """Return the letters of a note, from 1: a to z, then aa; no number, which would be read as an exponent."""
    rest, last = divmod(number - 1, len(ascii_lowercase))
    return (letters(rest) if rest else "") + ascii_lowercase[last]


class Labels:
    """Gives every table of a document its own label."""

    def __init__(self) -> None:
        self._taken: set[str] = set()

    def new(self, *names: str) -> str:
        """Return a label of letters, digits and hyphens that was not given before."""
        stem = re.sub(r"[^a-z0-9]+", "-", "-".join(names).lower()).strip("-")
        label = stem
        version = 1
        while label in self._taken:
            version += 1
            label = f"{stem}-v{version}"
        self._taken.add(label)
        return label
