"""One collective of a configuration: each member is an ordinary run in its own directory."""

from __future__ import annotations

import io
import logging
import shutil
import sys
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from pathlib import Path
from typing import Any

import torch

from ctgraph_rl.checks import ReadOnlyValues, require
from ctgraph_rl.collective.summary import COLLECTIVE, FILES, describe_collective, read_collective, write_summary
from ctgraph_rl.disk import made_folder
from ctgraph_rl.learn.collective import ExchangeLike, Member, learn_collective
from ctgraph_rl.learn.progress import ProgressBar
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import CHECKPOINTS, METRICS, list_members, locked, member_folder
from ctgraph_rl.log.provenance import code_changes, versions
from ctgraph_rl.log.run_log import SCHEMA, RunLog
from ctgraph_rl.report.objective import check_objective, objective_of
from ctgraph_rl.report.style import require_packages
from ctgraph_rl.runs import config
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.experts import Failures
from ctgraph_rl.runs.interrupt import Interrupt
from ctgraph_rl.runs.job import Job, code_of, first_line, is_finished, run_job
from ctgraph_rl.runs.seeds import run_seeds
from ctgraph_rl.runs.status import mark_failure
from ctgraph_rl.runs.train import Participant, execute
from ctgraph_rl.tasks.curriculum import Curriculum

LONG_ID = 1000
"""Numbers of a one-hot task id above which a collective warns."""

Runs = Sequence[tuple[Any, Path]]
"""The configuration and the directory of each member."""


def run_cells(cfg: Any, run_dir: Path) -> list[Path]:
    """Run a configuration: a collective if it has an ``exchange``, each of its ``seeds`` if a sweep lists them.

    Returns:
        The directories of single runs; those of a collective's members are within its own.
    """
    check_objective(cfg.objective, cfg.experts)
    if cfg.report:
        require_packages()
    if "exchange" in cfg:
        run_collective(cfg, run_dir)
        if not config.in_sweep():
            print(describe_collective(read_collective(run_dir)))
        return []
    if "seeds" in cfg:
        return run_seeds(cfg, run_dir)
    run_job(cfg, run_dir)
    return [run_dir]


def value_of(cfg: Any, run_dir: Path, run_dirs: Sequence[Path]) -> float:
    """Return the objective of a configuration that `run_cells` has run, the mean of its single runs or members.

    Args:
        cfg: the configuration.
        run_dir: its directory.
        run_dirs: what `run_cells` has returned.

    Raises:
        ValueError: if a run has no value; says why.
    """
    return objective_of(cfg.objective, run_dirs or list_members(run_dir))


def run_collective(cfg: Any, run_dir: Path) -> None:
    """Run a collective in an existing directory, unless its results are there.

    Raises:
        ValueError: before any work, for a value out of range, a detector, and members that cannot exchange messages.
        FileExistsError: if a member's directory holds results that ``overwrite`` does not allow to replace.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    batch = (
        "together=true trains seeds as one batch, members of a collective learn in turn: leave out together or exchange"
    )
    labels = "labels that learners give themselves do not name the same tasks for all: leave out detector or exchange"
    require((cfg.together is False, batch), ("detector" not in cfg, labels))
    exchange = config.target(cfg, "exchange")()
    runs = []
    for number in range(exchange.num_members):
        own = config.of_member(cfg, number, exchange.settings_of(number))
        runs.append((own, member_folder(run_dir, number)))
    with locked(run_dir):
        for each, _ in runs:
            config.check_values(each)
        if _is_finished(runs, run_dir):
            print("this configuration was run before; overwrite=true runs it again")
            shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)  # if it was killed at its very end
            return
        with Interrupt() as interrupt, mark_failure(run_dir):
            _learn(cfg, runs, exchange, run_dir, interrupt=interrupt)


def _is_finished(runs: Runs, run_dir: Path) -> bool:
    """Return whether all members' results and the collective's are there."""
    with redirect_stdout(io.StringIO()):  # each would print it
        finished = [is_finished(cfg, folder) for cfg, folder in runs]
    return all(finished) and (run_dir / METRICS).exists()


def _learn(cfg: Any, runs: Runs, exchange: ExchangeLike, run_dir: Path, *, interrupt: Interrupt) -> None:
    """Build the objects of all members, let them learn, and write the results."""
    checkpoints = Checkpoints(run_dir / CHECKPOINTS, cfg.checkpoint_seconds, cfg.resume == "strict", interrupt)
    jobs, random = _jobs(runs, interrupt)
    _warn_of_long_ids([job.curriculum for job in jobs])
    exchange.connect([job.agent for job in jobs])
    if _is_replaced(cfg, runs):
        checkpoints.clear()
    with ExitStack() as stack:
        for _, folder in runs:
            stack.enter_context(locked(made_folder(folder)))
        given = zip(jobs, runs, strict=True)
        directories = [stack.enter_context(job.prepared(folder)) for job, (_, folder) in given]
        checkpoints.tidy()
        saved = checkpoints.newest()
        done = 0 if saved is None else saved["frames"]
        total = sum(job.curriculum.num_frames for job in jobs)
        blocks = max(len(job.curriculum.blocks) for job in jobs)
        progress = ProgressBar(blocks, total, directories[0].console, done)

        def learn(logs: Sequence[RunLog]) -> Failures:
            parts = zip(jobs, logs, random, strict=True)
            members = [Member(job.curriculum, job.agent, job.cfg.seed, log, state) for job, log, state in parts]
            log = _log(cfg, members, run_dir, saved)
            learn_collective(
                members,
                exchange,
                cfg.seed,
                log,
                progress,
                device=jobs[0].device,
                saved=saved,
                checkpoint=checkpoints.offer,
            )
            log.close()
            return {}

        pairs = zip(jobs, directories, strict=True)
        participants = [Participant(job.curriculum, job.agent, directory) for job, directory in pairs]
        execute(participants, [None] * len(jobs) if saved is None else saved["members"], learn, progress)
        write_summary(run_dir)
        checkpoints.clear()


def _warn_of_long_ids(curricula: Sequence[Curriculum]) -> None:
    """Say on standard error, before members learn, that their task ids make them slow and large."""
    longest = max(curricula, key=lambda each: each.protocol.length(len(each.tasks)))
    length = longest.protocol.length(len(longest.tasks))
    if longest.protocol.task_id == "one_hot" and length > LONG_ID:
        print(
            f"note: each observation of {terminal_text(longest.name)} has a task id of {length:,} numbers, which are "
            "inputs of every network and mask, so members are slow and large; protocol.task_id=at_boundaries gives ids "
            "to learners without observations of them",
            file=sys.stderr,
        )


def _jobs(runs: Runs, interrupt: Interrupt) -> tuple[list[Job], list[torch.Tensor]]:
    """Build the objects of all members; return them, and the state of torch's generator after each.

    Raises:
        ValueError: names the member.
    """
    jobs = []
    random = []
    for number, (cfg, _) in enumerate(runs):
        try:
            jobs.append(Job.of(cfg, interrupt))
        except ValueError as error:
            agent = f"curriculum.agent={cfg.curriculum.agent}, " if "agent" in cfg.curriculum else ""
            raise ValueError(f"member {number} ({agent}seed={cfg.seed}): {error}") from error
        random.append(torch.get_rng_state())
    return jobs, random


def _is_replaced(cfg: Any, runs: Runs) -> bool:
    """Return whether the collective begins again, whatever its directory holds."""
    if cfg.overwrite != config.STALE:
        return bool(cfg.overwrite)
    begun = [(first_line(folder), code_of(each, {})) for each, folder in runs]
    return any(about is not None and code_changes(about, now) for about, now in begun)


def _log(cfg: Any, members: Sequence[Member], run_dir: Path, saved: ReadOnlyValues | None) -> RunLog:
    """Return the collective's log, new or as it was at a checkpoint."""
    if saved is not None:
        (run_dir / METRICS).unlink(missing_ok=True)
        return RunLog.resume(run_dir / COLLECTIVE, saved["log"])
    for name in reversed(FILES):
        (run_dir / name).unlink(missing_ok=True)
    log = RunLog(run_dir / COLLECTIVE)
    about = [
        {"seed": each.seed, "curriculum": each.curriculum.name, "labels": list(each.curriculum.labels)}
        for each in members
    ]
    log.append("collective", schema=SCHEMA, members=about, versions=versions(), config=config.plain(cfg))
    log.sync()
    return log
