"""ctgraph-rl report RUN_OR_FOLDER... [--out FOLDER] writes a page of figures and tables of all runs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import METRICS
from ctgraph_rl.log.refuse import refused_by
from ctgraph_rl.report.names import AGENT_OPTION
from ctgraph_rl.report.page import write_report
from ctgraph_rl.report.terminal import print_problems, print_summary


def _told(sentence: str) -> None:
    print(sentence, file=sys.stderr)


def main() -> None:
    """Write the report, and say what is in it; the exit code is 1 if something was left out or is of different code."""
    parser = argparse.ArgumentParser(prog="ctgraph-rl report", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="run directories, or folders that hold them")
    parser.add_argument("--out", type=Path, help="where the report goes (default: report/ within the one folder given)")
    parser.add_argument("--agent", **AGENT_OPTION)
    parser.add_argument("--width", default="text", help="of figures: text of a page, or column, one of its two")
    parser.add_argument(
        "--colour",
        action="append",
        default=[],
        metavar="NAME=COLOUR",
        help="of an agent in figures; repeat it for each",
    )
    arguments = parser.parse_args()
    with refused_by(parser):
        if len(arguments.runs) == 1 and (arguments.runs[0] / METRICS).is_file():
            print_summary(arguments.runs[0])
        report = write_report(
            arguments.runs,
            arguments.out,
            arguments.agent,
            width=arguments.width,
            colours=arguments.colour,
            progress=_told if sys.stderr.isatty() else None,
        )
    incomplete = print_problems(report.problems, report.runs)
    count = len(report.runs)
    print(f"report of {count} run{'s' * (count != 1)}: {terminal_text(report.page)}")
    if incomplete:
        sys.exit(1)


if __name__ == "__main__":
    main()
