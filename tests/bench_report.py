"""How long a report over many made-up runs takes: ``python tests/bench_report.py [--runs 1000]``."""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from pathlib import Path

from helpers.made_runs import write_run

from ctgraph_rl.report.page import write_report
from ctgraph_rl.report.style import require_packages

CURRICULA, AGENTS, TASKS, INTERVALS = 2, 5, 4, 50


def make(folder: Path, count: int) -> None:
    """Runs of five agents on two curricula, with random returns; one in a hundred did not finish."""
    draw = random.Random(0)
    labels = [f"goal{task}" for task in range(TASKS)]
    for number in range(count):
        curriculum, agent = number % CURRICULA, number // CURRICULA % AGENTS
        write_run(
            folder / f"{number}",
            curriculum=(f"curriculum{curriculum}", f"{curriculum:016}"),
            agent=f"Agent{agent}",
            seed=number // (CURRICULA * AGENTS),
            performance=[[draw.random() for _ in labels] for _ in range(TASKS + 1)],
            labels=labels,
            intervals=INTERVALS,
            finished=number % 100 != 0,
        )


def main() -> None:
    """Make the runs, time the report, and say what it has."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    count = parser.parse_args().runs
    require_packages()  # the time is that of the report, and not of imports
    with tempfile.TemporaryDirectory() as name:
        make(Path(name) / "runs", count)
        start, cpu = time.perf_counter(), time.process_time()
        report = write_report([Path(name) / "runs"])
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        size = report.page.stat().st_size / 2**20
        figures = len(list(report.page.parent.glob("figures/*.png")))
        lines = (2 + TASKS * (1 + TASKS + INTERVALS)) * count
        took = f"{seconds:.1f} s, {cpu:.1f} s of a core"
        print(f"{len(report.runs)} runs, {lines:,} lines, {figures} figures, {size:.1f} MiB: {took}")


if __name__ == "__main__":
    main()
