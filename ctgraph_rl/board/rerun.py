"""Level *rerun* of a verification: drawn runs are trained again in separate processes and compared bit by bit.

The drawn runs are those with the smallest SHA-256 of ``DIGEST NUMBER RUN``, so that neither side can choose them. Seeds
that were trained as one group are trained again as one group.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from ctgraph_rl.board.isolate import Isolation, Limits, Outcome, home, run_isolated
from ctgraph_rl.board.relearn import Relearning, run_dir_of
from ctgraph_rl.board.rescore import Check, equal
from ctgraph_rl.board.submission import Submission, SubmittedRun, counted_lines, log_sum
from ctgraph_rl.board.two_samples import compare_samples
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, require
from ctgraph_rl.disk import make_folder, read_text, require_no_link, write_whole
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import AGENT, CURRICULUM, FAILURE, LOG, METRICS, MOST_BYTES_OF_A_REASON
from ctgraph_rl.log.provenance import machine, numbers_of, versions
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.saved import count_bytes, read_content, read_plain, sum_of_state
from ctgraph_rl.log.scores import scores
from ctgraph_rl.parsers import LEVELS
from ctgraph_rl.portable import VARIABLES, cpu_model
from ctgraph_rl.runs.read import split_by
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.curriculum_json import file_text

RERUN = LEVELS[1]

JOB = "job.json"

SCORE = "average_performance"

BYTES = "bytes of the agent"

OTHER_SIZE = 0.1
"""Largest change of an agent's bytes, as a share, where bits may differ: other versions keep numbers in other forms."""

NOT_OF_THE_RUN = ("MemoryError", "ModuleNotFoundError")

OWN_VERSION = ("ctgraph_rl", "python")
"""Versions that may differ between equal bits; the numbers version stands for this package's."""


class RerunCell(NamedTuple):
    """What one process learns again."""

    folder: Path  # of the process
    job: Relearning
    runs: tuple[SubmittedRun, ...]  # that it repeats; none for held-out seeds
    curriculum: Curriculum
    seconds: float  # that the submitted runs took

    @property
    def run_dirs(self) -> list[Path]:
        """The run directory of each seed."""
        return [run_dir_of(self.folder, seed) for seed in self.job.seeds]


class Rerun(NamedTuple):
    """What a seed that was learned again left."""

    log: RunLog | None
    agent_sha256: str | None
    failure: str | None  # why it has no results
    agent_bytes: int | None = None  # of its tensors; None if it saved none
    failed_alone: bool = False  # whether it failed by itself, and not by a limit or without its code


def draw(submission: Submission, number: int, count: int) -> tuple[SubmittedRun, ...]:
    """Return the runs that a verifier's number draws, failed ones too; all if there are fewer."""

    def place(run: SubmittedRun) -> bytes:
        return hashlib.sha256(f"{submission.digest} {number} {run.run}".encode()).digest()

    return tuple(sorted(submission.runs, key=place)[:count])


def cells_of(submission: Submission, drawn: Sequence[SubmittedRun], folder: Path) -> list[RerunCell]:
    """Return what is learned again for drawn runs: each group of seeds once, in a folder within ``folder``."""
    cells = []
    groups = split_by(submission.runs, lambda run: run.seeds)
    for seeds in split_by(drawn, lambda run: run.seeds):
        own = folder / f"seed{'-'.join(map(str, seeds))}"
        runs = tuple(groups[seeds])
        job = job_of(submission, seeds, runs[0])
        cells.append(RerunCell(own, job, runs, submission.curriculum, max(run.seconds for run in runs)))
    return cells


def job_of(submission: Submission, seeds: tuple[int, ...], run: SubmittedRun) -> Relearning:
    """Return the job of seeds with the submitted configuration.

    Args:
        seeds: one, or those of a group.
        run: a submitted run, whose number of threads counts.
    """
    entry = submission.method["entry_point"]
    cores = os.cpu_count() or 1
    few = f"{run.run} had {run.num_threads} threads, this machine has {cores} cores: verify it on a larger one"
    require((entry is not None or run.num_threads <= cores, few))
    return Relearning(seeds, submission.config, run.num_threads, entry_point=entry)


def learn_again(cell: RerunCell, limits: Limits, isolated: Isolation, code: Sequence[Path] = ()) -> Outcome:
    """Learn a cell in a separate process; a stopped one resumes where its learner can.

    Modules of others are looked for in ``code``.
    """
    make_folder(cell.folder)
    if all((run_dir / METRICS).is_file() for run_dir in cell.run_dirs):
        return Outcome(0, None, "")
    if cell.job.entry_point is not None:
        subprocess.run(["rm", "-rf", "--", *cell.run_dirs])  # Python cannot remove folders deep within each other
    job = cell.job
    if job.entry_point is not None or not cell.runs:  # else the configuration says what is learned
        file = cell.folder.resolve() / CURRICULUM
        write_whole(file, file_text(cell.curriculum.to_json()))
        job = job._replace(curriculum=str(file))
    write_whole(cell.folder / JOB, json.dumps(job._asdict()))
    found_in = [path.resolve() for path in code]
    command = [sys.executable, "-P", "-s", "-m", "ctgraph_rl.board.relearn", JOB, *map(str, found_in)]
    variables = {"PYTHONPATH": str(home()), "PYTHONDONTWRITEBYTECODE": "1"}
    if is_portable(cell.job.config):
        variables |= VARIABLES
    return run_isolated(command, cell.folder, limits, isolated, paths=found_in, variables=variables)


def is_portable(config: ReadOnlyValues) -> bool:
    """Return whether a configuration asks for the same bits on every CPU."""
    return config.get("portable") is True


def result_of(cell: RerunCell, seed: int, outcome: Outcome) -> Rerun:
    """Read what a seed left; what cannot be read is a failure."""
    run_dir = run_dir_of(cell.folder, seed)
    try:
        for name in ("", LOG, AGENT, METRICS, FAILURE):
            require_no_link(run_dir / name)
        if not (run_dir / METRICS).is_file():
            with suppress(OSError, ValueError):
                reason = read_text(run_dir / FAILURE, MOST_BYTES_OF_A_REASON).strip()
                alone = outcome.stopped is None and not reason.startswith(NOT_OF_THE_RUN)
                return Rerun(None, None, reason, failed_alone=alone)
            return Rerun(None, None, outcome.failure or f"it left no {METRICS}")
        log = RunLog.read(run_dir / LOG)
        if not (run_dir / AGENT).exists():
            return Rerun(log, None, None)
        state = read_plain(read_content(run_dir / AGENT))
        return Rerun(log, sum_of_state(state), None, count_bytes(state))
    except (ValueError, OSError) as error:
        return Rerun(None, None, str(error))


def why_other_bits(submission: Submission, runs: Sequence[SubmittedRun]) -> list[str]:
    """Return why runs may have other bits here than where they were submitted; none if bits are promised."""
    about = submission.log(runs[0]).measurements[0]
    stored = about.get("numbers", 1)
    here = numbers_of(about)
    portable = is_portable(submission.config)
    this = {**machine(), "cpu": cpu_model() or ""}
    if portable:
        this["machine"] = f"{platform.machine()} portable"
    device = str(submission.config.get("device", "cpu"))
    reasons = [f"device {device}"] if device != "cpu" else []
    if stored != here:
        reasons.append(f"numbers version {stored} there, {here} here")
    for name, own in versions().items():
        before = submission.versions.get(name)
        if name not in OWN_VERSION and before != own:
            reasons.append(f"{name} {before} there, {own} here")
    for run in runs:
        for part in ("machine",) if portable else ("machine", "cpu"):
            before = getattr(run, part)
            if before != this[part]:
                reasons.append(f"{part} {before} there, {this[part]} here")
    return list(dict.fromkeys(reasons))


def checks_of(run: SubmittedRun, submitted: RunLog, result: Rerun, other_bits: Sequence[str] = ()) -> list[Check]:
    """Compare a submitted run with what was learned again, bit by bit.

    A run that cannot finish here, or failed without failing by itself, decides nothing: the machine or a limit may be
    why.
    """
    if not run.finished:
        again = True if result.failed_alone else None
        found = terminal_text(result.failure or "it finished")
        return [Check("failure", str(run.reason), found, again, run=run.run, level=RERUN)]
    if result.log is None:
        note = "--code DIR says where its modules are" if "ModuleNotFoundError" in str(result.failure) else ""
        return [Check("rerun", "it finishes", terminal_text(result.failure), None, run.run, note=note, level=RERUN)]
    log = equal("log of the rerun", run.log_sha256, log_sum(result.log), run.run)
    note = "" if log.passed else first_difference(submitted, result.log)
    checks = [log._replace(note=note), equal("agent of the rerun", run.agent_sha256, result.agent_sha256, run.run)]
    size = equal(BYTES, run.agent_bytes, result.agent_bytes, run.run)
    if other_bits and run.agent_bytes is not None and result.agent_bytes is not None:
        alike = abs(result.agent_bytes - run.agent_bytes) <= OTHER_SIZE * run.agent_bytes
        size = size._replace(expected=f"{run.agent_bytes}, within {OTHER_SIZE:.0%}", passed=alike)
    checks.append(size)
    return [check._replace(level=RERUN) for check in checks]


def first_difference(submitted: RunLog, found: RunLog) -> str:
    """Return in words the first measurement in which two logs differ, if any."""
    lines = zip_longest(counted_lines(submitted), counted_lines(found), fillvalue=NamedValues())
    for number, (one, other) in enumerate(lines, 1):
        keys = [key for key in {**one, **other} if one.get(key) != other.get(key)]
        if keys:
            values = ", ".join(f"{key} {one.get(key)!r:.60} and {other.get(key)!r:.60}" for key in keys[:3])
            return terminal_text(f"first in line {number}, {one.get('kind', other.get('kind'))}: {values}")
    return ""


def score_name(submission: Submission) -> str:
    """Return the metric that is compared."""
    return SCORE if submission.track is None else submission.track.score


def check_of_scores(
    submission: Submission, values: Sequence[float | None], what: str, level: str, note: str = ""
) -> Check:
    """Test whether scores are lower than the submitted ones, and say what the test could find."""
    name = score_name(submission)
    there = [scores(submission.log(run), submission.curriculum)[name].value for run in submission.finished]
    submitted = [value for value in there if value is not None]
    found = [value for value in values if value is not None]
    if not submitted or not found:
        why = f"{len(submitted)} submitted runs and {len(found)} others have a value of {name}"
        return Check(what, "scores of both", why, None, level=level, note=note)
    difference = compare_samples(submitted, found)
    passed = False if difference.is_lower else None if difference.is_blind else True
    expected = f"no lower than the {len(submitted)} submitted"
    return Check(what, expected, str(difference), passed, level=level, note=note)


def verified(submission: Submission, results: Mapping[SubmittedRun, Rerun], other_bits: Sequence[str]) -> list[Check]:
    """Return the checks of all runs that were learned again.

    Bits are compared first. Where they differ and are not promised, scores are tested instead.
    """
    name = score_name(submission)
    checks: list[Check] = []
    scored: list[float | None] = []
    for run, result in results.items():
        of_run = checks_of(run, submission.log(run), result, other_bits)
        wrong = any(check.passed is False and check.what != BYTES for check in of_run)
        if wrong and other_bits and result.log is not None:
            scored.append(scores(result.log, submission.curriculum)[name].value)
            of_run = [check for check in of_run if check.what == BYTES]
        checks += of_run
    if not scored:
        return checks
    note = f"bits differ, as they may with {'; '.join(other_bits)}"
    return [check_of_scores(submission, scored, f"{name} of {len(scored)} reruns", RERUN, note), *checks]
