"""``ctgraph-rl curricula`` lists all curricula, ``ctgraph-rl curricula describe NAME`` describes one."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ctgraph_rl.log.escape import refused_by
from ctgraph_rl.log.sheets import FORMATS, LISTED, Sheet, show, with_numbers
from ctgraph_rl.parsers import OneLineParser
from curricula import listed


def main(argv: Sequence[str] | None = None) -> None:
    """The command line; listing published curricula needs no torch."""
    parser = _parser()
    arguments = parser.parse_args(argv, argparse.Namespace(format="text", config_dir=None))
    with refused_by(parser):
        if arguments.command in (None, "list") and arguments.config_dir is None:
            _show_list(listed(), arguments.format)
            return
        from ctgraph_rl import describe  # here: a list of what is published needs no torch

        if arguments.command == "probabilities":
            show([describe.probabilities()], arguments.format)
        elif arguments.command == "describe":
            curriculum = describe.find_curriculum(arguments.name, arguments.config_dir)
            show(describe.describe(curriculum, arguments.frames_per_second), arguments.format)
            describe.write(curriculum, arguments.figure, arguments.similarity, arguments.json)
        else:
            own = describe.listing(describe.own_curricula(arguments.config_dir))
            _show_list((*listed(), *own.rows), arguments.format)


def _show_list(rows: tuple[tuple[str, ...], ...], form: str) -> None:
    sheet = Sheet("Curricula", LISTED, rows)
    show([with_numbers(sheet) if form == "text" else sheet], form)


def _parser() -> argparse.ArgumentParser:
    form = OneLineParser(add_help=False, argument_default=argparse.SUPPRESS)
    form.add_argument("--format", choices=("text", *FORMATS), help="default: text")
    form.add_argument("--config-dir", type=Path, metavar="DIR", help="also knows the curricula of this directory")
    about = "List all curricula, or describe one."
    parser = OneLineParser(prog="ctgraph-rl curricula", description=about, parents=[form])
    commands = parser.add_subparsers(dest="command")
    commands.add_parser("list", help="list all, as without a command", parents=[form])
    commands.add_parser("probabilities", help="print the paper's Table 2, with its misprints corrected", parents=[form])
    one = commands.add_parser("describe", help="describe one", parents=[form])
    one.add_argument("name", help="a name of the list, or a curriculum as a JSON file")
    one.add_argument("--frames-per-second", type=float, help="of your agent, for the estimated time; a run shows it")
    one.add_argument("--figure", type=Path, help="draw graphs and goals into this file (.png, .pdf, .svg)")
    one.add_argument("--similarity", type=Path, help="draw how alike the tasks are into this file")
    one.add_argument("--json", type=Path, help="write the curriculum into this file, a new one")
    return parser


if __name__ == "__main__":
    main()
