"""ctgraph-rl collectives RUN_OR_FOLDER... [--out FOLDER] writes a page on runs with exchange=NAME.

It has a table of learning time, returns and messages of each collective, a figure of learning time over the number of
members, and who helped whom; the same as tidy CSV files. Members are runs like any other: ctgraph-rl report.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ctgraph_rl.collective.report import write_report
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.refuse import refused_by


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(prog="ctgraph-rl collectives", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="directories of collectives, or folders that hold them")
    parser.add_argument(
        "--out", type=Path, default=Path("collectives"), help="where the page goes (default: collectives/)"
    )
    arguments = parser.parse_args()
    with refused_by(parser):
        page = write_report(arguments.runs, arguments.out)
    print(f"report: {terminal_text(page)}")


if __name__ == "__main__":
    main()
