"""The runs of several seeds as one job: their seeds learn as one batch, or one after the other where they cannot."""

from __future__ import annotations

import logging
import shutil
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import torch

from ctgraph_rl.learn.together import why_not_together
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import CHECKPOINTS, locked
from ctgraph_rl.packages import agents_together, why_agents_learn_alone
from ctgraph_rl.runs import config
from ctgraph_rl.runs.interrupt import Interrupt
from ctgraph_rl.runs.job import Job, is_finished, marked_if_it_fails, run_job
from ctgraph_rl.runs.train import train_together

Run = tuple[Any, Path]
"""A composed configuration and its directory."""


def run_cells(cfg: Any, run_dir: Path) -> list[Path]:
    """Run a configuration, or where a sweep lists seeds in ``together`` it with each of them in a directory of its own.

    Args:
        cfg: the composed configuration, with the first seed.
        run_dir: its directory.

    Returns:
        The directories of all seeds.

    Raises:
        ValueError: before any work, for a value out of range.
        RuntimeError: if seeds have failed.
    """
    if isinstance(cfg.together, bool) or not config.in_sweep():
        run_job(cfg, run_dir)
        return [run_dir]
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    runs = [config.of_seed(cfg, seed, run_dir) for seed in cfg.together]
    for each, folder in runs:
        config.check_values(each)
        folder.mkdir(parents=True, exist_ok=True)
    reason = _why_one_after_the_other(runs[0][0])
    if reason is None:
        run_as_one(runs)
    else:
        print(f"note: seeds are trained one after the other, as {terminal_text(reason)}", file=sys.stderr)
        _run_in_turn(runs)
    return [folder for _, folder in runs]


def _why_one_after_the_other(cfg: Any) -> str | None:
    """Return why the seeds of a configuration cannot learn as one batch; None if they can."""
    with torch.random.fork_rng():
        job = Job.of(cfg, Interrupt())
    if job.device.type != "cpu":
        return f"those on {job.device} cannot be one batch"
    return why_not_together(job.curriculum) or why_agents_learn_alone(job.agent)


def _run_in_turn(runs: Sequence[Run]) -> None:
    """Run each; one that fails stops no other."""
    errors = []
    for cfg, run_dir in runs:
        try:
            run_job(cfg, run_dir)
        except Exception as error:
            errors.append(f"seed {cfg.seed}: {type(error).__name__}: {config.explain(error)}")
    if errors:
        raise RuntimeError("; ".join(errors))


def run_as_one(runs: Sequence[Run]) -> None:
    """Run those that are not finished, as one batch; a seed that fails stops no other.

    Args:
        runs: the configuration of each seed, and its existing directory.

    Raises:
        RuntimeError: if seeds have failed.
    """
    with ExitStack() as stack:
        for _, run_dir in runs:
            stack.enter_context(locked(run_dir))
        finished = [is_finished(cfg, run_dir) for cfg, run_dir in runs]
        left = [run for run, done in zip(runs, finished, strict=True) if not done]
        for (_, run_dir), done in zip(runs, finished, strict=True):
            if done:
                shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)  # if it was killed at its very end
        failed = _marked(left) if left else {}
    if failed:
        raise RuntimeError("; ".join(f"{type(error).__name__}: {error}" for error in failed.values()))


def _marked(runs: Sequence[Run]) -> dict[int, FloatingPointError]:
    """Run all as one batch; leave in the directory of each that fails, or of all, why."""
    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt())
        for _, run_dir in runs:
            stack.enter_context(marked_if_it_fails(run_dir))
        failed = _learn(runs, interrupt)
    for number, error in failed.items():
        with suppress(FloatingPointError), marked_if_it_fails(runs[number][1]):
            raise error
    return failed


def _learn(runs: Sequence[Run], interrupt: Interrupt) -> dict[int, FloatingPointError]:
    """Build the objects of all runs, and let them learn; return the errors of those that failed."""
    jobs, generators = [], []
    for cfg, _ in runs:
        jobs.append(Job.of(cfg, interrupt))
        generators.append(torch.Generator().set_state(torch.get_rng_state()))
    seeds = [cfg.seed for cfg, _ in runs]
    with ExitStack() as stack:
        given = zip(jobs, runs, strict=True)
        directories = [stack.enter_context(job.prepared(run_dir, seeds)) for job, (_, run_dir) in given]
        group = agents_together([job.agent for job in jobs], generators)
        return train_together(jobs[0].curriculum, group, seeds, jobs[0].device, directories)
