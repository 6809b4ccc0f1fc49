"""The runs of several seeds as one job: their seeds learn as one batch, or one after the other where they cannot."""

from __future__ import annotations

import logging
import shutil
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import is_int, require
from ctgraph_rl.learn.stacked import why_not_together
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import CHECKPOINTS, locked
from ctgraph_rl.packages import check_packages
from ctgraph_rl.runs import config
from ctgraph_rl.runs.experts import Expert, Failures, RunDirs, find_or_train, is_of_group
from ctgraph_rl.runs.interrupt import Interrupt
from ctgraph_rl.runs.job import Job, is_finished, run_job
from ctgraph_rl.runs.status import mark_failure
from ctgraph_rl.runs.train import RunDirectory, train_together
from ctgraph_rl.tasks.curriculum import Curriculum

JobAndPath = tuple[Any, Path]
"""A composed configuration and its directory."""


def run_seeds(cfg: Any, run_dir: Path) -> list[Path]:
    """Run a configuration with each of the ``seeds`` that a sweep lists, in its directory.

    Args:
        cfg: the composed configuration, with the first seed.
        run_dir: its directory.

    Returns:
        The directories of all seeds.

    Raises:
        ValueError: before any work, for a value out of range.
        RuntimeError: if seeds have failed.
    """
    alone = "seeds is a setting of the jobs of a sweep: add -m, and give seed=0,1 in place of it"
    require((config.in_sweep(), alone))
    seeds = cfg.seeds
    are_seeds = isinstance(seeds, Sequence) and all(map(is_int, seeds)) and len({*seeds}) == len(seeds) > 0
    rule = f"seeds must be a list of different seeds that begins with seed={cfg.seed}, got {seeds}"
    require((are_seeds and seeds[0] == cfg.seed, rule))
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    runs = [config.of_seed(cfg, seed, run_dir) for seed in seeds]
    for each, folder in runs:
        config.check_values(each)
        folder.mkdir(parents=True, exist_ok=True)
    job = Job.of(runs[0][0], Interrupt())
    generator = _generator()
    reason = why_not_together(job.curriculum) or why_agents_learn_alone(job.agent, job.device)
    if reason is None:
        run_as_one(runs, (job, generator))
    else:
        print(f"note: seeds are trained one after the other, as {terminal_text(reason)}", file=sys.stderr)
        torch.set_rng_state(generator.get_state())
        _run_in_turn(runs, job)
    return [folder for _, folder in runs]


def _run_in_turn(runs: Sequence[JobAndPath], first: Job) -> None:
    """Run each, the first by the job that was built of it; one that fails stops no other."""
    errors = []
    for number, (cfg, run_dir) in enumerate(runs):
        try:
            run_job(cfg, run_dir, None if number else first)
        except Exception as error:
            errors.append(f"seed {cfg.seed}: {type(error).__name__}: {config.explain(error)}")
    if errors:
        raise RuntimeError("; ".join(errors))


def run_as_one(runs: Sequence[JobAndPath], built: tuple[Job, torch.Generator] | None = None) -> None:
    """Run those that are not finished, as one batch; a seed that fails stops no other.

    Args:
        runs: the configuration of each seed, and its existing directory.
        built: the job of one of them, and what its agent draws from, if it was built before.

    Raises:
        RuntimeError: if seeds have failed.
    """
    with ExitStack() as stack:
        for _, run_dir in runs:
            stack.enter_context(locked(run_dir))
        left = []
        for cfg, run_dir in runs:
            if is_finished(cfg, run_dir):
                shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)  # if it was killed at its very end
            else:
                left.append((cfg, run_dir))
        failed = _marked(left, built) if left else {}
    if failed:
        raise RuntimeError("; ".join(f"{type(error).__name__}: {error}" for error in failed.values()))


def _marked(runs: Sequence[JobAndPath], built: tuple[Job, torch.Generator] | None) -> Failures:
    """Run all as one batch; leave in the directory of each that fails, or of all, why."""
    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt() if built is None else built[0].interrupt)
        for _, run_dir in runs:
            stack.enter_context(mark_failure(run_dir))
        failed = _learn(runs, interrupt, built)
    for cfg, run_dir in runs:
        if cfg.seed in failed:
            with suppress(FloatingPointError), mark_failure(run_dir):
                raise failed[cfg.seed]
    return failed


def _learn(runs: Sequence[JobAndPath], interrupt: Interrupt, built: tuple[Job, torch.Generator] | None) -> Failures:
    """Build the objects of all runs, and let them learn; return the error of each seed that failed.

    A seed with a single-task expert that failed does not begin.
    """
    jobs = {}
    generators = {}
    for cfg, _ in runs:
        if built is not None and built[0].cfg.seed == cfg.seed:
            jobs[cfg.seed], generators[cfg.seed] = built
        else:
            jobs[cfg.seed] = Job.of(cfg, interrupt)
            generators[cfg.seed] = _generator()
    first = jobs[runs[0][0].seed]
    experts, failed = train_experts([*jobs.values()]) if first.cfg.experts else ({}, {})
    begin = {cfg.seed: run_dir for cfg, run_dir in runs if cfg.seed not in failed}
    with ExitStack() as stack:
        members = []
        for seed, run_dir in begin.items():
            directory = stack.enter_context(jobs[seed].prepared(run_dir, [*begin], experts.get(seed)))
            members.append(SeedOfRun(jobs[seed].agent, directory, generators[seed]))
        return failed | _as_one(first, first.curriculum, members)


class SeedOfRun(NamedTuple):
    """A run of a group."""

    agent: Agent
    directory: RunDirectory
    generator: torch.Generator
    """What the agent draws from: torch's global one, as the agent's construction left it."""


def _generator() -> torch.Generator:
    """Return a generator that continues as torch's global one."""
    return torch.Generator(device="cpu").set_state(torch.get_rng_state())


def _as_one(job: Job, curriculum: Curriculum, members: Sequence[SeedOfRun]) -> Failures:
    """Let the runs of a group learn a curriculum; return the error of each seed that failed."""
    if not members:
        return {}
    agents, directories, generators = zip(*members, strict=True)
    seeds = directories[0].together
    group = agents_together(agents, generators, job.device)
    failed = train_together(curriculum, group, seeds, job.device, directories)
    return {seeds[number]: error for number, error in failed.items()}


def train_experts(jobs: Sequence[Job], only: int | None = None) -> tuple[dict[int, list[Expert]], Failures]:
    """Find or train the single-task experts of several seeds, those of a task as one batch.

    Args:
        jobs: of each seed.
        only: the position of the one task whose experts are needed, from 1; None: all.

    Returns:
        The experts of each seed, and the error of each seed with an expert that failed, which then has none.
    """
    first = jobs[0]
    by_seed = {job.cfg.seed: job for job in jobs}

    def learn(alone: Curriculum, run_dirs: RunDirs) -> Failures:
        [(seed, run_dir), *others] = run_dirs.items()
        if not others and not is_of_group(run_dir):
            try:
                return by_seed[seed].learn_alone(alone, run_dirs)
            except FloatingPointError as error:
                return {seed: error}
        members = []
        for seed, run_dir in run_dirs.items():
            members.append(SeedOfRun(*by_seed[seed].expert(alone, run_dir, [*run_dirs]), _generator()))
        return _as_one(first, alone, members)

    folder = Path(first.cfg.experts_dir)
    deciding = {seed: job.decides_experts for seed, job in by_seed.items()}
    return find_or_train(first.curriculum, learn, folder, deciding, print, waiting=first.interrupt.check, only=only)


def learn_experts(configs: Sequence[Any], task: int) -> None:
    """Find or train the single-task experts of seeds for one task, from 1, as one batch.

    Args:
        configs: the configuration of each seed.
        task: position of the task in the curriculum.
    """
    with Interrupt() as interrupt:
        train_experts([Job.of(cfg, interrupt) for cfg in configs], only=task)


def why_agents_learn_alone(agent: object, device: torch.device) -> str | None:
    """Return why agents like this one cannot learn as one batch of seeds on a device; None if they can.

    Raises:
        ValueError: see `check_packages`.
    """
    check_packages()
    if device.type == "cpu":
        return import_module("baselines.update.seeds").why_not_together(agent)
    return import_module("baselines.update.captured").why_not_captured(agent)


def agents_together(agents: Sequence[object], generators: Sequence[object], device: torch.device) -> Any:
    """Return the `ctgraph_rl.learn.loop.Group` of agents on a device, each with what it draws from.

    Raises:
        ValueError: see `check_packages`.
    """
    check_packages()
    if device.type == "cpu":
        return import_module("baselines.update.seeds").SeedGroup(agents, generators)
    return import_module("baselines.update.captured").CapturedGroup(agents, generators)
