"""The command ``ctgraph-rl board``: a page with tables of submissions, and the tables for programs."""

from __future__ import annotations

import base64
import hashlib
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ctgraph_rl import __version__, parsers
from ctgraph_rl.board.standings import board_formats as formats
from ctgraph_rl.board.standings.board_tables import BoardTable, tables
from ctgraph_rl.board.standings.entries import BoardEntry, read_entries, shown_level
from ctgraph_rl.board.verification import STATES
from ctgraph_rl.checks import require
from ctgraph_rl.disk import make_folder, write_whole
from ctgraph_rl.log.escape import refused_by, terminal_text
from ctgraph_rl.report.style import require_packages
from ctgraph_rl.report.templates import rendered
from ctgraph_rl.runs.read import Problem, why_left_out

PAGE = "board.html"

ADDRESS = re.compile(r"https?://\S+")


class Board(NamedTuple):
    """The page, its tables, and what was left out."""

    page: Path
    tables: list[BoardTable]
    problems: list[Problem]


def write_board(
    paths: Sequence[Path | str],
    folder: Path | str,
    config_dir: Path | None = None,
) -> Board:
    """Write the page and the other files of a board.

    Args:
        config_dir: where the user's tracks are, as ``track/NAME.yaml``.

    Raises:
        ModuleNotFoundError: before any work, without what the extra ``report`` installs.
        ValueError: if no submission can be read.
    """
    require_packages("the board", "jinja2", "scipy")
    entries, problems = read_entries(paths, config_dir)
    require((bool(entries), why_left_out(problems)))
    made = tables(entries)
    folder = make_folder(Path(folder))
    files = {
        PAGE: html(made, problems),
        "entries.csv": formats.entries_csv(made),
        "scores.csv": formats.scores_csv(made),
    }
    for name, content in files.items():
        write_whole(folder / name, content)
    return Board(folder / PAGE, made, problems)


def html(made: Sequence[BoardTable], problems: Sequence[Problem] = ()) -> str:
    """Return the page: plain tables, which JavaScript sorts and filters."""
    here = Path(__file__)
    script = here.with_name("board.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return rendered(
        here.with_name(f"{PAGE}.j2"),
        tables=made,
        problems=problems,
        formats=formats,
        levels=[(place, shown_level(level)) for place, level in enumerate(STATES)],
        level_of=lambda entry: STATES.index(entry.level),
        given=list(dict.fromkeys(table.variant.given for table in made)),
        link_of=link_of,
        version=__version__,
        script_text=script,
        script_digest=digest,
    )


def link_of(entry: BoardEntry) -> str | None:
    """Return the address of an entry's paper, else of its code, else None."""
    addresses = (str(entry.method["paper"]), str(entry.method["code"]["repository"]))
    return next(filter(ADDRESS.fullmatch, addresses), None)


def main() -> None:
    """Write the board, and say what is in it."""
    parser = parsers.board()
    arguments = parser.parse_args()
    with refused_by(parser):
        board = write_board(arguments.submissions, arguments.out, arguments.config_dir)
    for problem in board.problems:
        print(f"left out: {terminal_text(problem.reason)}", file=sys.stderr)
    count = sum(len(table.standings) for table in board.tables)
    submissions = f"{count} submission{'s' * (count != 1)}"
    print(f"board of {submissions} in {len(board.tables)} table{'s' * (len(board.tables) != 1)}: {board.page}")
    if board.problems:
        sys.exit(1)


if __name__ == "__main__":
    main()
