"""Verify a submission by its files, by repeated runs, and by seeds, images and goals drawn for it.

rescored: its numbers follow from its logs; no code runs. rerun: drawn runs are trained again and give the same bits, or
scores that are no lower where bits are not promised. held_out: other seeds, images and goals give scores that are no
lower. A level needs those before it.
"""

from __future__ import annotations

import argparse
import json
import math
import secrets
import signal
import sys
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import NamedTuple

from ctgraph_rl import parsers
from ctgraph_rl.board.held_out import HELD_OUT, held_out_cells, held_out_checks
from ctgraph_rl.board.isolate import Isolation, Limits, isolation
from ctgraph_rl.board.rerun import RERUN, RerunCell, cells_of, draw, learn_again, result_of, verified, why_other_bits
from ctgraph_rl.board.rescore import RESCORED, Check, rescore
from ctgraph_rl.board.submission import MOST_RUNS, VERIFICATION, Submission, read_submission
from ctgraph_rl.board.two_samples import runs_needed
from ctgraph_rl.board.verification import SCHEMA, level_of, verification_of
from ctgraph_rl.checks import NamedValues, Rule, is_int, is_real, require
from ctgraph_rl.disk import make_folder, write_whole
from ctgraph_rl.log.escape import refused_by, terminal_lines, terminal_text
from ctgraph_rl.log.files import locked
from ctgraph_rl.log.provenance import machine, targets, versions
from ctgraph_rl.parsers import LEVELS, LIMIT_TIMES
from ctgraph_rl.portable import cpu_model
from ctgraph_rl.runs.sweep import sigterm_exits

LEAST_SECONDS = 600

MOST_HOURS, LEAST_GB, MOST_GB = 10**5, 0.001, 10**6

GB = 10**9

NUMBERS = 2**63


class Plan(NamedTuple):
    """What a verification runs, and with what."""

    submission: Submission
    number: int
    reruns: list[RerunCell]
    held_out: list[RerunCell]
    other_bits: list[str]  # why bits are not promised on this machine
    isolated: Isolation
    arguments: argparse.Namespace  # limits and folders

    @property
    def cells(self) -> list[RerunCell]:
        """All processes, in order."""
        return [*self.reruns, *self.held_out]


def planned(submission: Submission, arguments: argparse.Namespace) -> Plan:
    """Return what a verification runs: as many runs as asked for, and enough for a test where one is needed.

    Raises:
        ValueError: for runs that cannot be repeated here, and where the code of others cannot be isolated.
    """
    other_bits = why_other_bits(submission, submission.runs)
    finished = len(submission.finished)
    require((finished > 0, f"{submission.path} has no finished run: there is nothing to run again"))
    number = secrets.randbelow(10**9) if arguments.number is None else arguments.number
    folder = make_folder(arguments.folder / f"{submission.digest[:12]}-{number}")
    folder.chmod(0o700)  # others' code may make a program there that runs as you, for other users of this machine
    count = arguments.cells
    enough = max(count, runs_needed(finished))
    reruns = cells_of(submission, draw(submission, number, enough if other_bits else count), folder / RERUN)
    fresh: list[RerunCell] = []
    if arguments.level == HELD_OUT:
        fresh = held_out_cells(submission, number, enough, folder / HELD_OUT)
    limits = limits_of(longest([*reruns, *fresh]), arguments)
    isolated = isolation(folder, limits, graphics=submission.config.get("device", "cpu") != "cpu")
    why_not = isolated.why_not
    require((why_not is None, f"the code of others is not run: {why_not}; --level {RESCORED} runs none"))
    return Plan(submission, number, reruns, fresh, other_bits=other_bits, isolated=isolated, arguments=arguments)


def limits_of(cell: RerunCell, arguments: argparse.Namespace) -> Limits:
    """Return the limits of a process."""
    seconds = max(LEAST_SECONDS, math.ceil(min(LIMIT_TIMES * cell.seconds, MOST_HOURS * 3600)))
    if arguments.hours is not None:
        seconds = arguments.hours * 3600
    return Limits(seconds, round(arguments.memory * GB), round(arguments.disk * GB), cell.job.num_threads)


def longest(cells: Sequence[RerunCell]) -> RerunCell:
    """Return the longest process by the submitted times."""
    return max(cells, key=lambda cell: cell.seconds)


def describe_plan(plan: Plan) -> list[str]:
    """Return lines about what will run, in which limits, and what is not isolated."""
    submission = plan.submission
    arguments = plan.arguments
    cells = plan.cells
    seeds = f"{RERUN} of seeds {_seeds(plan.reruns)}"
    if plan.held_out:
        seeds += f"; {HELD_OUT} seeds {_seeds(plan.held_out)}"
    seconds = sum(cell.seconds for cell in cells)
    frames = sum(cell.curriculum.num_frames * len(cell.job.seeds) for cell in cells)
    limit = _time(limits_of(longest(cells), arguments).seconds)
    most = f"each at most {limit}, {arguments.memory:g} GB of memory and {arguments.disk:g} GB of disk"
    count = f"{len(cells)} process{'es' * (len(cells) > 1)}"
    found_in = "" if arguments.code is None else f", also looked for in {arguments.code}"
    lines = [
        f"number {plan.number} draws {seeds}",
        f"{count}, {frames:,} frames, {_time(seconds)} by the submitted times; {most}; in {cells[0].folder.parents[1]}",
        f"code: {code_in_words(submission)}{found_in}",
    ]
    if plan.other_bits:
        lines.append(f"scores are tested where bits differ: {'; '.join(plan.other_bits)}")
    lines.append(f"isolated: {'; '.join(plan.isolated.closed())}")
    for text in plan.isolated.missing():
        lines.append(f"NOT isolated: {text}")
    return list(map(terminal_text, lines))


def _seeds(cells: Sequence[RerunCell]) -> str:
    return ", ".join("+".join(map(str, cell.job.seeds)) for cell in cells)


def _time(seconds: float) -> str:
    return str(timedelta(seconds=math.ceil(min(seconds, MOST_RUNS * MOST_HOURS * 3600))))


def code_in_words(submission: Submission) -> str:
    """Return the names of all code that a submission runs, and where its author says that it is from."""
    entry = submission.method["entry_point"]
    code = submission.method["code"]
    named = dict.fromkeys(targets(submission.config)) if entry is None else [entry]
    return f"{', '.join(named)} of {code['repository']} at {code['commit']}"


def ask(lines: Sequence[str], yes: bool) -> None:
    """Say what will run, and ask the user to agree.

    Raises:
        ValueError: without a terminal and without ``yes``.
        SystemExit: if the user does not agree.
    """
    print("\n".join(lines), flush=True)
    if yes:
        return
    require((sys.stdin.isatty(), "this runs the code of others, and there is no terminal to ask: give --yes to agree"))
    if input("Run it? [y/N] ").strip().lower() not in ("y", "yes"):
        print("nothing was run")
        sys.exit(1)


def run_plan(plan: Plan) -> list[Check]:
    """Run all processes of a plan in turn, and return the checks of their results.

    Results of an earlier verification with the same number are kept.
    """
    arguments = plan.arguments
    code = [] if arguments.code is None else [arguments.code]
    again = {}
    fresh = []
    cells = plan.cells
    for place, cell in enumerate(cells, 1):
        print(f"process {place}/{len(cells)}: seeds {_seeds([cell])}", file=sys.stderr, flush=True)
        outcome = learn_again(cell, limits_of(cell, arguments), plan.isolated, code)
        for run in cell.runs:
            again[run] = result_of(cell, run.seed, outcome)
        if not cell.runs:
            fresh.append((cell, result_of(cell, cell.job.seeds[0], outcome)))
    checks = verified(plan.submission, again, plan.other_bits)
    return [*checks, *held_out_checks(plan.submission, fresh)] if fresh else checks


def write_verification(submission: Submission, checks: Sequence[Check], plan: Plan | None = None) -> Path:
    """Write ``verification.json`` into a submission's folder; without a plan only files were checked."""
    drawn: list[str] = []
    seeds: list[int] = []
    for cell in () if plan is None else plan.cells:
        drawn += [run.run for run in cell.runs]
        seeds += () if cell.runs else cell.job.seeds
    content: NamedValues = {
        "schema": SCHEMA,
        "level": level_of(checks),
        "bits": not any(check.level == RERUN and not check.run for check in checks),  # false: scores were tested
        "digest": submission.digest,
        "number": None if plan is None else plan.number,
        "cells": drawn,
        "held_out_seeds": seeds,
        "isolation": None if plan is None else plan.isolated._asdict(),
        "checks": [],
        **machine(),
        "cpu": cpu_model(),
        "versions": versions(),
    }
    path = submission.path / VERIFICATION
    lines = ",\n".join(f"    {json.dumps(check._asdict())}" for check in checks)
    text = json.dumps(content, indent=2).replace('"checks": []', f'"checks": [\n{lines}\n  ]', 1)
    write_whole(path, text + "\n")
    return path


def report(submission: Submission, checks: Sequence[Check]) -> str:
    """Return in words what a verification found."""
    wrong = [check for check in checks if not check.passed]
    scores = [check for check in checks if check.passed and check.level != RESCORED and not check.run]
    about = f"{submission.method['name']}: {len(checks)} checks of {len(submission.runs)} runs"
    verdict = f"{len(wrong)} not passed" if wrong else "all passed"
    lines = [f"{about}, {verdict}; level {level_of(checks)}"]
    for check in wrong:
        lines.append(f"- {'undecided: ' if check.passed is None else ''}{check.text}")
    for check in scores:
        lines.append(f"+ {check.text}")
    return "\n".join(map(terminal_text, lines))


def verify(submission: Submission, arguments: argparse.Namespace) -> list[Check]:
    """Verify a submission to the level of the command line, say what will run, and write what was found.

    Raises:
        ValueError: to replace a verification of the same files by one of a lower level.
    """
    stored = verification_of(submission).level
    path = submission.path / VERIFICATION
    lower = f"{path} has the level {stored}, --level {arguments.level} would replace it: verify a copy of the folder"
    require((stored not in LEVELS[LEVELS.index(arguments.level) + 1 :], lower))
    checks = rescore(submission)
    if arguments.level == RESCORED or not all(check.passed for check in checks):
        write_verification(submission, checks)
        return checks
    plan = planned(submission, arguments)
    ask(describe_plan(plan), arguments.yes)
    message = f"interrupted, and no process is left; with --number {plan.number} the same command resumes"
    with locked(plan.cells[0].folder.parents[1]):
        try:
            with sigterm_exits():
                checks += run_plan(plan)
        except (KeyboardInterrupt, SystemExit) as error:
            print(f"\n{message}", file=sys.stderr)
            sys.exit(error.code if isinstance(error, SystemExit) else 128 + signal.SIGINT)
    write_verification(submission, checks, plan)
    return checks


def _check(arguments: argparse.Namespace) -> None:
    number = arguments.number
    code = arguments.code
    hours = arguments.hours
    require(
        (is_int(arguments.cells, 1), f"--cells must be an integer >= 1, got {arguments.cells}"),
        (number is None or is_int(number, 0, NUMBERS - 1), f"--number must be in [0, 2**63), got {number}"),
        (code is None or code.is_dir(), f"--code must be a folder, got {code}"),
        (
            hours is None or (is_real(hours, 0, MOST_HOURS) and hours > 0),
            f"--hours must be a number > 0 and at most {MOST_HOURS:,}, got {hours}",
        ),
        _size_rule("--memory", arguments.memory),
        _size_rule("--disk", arguments.disk),
    )


def _size_rule(option: str, value: object) -> Rule:
    return is_real(value, LEAST_GB, MOST_GB), f"{option} must be in [{LEAST_GB}, {MOST_GB:,}] GB, got {value}"


def main() -> None:
    """Verify a submission; the exit code is 1 unless it reaches the requested level."""
    made = parsers.verify()
    arguments = made.parse_args()
    with refused_by(made):
        _check(arguments)
        submission = read_submission(arguments.submission, config_dir=arguments.config_dir)
        checks = verify(submission, arguments)
    print(report(submission, checks))
    print(terminal_lines(f"verification: {submission.path / VERIFICATION}"))
    if level_of(checks) != arguments.level:
        sys.exit(1)


if __name__ == "__main__":
    main()
