"""Tables of measures for readers, as text, Markdown and LaTeX."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from ctgraph_rl.log.escape import markdown_table, markdown_text, terminal_text
from ctgraph_rl.parsers import TABLE_FORMATS
from ctgraph_rl.report.latex import Table, TableCell, as_cell, document
from ctgraph_rl.runs.read import split_by

if TYPE_CHECKING:
    from ctgraph_rl.report.results import Row

NO_RUN_FINISHED = "every_metric"
"""The measure of an agent's only row if none of its runs finished."""

Modified = Mapping[str, str]

NOT_MODIFIED: Modified = {}

WIDTH = 80

MEANS = "mean [95 % CI]"
CI = "about 95 or more of 100 such intervals (CI) hold the true mean"
_EXACT = "intervals of solved seeds and of median times are exact"
LEGEND = f"{MEANS}; {CI}; {_EXACT}"

LEGENDS = {
    "exact": LEGEND,
    "t": f"mean [Student's 95 % CI]; {_EXACT}",
    "std": f"mean ± standard deviation over seeds; {_EXACT}",
    "iqm": f"interquartile mean [bootstrap 95 % CI]; {_EXACT}",
    "seeds": "single runs",
}
"""What the numbers of a table are, by `ctgraph_rl.parsers.STATISTICS`, and of a table of single runs."""

WHY_EXACT = (
    "--statistics exact: few seeds of bounded values need wider intervals than Student's or a bootstrap's; "
    "t, std and iqm show those."
)


def text(rows: Sequence[Row], modified: Modified = NOT_MODIFIED, legend: str = LEGEND) -> str:
    """Return the table for a terminal: a line for each measure of each curriculum and agent."""
    head = textwrap.fill(legend, WIDTH)
    if legend == LEGEND:
        head += "\n" + textwrap.fill(WHY_EXACT, WIDTH)
    for page in pages(rows):
        head += "\n\n" + _text(page, modified.get(page.curriculum))
    return head


def markdown(rows: Sequence[Row], modified: Modified = NOT_MODIFIED, legend: str = LEGEND) -> str:
    """Return a table in Markdown for each curriculum."""
    parts = []
    for page in pages(rows):
        parts.append(f"### {markdown_text(page.curriculum)}")
        if page.curriculum in modified:
            parts.append(f"Modified: {markdown_text(modified[page.curriculum])}")
        lines = [map(markdown_text, line) for line in page.lines]
        parts += [legend, markdown_table(("agent", "measure", "over seeds", "n", "note"), lines)]
        if page.notes:
            parts.append("\n".join(f"{number}. {markdown_text(note)}" for number, note in enumerate(page.notes, 1)))
    return "\n\n".join(parts)


def latex(rows: Sequence[Row], modified: Modified = NOT_MODIFIED, legend: str = LEGEND) -> str:
    """Return a table of agents and measures for each curriculum, by `ctgraph_rl.report.latex`."""
    return document(matrices(rows, modified, legend))


def matrices(rows: Sequence[Row], modified: Modified = NOT_MODIFIED, legend: str = LEGEND) -> Iterator[Table]:
    """Return each curriculum's table of agents and measures; the first column has the numbers of seeds."""
    for curriculum, its in split_by(rows, lambda row: row.curriculum).items():
        notes = _notes(its)
        measures = split_by(its, lambda row: row.measure)
        measures.pop(NO_RUN_FINISHED, None)
        lines = []
        for agent, own in split_by(its, lambda row: row.shown).items():
            cells = dict.fromkeys(measures, TableCell("-"))
            most = max(own, key=lambda row: row.estimate.n)
            for row in own:
                if row.measure in cells:
                    cells[row.measure] = as_cell(row.estimate.shown, notes.index(row.note) + 1 if row.note else 0)
            lines.append((agent, [TableCell(most.estimate.seeds), *cells.values()]))
        what = f" Modified: {modified[curriculum]}." if curriculum in modified else ""
        caption = f"{curriculum}: {legend}; n: seeds with a value / seeds expected.{what}"
        head = ("n", *map(measure_name, measures))
        yield Table(caption, f"{curriculum} measures", "agent", head, rows=lines, notes=notes)


def _notes(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row.note for row in rows if row.note))


def measure_name(measure: str) -> str:
    """Return a measure's name for readers, such as ``average performance``."""
    return measure.replace("_", " ")


FORMATS: dict[str, Callable[[Sequence[Row], Modified, str], str]] = dict(
    zip(TABLE_FORMATS, (text, markdown, latex), strict=True)
)
SENTENCES: dict[str, Callable[[str], str]] = {
    **{"text": terminal_text, "markdown": markdown_text, "latex": lambda plain: f"% {terminal_text(plain)}"}
}


class Line(NamedTuple):
    """A row in the form that is shown."""

    agent: str
    measure: str
    value: str
    n: str
    mark: str  # number of its note, or nothing


class Page(NamedTuple):
    """The lines of a curriculum, and their notes by number."""

    curriculum: str
    lines: list[Line]
    notes: list[str]


def pages(rows: Sequence[Row]) -> Iterator[Page]:
    """Yield the shown rows of each curriculum."""
    for curriculum, its in split_by(rows, lambda row: row.curriculum).items():
        notes = _notes(its)
        lines = []
        for row in its:
            estimate = row.estimate
            mark = str(notes.index(row.note) + 1) if row.note else ""
            lines.append(Line(row.shown, measure_name(row.measure), estimate.shown, estimate.seeds, mark))
        yield Page(curriculum, lines, notes)


def _text(page: Page, modified: str | None) -> str:
    lines = [Line(*map(terminal_text, line)) for line in page.lines]
    _, measures, values, counts, _ = (max(map(len, column)) for column in zip(*lines, strict=True))
    widest = sum((measures, values, counts)) + len("      n =     (9)")
    gap = "  " if widest < WIDTH else " "
    shown = [terminal_text(page.curriculum)]
    agent = None
    if modified:
        about = terminal_text(f"modified: {modified}")
        shown.append(textwrap.fill(about, WIDTH, initial_indent="  ", subsequent_indent="    "))
    for line in lines:
        if line.agent != agent:
            agent = line.agent
            shown.append(f"  {agent}")
        note = f"({line.mark})" if line.mark else ""
        shown.append(
            f"    {line.measure:{measures}}{gap}{line.value:{values}}{gap}n = {line.n:{counts}}{gap}{note}".rstrip()
        )
    for number, note in enumerate(page.notes, 1):
        text = f"({number}) {terminal_text(note)}"
        shown.append(textwrap.fill(text, WIDTH, initial_indent="  ", subsequent_indent="      "))
    return "\n".join(shown)
