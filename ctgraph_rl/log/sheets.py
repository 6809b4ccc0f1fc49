"""Tables in no particular format, and as text, Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from rich.cells import cell_len
from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

from ctgraph_rl.log.escape import latex_text, markdown_text, terminal_text

LISTED = {"name": "l", "version": "r", "tasks": "r", "frames": "r", "fingerprint": "l", "source": "l"}

MATHS = {
    "P_R": "$P_R$",
    "P_E": "$P_E$",
    "P_RNP": r"$P_\mathrm{RNP}$",
    "E[rho]": r"$E[\rho]$",
    "E[kappa]": r"$E[\kappa]$",
    "b": "$b$",
    "d": "$d$",
    "p": "$p$",
}
WIDE = 60


WIDTH = 100


@dataclass(frozen=True)
class Sheet:
    """A table.

    Args:
        columns: names, each with ``l`` or ``r`` for alignment.
    """

    title: str
    columns: Mapping[str, str]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def print_sheet(sheet: Sheet, console: Console | None = None) -> None:
    """Print a table; into a pipe `WIDTH` characters wide, or as wide as numbers and names need."""
    console = Console() if console is None else console
    table = Table(title=_shown(sheet.title), title_justify="left", caption_justify="left")
    for i, (name, side) in enumerate(sheet.columns.items()):
        is_whole = i == 0 or side == "r"
        widest = max(cell_len(row[i]) for row in (tuple(sheet.columns), *sheet.rows)) if is_whole else None
        justify: JustifyMethod = "right" if side == "r" else "left"
        table.add_column(_shown(name), justify=justify, no_wrap=is_whole, min_width=widest)
    for row in sheet.rows:
        table.add_row(*map(_shown, row))
    if not console.is_terminal:
        console.width = max(WIDTH, Console(width=10**6).measure(table).minimum)
    console.print(table)
    for note in sheet.notes:
        console.print(_shown(note))


def _shown(text: str) -> Text:
    return Text(terminal_text(text))


def to_markdown(sheet: Sheet) -> str:
    """A table in Markdown, with its title as a heading."""
    sides = ["--:" if side == "r" else ":--" for side in sheet.columns.values()]
    lines = ["| " + " | ".join(map(markdown_text, row)) + " |" for row in (tuple(sheet.columns), *sheet.rows)]
    text = [f"## {markdown_text(sheet.title)}", "", lines[0], f"| {' | '.join(sides)} |", *lines[1:]]
    for note in sheet.notes:
        text += ["", markdown_text(note)]
    return "\n".join([*text, ""])


def to_latex(sheet: Sheet) -> str:
    """A table for the LaTeX package booktabs; title and notes as comments."""
    sides = []
    for i, side in enumerate(sheet.columns.values()):
        is_wide = any(len(row[i]) > WIDE for row in sheet.rows)
        sides.append(r"p{0.6\linewidth}" if is_wide else side)
    header = " & ".join(MATHS.get(name, latex_text(name)) for name in sheet.columns)
    lines = [" & ".join(map(latex_text, row)) + r" \\" for row in sheet.rows]
    notes = [f"% {terminal_text(line)}" for line in (sheet.title, *sheet.notes)]
    begin = rf"\begin{{tabular}}{{{''.join(sides)}}}"
    end = r"\end{tabular}"
    return "\n".join([*notes, begin, r"\toprule", header + r" \\", r"\midrule", *lines, r"\bottomrule", end, ""])


FORMATS: dict[str, Callable[[Sheet], str]] = {"markdown": to_markdown, "latex": to_latex}


def with_numbers(sheet: Sheet) -> Sheet:
    """Return a table whose last column, of long repeated texts, has numbers that notes below explain."""
    texts = list(dict.fromkeys(row[-1] for row in sheet.rows))
    rows = tuple((*row[:-1], str(texts.index(row[-1]) + 1)) for row in sheet.rows)
    return replace(sheet, rows=rows, notes=tuple(f"{number}: {text}" for number, text in enumerate(texts, 1)))


def show(sheets: Sequence[Sheet], form: str) -> None:
    """Print tables as ``text``, or in one of `FORMATS`."""
    if form == "text":
        for sheet in sheets:
            print_sheet(sheet)
    else:
        print("\n".join(map(FORMATS[form], sheets)), end="")
