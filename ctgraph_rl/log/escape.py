"""Names, labels, sources, settings and reasons as text for each kind of output, whatever they hold.

They may come from other people. `terminal_text` also serves HTML, whose template escapes it, and JSON. Characters that
cannot be printed, such as escape sequences, marks of writing direction and halves of surrogate pairs, are shown as in
Python, ``\x1b``.
"""

from __future__ import annotations

import argparse
import csv
import html
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from ctgraph_rl.disk import in_words

FORMULA = ("=", "+", "-", "@", "\t", "\r", "'")
"""Beginnings of a CSV cell that programs may take for a formula, and the mark."""

MARK = "'"
"""Stands before a CSV text that begins with one of `FORMULA`; readers take one off."""

_INACTIVE = re.compile(r"-?[\d,]+(\.\d+)?( \[-?[\d.]+, -?[\d.]+\])?( n = [\d/]+)?")
_MARKDOWN = re.compile(
    r"[\\`*|~$@\[\]]|(?<![^\W_])_|_(?![^\W_])"  # anywhere; underscores between letters mean nothing
    r"|:(?=//)|(?<=www)\."  # addresses
    r"|^#(?=[# ]|$)|^[-+=](?=[-= ]|$)",  # at the start of a line
    re.IGNORECASE,
)
_NUMBERED = re.compile(r"^(\d{1,9})([.)])(?= |$)")
_LATEX = str.maketrans(
    {
        **{character: f"\\{character}" for character in "&%$#_{}"},
        **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
        **{"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}"},
        "±": r"$\pm$",
        **{"[": "{[}", "*": "{*}"},  # which would belong to the end of the line before
    }
)


def terminal_text(text: object) -> str:
    """Return one line without characters that a terminal obeys."""
    return _printable(" ".join(str(text).split()))


def terminal_lines(text: object) -> str:
    """Return lines without characters that a terminal obeys."""
    return "\n".join(map(_printable, str(text).split("\n")))


def _printable(text: str) -> str:
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def listed(values: Iterable[object], most: int = 3) -> str:
    """Return the first of some values as text, and the number of others."""
    texts = list(map(str, values))
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def markdown_text(text: object) -> str:
    """Return one line that Markdown shows unchanged: no link, image, HTML, formula or end of a cell."""
    line = terminal_text(text)
    if _INACTIVE.fullmatch(line):
        return line
    line = _MARKDOWN.sub(lambda found: "\\" + found[0], html.escape(line, quote=False))
    return _NUMBERED.sub(r"\1\\\2", line)


def markdown_table(head: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table of Markdown cells."""
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], f"|{'---|' * len(head)}", *lines[1:]])


def latex_text(text: object) -> str:
    """Return one line that LaTeX shows unchanged, also after a table's row."""
    return terminal_text(text).translate(_LATEX)


def figure_text(text: object) -> str:
    """Return one line that matplotlib shows unchanged."""
    return terminal_text(text).replace("$", r"\$")


def csv_text(rows: Iterable[Iterable[Any]], end: str = "\n") -> str:
    """Return rows as CSV, with `MARK` before texts that begin with one of `FORMULA`; None is an empty cell."""
    return end.join([*map(_line, rows), ""])


def _line(row: Iterable[Any]) -> str:
    file = io.StringIO(newline="")
    cells = [MARK + value if isinstance(value, str) and value.startswith(FORMULA) else value for value in row]
    csv.writer(file, lineterminator="\r\n").writerow(cells)
    return file.getvalue().removesuffix("\r\n")


def utf8_text(text: object) -> object:
    """Return a text that UTF-8 can hold, with halves of surrogate pairs as in Python; other values unchanged."""
    return text.encode("utf-8", "backslashreplace").decode() if isinstance(text, str) else text


@contextmanager
def refused_by(parser: argparse.ArgumentParser) -> Iterator[None]:
    """Turn a user's error, but no broken pipe, into one message and exit code 2."""
    try:
        yield
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ModuleNotFoundError) as error:
        parser.exit(2, f"{parser.prog}: error: {terminal_lines(in_words(error))}\n")
