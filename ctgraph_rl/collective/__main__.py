"""The command ``ctgraph-rl collectives``: a page on runs with ``exchange=NAME``."""

from __future__ import annotations

from ctgraph_rl import parsers
from ctgraph_rl.collective.report import write_report
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.refuse import refused_by


def main() -> None:
    """Write the page."""
    parser = parsers.collectives()
    arguments = parser.parse_args()
    with refused_by(parser):
        page = write_report(arguments.runs, arguments.out)
    print(f"report: {terminal_text(page)}")


if __name__ == "__main__":
    main()
