"""Measures a GPU in calls of four minutes, in a checkout on a machine with one.

It runs the tests marked ``cuda`` and the ladders of learning and of the environment, the most important rungs first,
and writes gpu.json after each. A call at the same commit on the same kind of GPU measures what earlier ones left.
Last comes the section on GPUs of docs/reference/speed_table.md. Commit both.
Where there is no GPU, it writes the section alone.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch

from benchmarks import agents as learning
from benchmarks import environment_ladder as ladder
from benchmarks.environments import configurations
from ctgraph_rl.log.provenance import versions
from studies.raw import HERE

FILE, PAGE = HERE / "gpu.json", HERE.parent / "reference" / "speed_table.md"
TESTS = ("-m", "pytest", "-q", "-m", "cuda", "-n", "0", "tests/learn/test_cuda.py")
SECTION = re.compile(r"(?<=<!-- gpu -->\n).*?(?=<!-- end of gpu -->)", re.DOTALL)


ROWS = (65536, 262144)
"""Of the environment."""

ENVS = (256, 4096, 65536)
"""Of one agent."""

TOGETHER = (64, 1024)
"""Seeds of one job."""

SECONDS = 1.0
"""The least time of a measurement."""

SECONDS_OF_A_CALL = 180.0
"""No measurement begins after them, so that the last one ends within four minutes."""


def measure(commit: str) -> None:
    """Measure, and write the file and the page; see `parts`."""
    found = json.loads(FILE.read_text())
    if torch.cuda.is_available():
        measured = {}
        for name, part in parts(torch.device("cuda"), SECONDS_OF_A_CALL, commit or present_commit(), found):
            measured[name] = part
            FILE.write_text(json.dumps(measured, indent=1) + "\n")
        found = measured
    PAGE.write_text(with_section(PAGE.read_text(encoding="utf-8"), found), encoding="utf-8")


def parts(device: torch.device, seconds: float, commit: str, before: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the parts of the report by name, each again after every measurement; the most important first.

    Args:
        device: what is measured.
        seconds: no measurement begins after them.
        commit: what is measured.
        before: the report of an earlier call, which is continued if it is of the same commit and device.
    """
    end = time.perf_counter() + seconds
    about = {"device": ladder.machine(device), "driver": said("nvidia-smi", *DRIVER), "versions": versions()}
    known = before if before.get("commit") == commit and before.get("machine") == about else {}
    yield "machine", about
    yield "commit", commit
    finished = known.get("tests", {}).get("exit_code") is not None
    yield "tests", known["tests"] if finished else tested(end - time.perf_counter())
    agents = list(learning.rungs(device, ENVS, TOGETHER))
    environment = ladder.rungs(device, ROWS, configurations())
    for name, rungs, yardstick in (
        ("learning", agents, learning.ENVIRONMENT),
        ("environment", environment, ladder.COPY),
    ):
        left = continued(rungs, known.get(name, []))
        yield name, ladder.found(rungs, yardstick)
        for rung in sorted(left, key=lambda rung: ("seeds as one job" not in rung.name, rung.num_rows)):
            if time.perf_counter() > end:
                break
            ladder.measure(rung, 3, SECONDS, device)
            yield name, ladder.found(rungs, yardstick)


def continued(rungs: Sequence[ladder.Rung], rows: Sequence[Mapping[str, Any]]) -> list[ladder.Rung]:
    """Give rungs what an earlier call measured of them; return those that are left to measure."""
    measured = {(row["way"], row["task"], row["rows"]): row for row in rows}
    left = []
    for rung in rungs:
        row = measured.get((rung.name, rung.task, rung.num_rows))
        if row is None:
            left.append(rung)
        elif "failure" in row:
            rung.failure = row["failure"]
        else:
            rung.speeds = [row["per_second"]] * row["rounds"]
    return left


def present_commit() -> str:
    """Return the commit of the checkout, marked where other files than those written here differ from it."""
    commit = said("git", "rev-parse", "--short=12", "HEAD")
    return f"{commit}-dirty" if said("git", *CHANGED) else commit


CHANGED = ("diff", "--name-only", "HEAD", "--", ":/", f":(exclude){FILE}", f":(exclude){PAGE}")
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


def with_section(page: str, report: Mapping[str, Any]) -> str:
    """Return the page with the section of a report."""
    return SECTION.sub(lambda _: section(report), page)


def section(report: Mapping[str, Any]) -> str:
    """Return what the page says of a report."""
    about, tests = report["machine"], report.get("tests", {"said": "not run"})
    text = f"Measured on {about['device']}, driver {about['driver']}, commit {report['commit']}.\n"
    text += f"Tests marked `cuda`: {tests['said']}.\n"
    fewest = min((row["rows"] for row in report.get("environment", [])), default=0)
    learned = ladder.table(report.get("learning", []), learning.ENVIRONMENT).splitlines()
    small = tuple(f"| {row['rows']:,} |" for row in report.get("learning", []) if row["rows"] < fewest)
    large = [line for line in learned if "seeds" in line or not line.startswith(small)]
    text += "\n".join(["", *large, ""])
    return text + "".join(f"\n{line}\n" for line in jobs(report.get("learning", [])))


def jobs(rows: list[Mapping[str, Any]]) -> Iterator[str]:
    """Yield how long the main job takes with many seeds as one, computed from the rates."""
    for row in rows:
        if row["way"].startswith("lstm_ppo") and "seeds" in row["way"] and "per_second" in row:
            count = int(row["way"].split()[1].replace(",", ""))
            minutes = count * learning.MAIN_JOB / row["per_second"] / 60
            took = f"{minutes:.3g} minutes of learning, computed from the rate"
            yield f"{count:,} seeds of the main job as one job: {took}."
