"""The command ``ctgraph-rl report``: figures and tables of all runs."""

from __future__ import annotations

import sys

from ctgraph_rl import parsers
from ctgraph_rl.learn.progress import StepCounter
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import METRICS
from ctgraph_rl.log.refuse import refused_by
from ctgraph_rl.report.page import write_report
from ctgraph_rl.report.terminal import print_problems, print_summary


def main() -> None:
    """Write the report, and say what is in it; the exit code is 1 if runs were left out or have different code."""
    parser = parsers.report()
    arguments = parser.parse_args()
    with refused_by(parser):
        if len(arguments.runs) == 1 and (arguments.runs[0] / METRICS).is_file():
            print_summary(arguments.runs[0])
        with StepCounter() as count:
            report = write_report(
                arguments.runs,
                arguments.out,
                arguments.agent,
                width=arguments.width,
                colours=arguments.colour,
                count=count,
                tuning=arguments.tuning,
            )
    incomplete = print_problems(report.problems, report.runs)
    num_runs = len(report.runs)
    print(f"report of {num_runs} run{'s' * (num_runs != 1)}: {terminal_text(report.page)}")
    if incomplete:
        sys.exit(1)


if __name__ == "__main__":
    main()
