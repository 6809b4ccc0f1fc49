"""Measures a GPU within half an hour, in a checkout on a machine with one.

It runs the tests marked ``cuda`` and the ladders of the environment and of learning, writes gpu.json after each part,
and the section on GPUs of docs/reference/speed_table.md from it. Commit both. Ctrl-C ends a part with what it has.
Where there is no GPU, it writes the section alone, from the gpu.json that is there.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import torch

from benchmarks import agent_ladder as learning
from benchmarks import environment_ladder as ladder
from benchmarks.environments import configurations, machine
from ctgraph_rl.log.provenance import versions
from studies.raw import HERE

FILE, PAGE = HERE / "gpu.json", HERE.parent / "reference" / "speed_table.md"
TESTS = ("-m", "pytest", "-q", "-m", "cuda", "-n", "0", "tests/learn/test_cuda.py")
SECTION = re.compile(r"(?<=<!-- gpu -->\n).*?(?=<!-- end of gpu -->)", re.DOTALL)


def measure(options: argparse.Namespace) -> None:
    """Measure, and write the file and the page."""
    if torch.cuda.is_available():
        report: dict[str, Any] = {}
        for name, part in parts(torch.device("cuda"), options):
            report[name] = part
            FILE.write_text(json.dumps(report, indent=1) + "\n")
    found = json.loads(FILE.read_text()) if FILE.exists() else None
    PAGE.write_text(with_section(PAGE.read_text(encoding="utf-8"), found), encoding="utf-8")


def parts(device: torch.device, options: argparse.Namespace) -> Iterator[tuple[str, Any]]:
    """Yield the parts of the report by name, as they are measured."""
    start, seconds = time.perf_counter(), 60 * options.minutes

    def left(share: float) -> SimpleNamespace:
        """Return how long to measure: at most this share of the time that is left."""
        return SimpleNamespace(
            rounds=3, seconds=options.seconds, limit=share * (seconds - (time.perf_counter() - start))
        )

    yield "machine", {"device": machine(device), "driver": said("nvidia-smi", *DRIVER), "versions": versions()}
    yield "commit", said("git", "describe", "--always", "--dirty", "--abbrev=12")
    yield "tests", tested(seconds / 3)
    environment = ladder.rungs(device, options.rows, configurations())
    yield "environment", ladder.found(ladder.climbed(environment, left(0.4), device))
    agents = list(learning.rungs(device, options.envs, options.together))
    yield "learning", ladder.found(ladder.climbed(agents, left(0.9), device), learning.ENVIRONMENT)


DRIVER = ("--query-gpu=driver_version", "--format=csv,noheader")


def said(*command: str) -> str:
    """Return what a command prints; nothing if there is no such command."""
    try:
        return subprocess.run(command, cwd=HERE, capture_output=True, text=True).stdout.strip()
    except FileNotFoundError:
        return ""


def tested(limit: float) -> dict[str, Any]:
    """Run the tests marked ``cuda``; return the exit code, the last line, and the lines of those that failed."""
    try:
        run = subprocess.run(
            [sys.executable, *TESTS], cwd=HERE.parents[1], capture_output=True, text=True, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return {"exit_code": None, "said": f"not finished within {limit:.0f} s", "failed": []}
    lines = run.stdout.splitlines() or [""]
    return {"exit_code": run.returncode, "said": lines[-1], "failed": [x for x in lines if x.startswith("FAILED")]}


def with_section(page: str, report: Mapping[str, Any] | None) -> str:
    """Return the page with the section of a report."""
    return SECTION.sub(lambda _: section(report), page)


def section(report: Mapping[str, Any] | None) -> str:
    """Return what the page says of a report; None: that nothing was measured."""
    if report is None:
        return "Not measured: no GPU was at hand.\n"
    about, tests = report["machine"], report.get("tests", {"said": "not run"})
    text = f"Measured on {about['device']}, driver {about['driver']}, commit {report['commit']}.\n"
    text += f"Tests marked `cuda`: {tests['said']}.\n"
    for name, yardstick in {"environment": ladder.COPY, "learning": learning.ENVIRONMENT}.items():
        text += f"\n{ladder.table(report.get(name, []), yardstick)}\n"
    return text + "".join(f"\n{line}\n" for line in jobs(report.get("learning", [])))


def jobs(rows: list[Mapping[str, Any]]) -> Iterator[str]:
    """Yield how long the main job takes with many seeds as one, computed from the rates."""
    for row in rows:
        if row["way"].startswith("lstm_ppo") and "seeds" in row["way"] and "per_second" in row:
            count = int(row["way"].split()[1].replace(",", ""))
            minutes = count * learning.MAIN_JOB / row["per_second"] / 60
            took = f"{minutes:.3g} minutes of learning, computed from the rate"
            yield f"{count:,} seeds of the main job as one job: {took}."
