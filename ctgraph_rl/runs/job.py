"""From a configuration to runs: its objects are built once, learn in a session, and leave files."""

from __future__ import annotations

import json
import logging
import math
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext, suppress
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, open_dict
from rich.console import Console

from ctgraph_rl.agent import Agent, MethodLike
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, is_int, plain, require, require_memory, takes_numbers
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.disk import is_writable
from ctgraph_rl.learn.refusals import check_share, notes, why_not_together
from ctgraph_rl.learn.unit_metrics import unit_rules
from ctgraph_rl.log.escape import listed, terminal_text
from ctgraph_rl.log.files import CHECKPOINTS, CURRICULUM, LOG, METRICS
from ctgraph_rl.log.provenance import code, code_changes, is_unknown, learners, versions
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.sums import RESULTS
from ctgraph_rl.portable import hold
from ctgraph_rl.runs import config
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.experts import Expert, RunDirs, expert_curriculum, find_or_train, is_of_group
from ctgraph_rl.runs.explain import explain
from ctgraph_rl.runs.interrupt import Interrupt
from ctgraph_rl.runs.session import (
    START_AGAIN,
    Failures,
    OneBatch,
    RunMember,
    Session,
    is_whole,
    mark_failure,
    remove_results,
    why_agents_learn_alone,
)
from ctgraph_rl.runs.settings import as_before, differences, flat
from ctgraph_rl.runs.status import holds_results
from ctgraph_rl.runs.trackers import FOLDER, Tracker
from ctgraph_rl.runs.train import MakeAgent, MakePlasticity, new_agent, with_method
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.protocol import changed

OF_AN_EXPERT = ("agent", "seed", "device", "num_threads", "portable")
FEW = 5


ConfigAndPath = tuple[Any, Path]


class Recipe(NamedTuple):
    """What the seeds of a configuration share."""

    curriculum: Curriculum
    make_agent: MakeAgent


def recipe_of(cfg: DictConfig) -> Recipe:
    """Return a configuration's curriculum, and what builds its agents.

    Raises:
        ValueError: for values out of range, and parts that do not fit.
    """
    checked_device(cfg.device)
    prepare_torch(cfg)
    make_method = method_of(cfg)
    make_alone = config.target(cfg, "agent")
    curriculum = curriculum_of(cfg, make_method())
    no_experts = "experts=true trains one for each task, and a stream's metrics need none: take method=scratch"
    require((not (cfg.experts and isinstance(curriculum, Stream)), no_experts))
    for task in curriculum.tasks if cfg.experts else ():  # refuses first what an agent cannot learn
        new_agent(expert_curriculum(curriculum, task), make_alone, cfg.seed)
    return Recipe(curriculum, with_method(make_alone, make_method, curriculum, plasticity_of(cfg)))


def build(
    cfg: DictConfig, run_dir: Path, interrupt: Interrupt | None = None, recipe: Recipe | None = None
) -> RunMember:
    """Build the objects of a configuration, the agent last, which decides the state of torch's global generator.

    Args:
        recipe: by `recipe_of` another seed, whose curriculum is shared; None: of this configuration.

    Raises:
        ValueError: for values out of range, and parts that do not fit.
    """
    curriculum, make_agent = recipe_of(cfg) if recipe is None else recipe
    member = make_member(cfg, run_dir, curriculum, make_agent, settings=config.plain(cfg), interrupt=interrupt)
    usual = bool(cfg.get("plasticity")) and all(holds for holds, _ in unit_rules(curriculum, member.agent, True))
    check_share(curriculum, member.agent, cfg.objective_until)
    member.log_units = usual if cfg.log_units is None else cfg.log_units
    if member.log_units is not False:
        require(*unit_rules(curriculum, member.agent, member.log_units))
    return member


def make_member(
    cfg: DictConfig,
    run_dir: Path,
    curriculum: Curriculum,
    make_agent: MakeAgent,
    *,
    settings: ReadOnlyValues,
    interrupt: Interrupt | None,
) -> RunMember:
    """Build the agent of a run or expert, with a directory; its log holds ``settings``."""
    agent = new_agent(curriculum, make_agent, cfg.seed, cfg.device)
    return RunMember(
        curriculum,
        agent,
        cfg.seed,
        run_dir=run_dir,
        config=settings,
        checkpoints=checkpoints_of(cfg, run_dir, interrupt),
        sources=learners(settings, agent),
        save_optimiser=cfg.save_optimiser,
    )


def checkpoints_of(cfg: DictConfig, run_dir: Path, interrupt: Interrupt | None) -> Checkpoints:
    """Return the checkpoints of a configuration in a directory."""
    return Checkpoints(run_dir / CHECKPOINTS, cfg.checkpoint_seconds, cfg.resume == "strict", interrupt)


def console_of_runs() -> Console | None:
    """Return where progress shows; a sweep shows none of its runs."""
    return Console(quiet=True) if config.in_sweep() else None


def prepare(session: Session, cfg: DictConfig, member: RunMember) -> None:
    """Open a run's tracker, remove replaced results, and write the configuration."""
    run_dir = member.run_dir
    replaced = is_replaced(cfg, member)
    if "logger" in cfg:
        settings = dict(flat(member.config))
        member.listeners.append(session.enter(Tracker(config.target(cfg, "logger"), run_dir, settings)))
    elif replaced:
        shutil.rmtree(run_dir / FOLDER, ignore_errors=True)
    if replaced:
        member.checkpoints.clear()
        remove_results(run_dir)
    config.write_configuration(cfg, run_dir / ".hydra")


def is_replaced(cfg: DictConfig, member: RunMember) -> bool:
    """Return whether a run takes the place of what ``overwrite`` gives up in its directory."""
    if cfg.overwrite != config.STALE:
        return bool(cfg.overwrite)
    about = first_line(member.run_dir)
    return about is not None and bool(code_changes(about, member.about))


def settings_of_experts(cfg: DictConfig) -> NamedValues:
    """Return the settings that experts share with their run."""
    return {key: value for key, value in config.plain(cfg).items() if key in OF_AN_EXPERT}


def train_experts(
    configs: Sequence[Any], curriculum: Curriculum, interrupt: Interrupt
) -> tuple[dict[int, list[Expert]], Failures]:
    """Find or train the single-task experts of several seeds' runs, those of a task as one batch.

    Args:
        interrupt: ends waiting for other processes.

    Returns:
        The experts of each seed; the error of each seed with an expert that failed, which has none.
    """
    by_seed = {cfg.seed: cfg for cfg in configs}
    first = configs[0]

    def learn(alone: Curriculum, run_dirs: RunDirs, session: Session) -> Failures:
        members = []
        for seed, run_dir in run_dirs.items():
            cfg = by_seed[seed]
            make_alone = config.target(cfg, "agent")
            settings = settings_of_experts(cfg)
            members.append(make_member(cfg, run_dir, alone, make_alone, settings=settings, interrupt=interrupt))
        if len(members) > 1 or is_of_group(members[0].run_dir):
            for member in members:
                member.together = [*run_dirs]
        failed = session.learn(members, OneBatch(checked_device(first.device)))
        return {members[number].seed: error for number, error in failed.items()}

    deciding = {}
    for seed, cfg in by_seed.items():
        settings = settings_of_experts(cfg)
        now = code(curriculum, learners(settings, None))
        changes = {name: now[name] for name, as_ever in (("sources", {}), ("numbers", 1)) if now[name] != as_ever}
        deciding[seed] = {**as_before(settings), "versions": versions(), **changes}
    folder = Path(first.experts_dir)
    with torch.random.fork_rng():
        return find_or_train(
            curriculum,
            learn,
            folder,
            deciding,
            print,
            waiting=interrupt.check,
            console=console_of_runs(),
        )


@takes_numbers
def make_agent(
    name: str,
    curriculum: Curriculum,
    seed: int | None = None,
    *,
    method: str | None = None,
    method_settings: ReadOnlyValues | None = None,
    plasticity: str | None = None,
    plasticity_settings: ReadOnlyValues | None = None,
    detector: str | None = None,
    cell: str | None = None,
    device: torch.device | str | None = None,
    config_dir: Path | str | None = None,
    **settings: Any,
) -> Agent:
    """Build an agent for a curriculum from the yaml files that the command line reads, with the same weights.

    ``log = learn_curriculum(curriculum, agent, seed)`` then gives the measurements of ``ctgraph-rl agent=NAME``, with
    the same bits, and ``scores(log, curriculum)`` its metrics. Like a run it seeds torch's global generator, sets
    torch's threads to ``num_threads`` of ``conf/config.yaml``, and flushes denormal numbers to zero.

    Args:
        name: of a file in ``conf/agent``, such as ``"ppo"``.
        seed: decides the weights and torch's global generator, in [0, 2**63); None: as on the command line.
        method: of a file in ``conf/method``, such as ``"ewc"``; None: as on the command line.
        method_settings: replace those of the method's file, such as ``{"coeff": 50.0}``.
        plasticity: of a file in ``conf/plasticity``, such as ``"redo"``; None: as on the command line.
        plasticity_settings: replace those of its file.
        detector: of a file in ``conf/detector``, such as ``"swoks"``; None: without.
        cell: of a file in ``conf/cell``, such as ``"gru"``; None: as on the command line.
        device: where the agent lives; None: as on the command line.
        config_dir: a directory with the user's ``agent/NAME.yaml``, ``method/NAME.yaml`` and ``cell/NAME.yaml``.
        settings: replace those of the agent's file, such as ``learning_rate=0.001``.

    Raises:
        ValueError: for unknown names and settings, with the likely one; for values out of range, an agent that cannot
            learn the curriculum, and a method that learns another in its place.

    Example:
        >>> import curricula
        >>> agent = make_agent("lstm_ppo", curricula.load("su_b1_4tasks"), method="ewc", learning_rate=0.001)
        >>> agent.num_envs
        256
    """
    require((isinstance(curriculum, Curriculum), f"curriculum must be a Curriculum, got {curriculum!r:.80}"))
    names = {"agent": name, "method": method, "plasticity": plasticity, "detector": detector, "cell": cell}
    cfg = config.with_names(names, None if config_dir is None else Path(config_dir))
    cfg.seed = cfg.seed if seed is None else seed
    cfg.device = cfg.device if device is None else str(device)
    for group, values in (("agent", settings), ("method", method_settings), ("plasticity", plasticity_settings)):
        if values:
            require((bool(cfg.get(group)), f"{group}_settings are those of a {group}: give {group}=NAME, too"))
            cfg[group] = {**cfg[group], **plain(values)}
    config.check_values(cfg)
    prepare_torch(cfg)
    make_method = method_of(cfg)
    make_alone = config.target(cfg, "agent")
    kind = type(make_method()).__name__
    other = (
        f"{kind} learns another curriculum: replace yours by {kind}(...).prepare(curriculum), here and where it is used"
    )
    require((make_method().prepare(curriculum) == curriculum, other))
    make = with_method(make_alone, make_method, curriculum, plasticity_of(cfg))
    return new_agent(curriculum, make, cfg.seed, checked_device(cfg.device))


def method_of(cfg: DictConfig) -> Callable[[], MethodLike]:
    """Return what builds a configuration's method, labelled by its detector if it has one."""
    make_method = config.target(cfg, "method")
    if "detector" not in cfg:
        return make_method
    make_detector = config.target(cfg, "detector")
    return lambda: make_detector().labelling(make_method())


def plasticity_of(cfg: DictConfig) -> MakePlasticity | None:
    """Return what builds a configuration's plasticity, if it has one.

    Raises:
        ValueError: with an exchange, whose tables name none.
    """
    if not cfg.get("plasticity"):
        return None
    require(("exchange" not in cfg, "an exchange takes no plasticity: set plasticity=none, or leave the exchange out"))
    return config.target(cfg, "plasticity")


def prepare_torch(cfg: DictConfig) -> None:
    """Set how torch computes, which decides a run's bits."""
    if cfg.portable:
        hold()
    torch.set_num_threads(cfg.num_threads)
    torch.set_flush_denormal(True)


def run_job(cfg: DictConfig, run_dir: Path, built: RunMember | None = None) -> None:
    """Run a configuration in an existing directory, unless it, even read-only, holds the results.

    ``built`` are its objects, if they were just built.

    Raises:
        ValueError: before any work, for a value out of range.
        FileExistsError: for results that ``overwrite`` does not replace.
        FloatingPointError: if a loss or weight is not finite.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if (run_dir / METRICS).exists() and not is_writable(run_dir):  # no lock either: no process can write
        config.check_values(cfg)
        if is_finished(cfg, run_dir):
            return
    with Session(console_of_runs()) as session:
        session.lock(run_dir)
        with mark_failure(run_dir) if config.in_sweep() and not (run_dir / METRICS).exists() else nullcontext():
            config.check_values(cfg)
            finished = is_finished(cfg, run_dir)
        if finished:
            shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)  # if it was killed at its very end
            return
        with Interrupt() if built is None else built.checkpoints.interrupt as interrupt, mark_failure(run_dir):
            for error in learn(session, [(cfg, run_dir)], interrupt, built).values():
                raise error


def learn(
    session: Session,
    cells: Sequence[ConfigAndPath],
    interrupt: Interrupt,
    built: RunMember | None = None,
    together: bool = False,
) -> Failures:
    """Build runs that differ in their seeds, and let them learn in their locked directories.

    Args:
        cells: one, or all of a batch.
        together: learn as one batch, of one seed, too.

    Returns:
        The error of each seed that failed, or that has an expert that failed.
    """
    members: dict[int, RunMember] = {}
    recipe = recipe_of(cells[0][0]) if together else None
    for cfg, run_dir in cells:
        if built is not None and built.seed == cfg.seed:
            members[cfg.seed] = built
        else:
            members[cfg.seed] = build(cfg, run_dir, interrupt, recipe)
    first = cells[0][0]
    curriculum = members[first.seed].curriculum
    if first.experts and not curriculum.evaluation.every:
        print("note: forward transfer against experts needs evaluations within blocks: set evaluation.every")
    for note in notes(curriculum, members[first.seed].agent):
        print(f"note: {note}")
    for cfg, _ in cells:
        prepare(session, cfg, members[cfg.seed])
    failed: Failures = {}
    if first.experts:
        experts, failed = train_experts([cfg for cfg, _ in cells], curriculum, interrupt)
        members = {seed: members[seed] for seed in experts}
        for seed, member in members.items():
            member.experts = experts[seed]
    if together:
        for member in members.values():
            member.together = [*members]
    if members:
        coupling = OneBatch(checked_device(first.device), first.objective_until or 1.0, first.freeze_after or 1.0)
        errors = session.learn([*members.values()], coupling)
        for number, error in errors.items():
            failed[[*members][number]] = error
    return failed


def run_as_one(cells: Sequence[ConfigAndPath], built: RunMember | None = None) -> None:
    """Run unfinished ones as one batch; a failed seed stops no other.

    ``built`` are the objects of one, if they were just built.

    Raises:
        RuntimeError: if seeds have failed.
    """
    failed: Failures = {}
    with Session(console_of_runs()) as session:
        for _, run_dir in cells:
            session.lock(run_dir)
        left = []
        for cfg, run_dir in cells:
            if is_finished(cfg, run_dir):
                shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)  # if it was killed at its very end
            else:
                left.append((cfg, run_dir))
        with ExitStack() as stack:
            interrupt = stack.enter_context(Interrupt() if built is None else built.checkpoints.interrupt)
            for _, run_dir in left:
                stack.enter_context(mark_failure(run_dir))
            if left:
                failed = learn(session, left, interrupt, built, together=True)
        for cfg, run_dir in left:
            if cfg.seed in failed:
                with suppress(FloatingPointError), mark_failure(run_dir):
                    raise failed[cfg.seed]
    if failed:
        raise RuntimeError("; ".join(f"{type(error).__name__}: {error}" for error in failed.values()))


WEIGHTS_KEPT = 4
"""Copies of a seed's weights while it learns: themselves, gradients and Adam's two moments."""


def run_seeds(cfg: Any, run_dir: Path) -> list[Path]:
    """Run a configuration of the first seed with each of its ``seeds``, which a sweep lists; return all directories.

    Raises:
        ValueError: before any work, for a value out of range.
        RuntimeError: if seeds have failed.
    """
    alone = "a sweep's seeds are given as seed=0,1 or seed=range(2), with -m, got seeds"
    require((config.in_sweep(), alone))
    seeds = cfg.seeds
    are_seeds = (
        isinstance(seeds, Sequence)
        and all(is_int(seed, 0, 2**63 - 1) for seed in seeds)
        and len({*seeds}) == len(seeds) > 0
    )
    rule = f"seeds must be a list of different seeds that begins with seed={cfg.seed}, got {seeds}"
    require((are_seeds and seeds[0] == cfg.seed, rule))
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    shared = deepcopy(cfg)
    with open_dict(shared):
        del shared["seeds"]  # else each of n cells copies n seeds
    cells = [config.of_seed(shared, seed, run_dir) for seed in seeds]
    config.check_values(cells[0][0])
    first = build(*cells[0])
    reason = why_not_together(first.curriculum) or why_agents_learn_alone(first.agent, checked_device(cfg.device))
    if cfg.freeze_after is not None and first.curriculum.protocol.task_id != "hidden":
        reason = reason or "a frozen agent acts by its policy for the announced task"
    if reason is None:
        weights = sum(each.nbytes for each in first.agent.policy.parameters())
        batch = first.agent.num_envs * first.agent.num_steps * math.prod(first.curriculum.examples[0].observation_shape)
        needed = len(cells) * (WEIGHTS_KEPT * weights + batch)
        require_memory(f"weights and a batch of {len(cells):,} seeds", needed, "seeds at a time")
        run_as_one(cells, first)
        return [folder for _, folder in cells]
    print(f"note: seeds are trained one after the other, as {terminal_text(reason)}", file=sys.stderr)
    torch.set_rng_state(first.random)
    errors = []
    for number, (each, folder) in enumerate(cells):
        try:
            run_job(each, folder, None if number else first)
        except Exception as error:  # one that fails stops no other
            errors.append(f"seed {each.seed}: {type(error).__name__}: {explain(error)}")
    if errors:
        raise RuntimeError("; ".join(errors))
    return [folder for _, folder in cells]


def is_finished(cfg: DictConfig, run_dir: Path) -> bool:
    """Return whether the directory holds the complete results of this configuration.

    Raises:
        FileExistsError: for a run, finished or not, of another configuration or of changed code; shows the difference.
    """
    about = None if cfg.overwrite is True else first_line(run_dir)
    if about is None:
        return False
    changed = differences(about.get("config") or {}, config.plain(cfg))
    if changed:
        advice = "choose another hydra.run.dir, or overwrite=true to replace it"
        raise FileExistsError(f"{run_dir} holds a run with {listed(changed, FEW)}; {advice}")
    stale, unknown = changed_code(cfg, run_dir, {})
    if stale and cfg.overwrite != config.STALE:
        raise FileExistsError(f"{run_dir} holds a run of other code: {', '.join(stale)} changed; {START_AGAIN}")
    finished = (run_dir / METRICS).exists() and not stale and is_whole(run_dir)
    if finished:
        print("this configuration was run before; overwrite=true runs it again")
        if unknown:
            print("note: this run does not say of which source it is, so whether that has changed is unknown")
    return finished


def changed_code(cfg: DictConfig, run_dir: Path, known: dict[str, NamedValues]) -> tuple[list[str], bool]:
    """Return in words the code that changed since a run in a directory, and whether some is unknown.

    Before a run's first checkpoint no change counts. ``known`` keeps the code of configurations.
    """
    about = first_line(run_dir) if holds_results(run_dir) else None
    if about is None:
        return [], False
    now = code_of(cfg, known)
    return code_changes(about, now), is_unknown(about, now)


def code_of(cfg: DictConfig, known: dict[str, NamedValues]) -> NamedValues:
    """Return `ctgraph_rl.log.provenance.code` of a configuration's run."""
    settings = config.plain(cfg)
    deciding = {key: settings.get(key) for key in ("curriculum", "method", "plasticity", "detector", *config.PARTS)}
    key = json.dumps([deciding, learners(settings, None)], sort_keys=True)
    if key not in known:
        with suppress(Exception):  # of the code of a user; once imported it may find more modules
            config.target(cfg, "agent")
        known[key] = code(curriculum_of(cfg, method_of(cfg)()), learners(settings, None))
    return known[key]


def first_line(run_dir: Path) -> ReadOnlyValues | None:
    """Return the first line of a run's log; None without a run.

    Raises:
        FileExistsError: if a run would replace files that are of no run.
    """
    begun = RunLog.begun(run_dir / LOG)
    if begun is not None:
        return begun
    there = [name for name in RESULTS if (run_dir / name).exists()]
    if not there:
        return None
    if {*there} <= {LOG, CURRICULUM} and LOG in there and RunLog.is_blank(run_dir / LOG):
        print(f"{run_dir / LOG} has lost its first line, as the machine stopped: the run starts again")
        return None
    advice = "choose another hydra.run.dir, or overwrite=true to replace them"
    raise FileExistsError(f"{run_dir} holds {', '.join(there)}, which are of no run; {advice}")


def curriculum_of(cfg: DictConfig, method: MethodLike) -> Curriculum:
    """Return what an agent with a method learns.

    Raises:
        ValueError: for values out of range.
    """
    return method.prepare(with_changes(config.target(cfg, "curriculum")(), cfg).for_seed(cfg.seed))


def with_changes(curriculum: Curriculum, cfg: DictConfig) -> Curriculum:
    """Return the curriculum with the configuration's changes of ``evaluation`` and ``protocol``.

    Raises:
        ValueError: for values out of range.
    """
    made = type(curriculum).__name__
    require((isinstance(curriculum, Curriculum), f"{cfg.curriculum._target_} must make a Curriculum, it made a {made}"))
    protocol = config.changes_of(cfg, "protocol")
    how = curriculum.protocol
    if protocol.get("task_id") == "hidden":
        how = replace(how, task_id="hidden", num_task_ids=None, task_ids=None)  # hidden ids have no length or numbers
    how = changed("protocol", how, protocol)
    measured = changed("evaluation", curriculum.evaluation, config.changes_of(cfg, "evaluation"))
    if (how, measured) == (curriculum.protocol, curriculum.evaluation):
        return curriculum
    return replace(curriculum, evaluation=measured, protocol=how)
