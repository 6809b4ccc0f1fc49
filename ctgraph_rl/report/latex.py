"""Tables for papers: LaTeX with booktabs within the margins of ``article``, with caption and label.

A cell is a value over its interval, aligned at decimal points. Wide tables have several parts, long ones are several
tables. A part that is still too wide is scaled down.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence
from string import ascii_lowercase
from typing import NamedTuple

from ctgraph_rl.log.escape import latex_text

PREAMBLE = r"% needs \usepackage{booktabs,graphicx}, and \usepackage[T1]{fontenc} for names with < or >"

LINE_WIDTH = 345.0
"""Points of a line of ``article`` in letters of 10 points."""

COLUMN_SEPARATION = 8.0

LETTER = 5.2
"""Points of a letter in a name of 8 points; a digit has 4.3."""

COLUMN = 58.0
"""Points of a column of numbers: its broken heading, and an interval such as [-0.84, 0.84]."""

HEADING = 12

MOST_LINES = 40


class TableCell(NamedTuple):
    """A value and its interval as text, and the number of its note, from 1; 0 for none."""

    value: str
    interval: str = ""
    note: int = 0

    def __str__(self) -> str:
        return f"{self.value} {self.interval}".strip()


def as_cell(text: str, note: int = 0) -> TableCell:
    """Return a value and its interval, such as ``0.50 [0.25, 0.75]``, as a cell."""
    value, _, interval = text.partition(" ")
    return TableCell(value, interval, note)


TableRows = Sequence[tuple[str, Sequence[TableCell]]]


class Table(NamedTuple):
    """The heading of the first column, those of the others, rows, and notes."""

    caption: str
    label: str
    first: str
    head: Sequence[str]
    rows: TableRows
    notes: Sequence[str] = ()

    @property
    def texts(self) -> list[list[str]]:
        """The rows as texts, each with its name."""
        return [[name, *map(str, cells)] for name, cells in self.rows]


def document(tables: Iterable[Table]) -> str:
    """Return tables in LaTeX, each with another label of letters, digits and hyphens."""
    parts = [PREAMBLE]
    taken = set()
    for table in tables:
        stem = re.sub(r"[^a-z0-9]+", "-", table.label.lower()).strip("-")
        label = stem
        version = 1
        while label in taken:
            version += 1
            label = f"{stem}-v{version}"
        taken.add(label)
        parts.append(latex(table._replace(label=label)))
    return "\n\n".join(parts)


def latex(table: Table) -> str:
    """Return a table in LaTeX, or several if it is long."""
    widest = max([len(table.first), *(len(name) for name, _ in table.rows)])
    columns = max(2, int((LINE_WIDTH - LETTER * widest) // (COLUMN + COLUMN_SEPARATION)))
    starts = range(0, max(len(table.head), 1), columns)
    most = max(1, MOST_LINES // (2 * len(starts)))
    floats: list[str] = []
    for first in range(0, max(len(table.rows), 1), most):
        rows = table.rows[first : first + most]
        caption = latex_text(f"{table.caption} (part {len(floats) + 1})" if floats else table.caption)
        label = f"{table.label}-{len(floats) + 1}" if floats else table.label
        used: set[int] = set()
        for _, cells in rows:
            used.update(cell.note for cell in cells)
        notes = []
        for i in sorted(used - {0}):
            note = latex_text(table.notes[i - 1])
            notes.append(rf"\par\smallskip\raggedright\textsuperscript{{{letters(i)}}} {note}")
        head = [r"\begin{table}[htbp]", r"\centering", r"\setlength{\belowcaptionskip}{6pt}", rf"\caption{{{caption}}}"]
        head += [rf"\label{{tab:{label}}}", r"\footnotesize", r"\setlength{\tabcolsep}{4pt}"]
        bodies = [_tabular(table, rows, start, start + columns) for start in starts]
        floats.append("\n".join([*head, "\n\\par\\medskip\n".join(bodies), *notes, r"\end{table}"]))
    return "\n\n".join(floats)


def _tabular(table: Table, rows: TableRows, start: int, end: int) -> str:
    heads = [latex_text(table.first)]
    for name in table.head[start:end]:
        wrapped = textwrap.wrap(name, HEADING, break_long_words=False, break_on_hyphens=False)
        shown = r" \\ ".join(map(latex_text, wrapped))
        is_long = len(wrapped) > 1
        heads.append(rf"\begin{{tabular}}[b]{{@{{}}r@{{}}}}{shown}\end{{tabular}}" if is_long else shown)
    lines = [r"\sbox2{%", rf"\begin{{tabular}}{{@{{}}l{'r' * (len(heads) - 1)}@{{}}}}", r"\toprule"]
    lines += [" & ".join(heads) + r" \\", r"\midrule"]
    for name, cells in rows:
        values = [latex_text(name)]
        intervals = [""]
        for cell in cells[start:end]:  # the letter of a note takes no room: decimal points stay below each other
            mark = rf"\rlap{{\textsuperscript{{{letters(cell.note)}}}}}" if cell.note else ""
            values.append(signed(cell.value) + mark)
            intervals.append(rf"{{\scriptsize {signed(cell.interval)}}}" if cell.interval else "")
        lines.append(" & ".join(values) + r" \\")
        if any(intervals):
            lines.append(" & ".join(intervals) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}%", "}%"]
    return "\n".join([*lines, r"\ifdim\wd2>\linewidth\resizebox{\linewidth}{!}{\usebox2}\else\usebox2\fi"])


def signed(value: str) -> str:
    """Return minus, plus-minus and infinity as formulas, and a dash for none."""
    formula = value.replace("-", "$-$").replace("inf", r"$\infty$").replace("±", r"$\pm$")
    return "--" if value == "-" else formula


def letters(number: int) -> str:
    """Return the letters of a note, from 1: a to z, then aa; numbers would look like exponents."""
    rest, last = divmod(number - 1, len(ascii_lowercase))
    return (letters(rest) if rest else "") + ascii_lowercase[last]
