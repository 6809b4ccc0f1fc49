"""One run of a configuration: its objects are built once, learn, and leave files."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console

from ctgraph_rl.agent import Agent, MethodLike
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, plain, require, takes_numbers
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.disk import is_writable
from ctgraph_rl.learn.refusals import notes
from ctgraph_rl.log.files import CHECKPOINTS, CURRICULUM, LOG, METRICS, locked
from ctgraph_rl.log.provenance import code, code_changes, is_unknown, learners, versions
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.sums import RESULTS
from ctgraph_rl.portable import hold
from ctgraph_rl.runs import config
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.experts import Expert, Failures, RunDirs, expert_curriculum, find_or_train, is_of_group
from ctgraph_rl.runs.interrupt import Interrupt
from ctgraph_rl.runs.settings import as_before, differences, flat
from ctgraph_rl.runs.status import holds_results, mark_failure
from ctgraph_rl.runs.trackers import FOLDER, Tracker
from ctgraph_rl.runs.train import (
    START_AGAIN,
    MakeAgent,
    RunDirectory,
    is_whole,
    new_agent,
    remove_results,
    train_alone,
    with_method,
)
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import changed

OF_AN_EXPERT = ("agent", "seed", "device", "num_threads", "portable")
"""Settings that a single-task expert shares with the run that needs it."""


@dataclass(frozen=True)
class Job:
    """The objects of a configuration.

    Args:
        cfg: the composed configuration.
        curriculum: what is learned, with all changes of the configuration and the method.
        agent: the learner with its method; torch's global generator is as its construction left it.
        make_alone: builds the agent without a method, for single-task experts.
        device: where environment and agent live.
        interrupt: notices when the process is asked to stop.
    """

    cfg: DictConfig
    curriculum: Curriculum
    agent: Agent
    make_alone: MakeAgent
    device: torch.device
    interrupt: Interrupt

    @classmethod
    def of(cls, cfg: DictConfig, interrupt: Interrupt) -> Job:
        """Build the objects of a configuration, the agent last.

        Raises:
            ValueError: for values out of range, and parts that do not go together.
        """
        device = checked_device(cfg.device)
        prepare_torch(cfg)
        make_method = method_of(cfg)
        make_alone = config.target(cfg, "agent")
        curriculum = curriculum_of(cfg, make_method())
        for task in curriculum.tasks if cfg.experts else ():  # refuses first what an agent cannot learn
            new_agent(expert_curriculum(curriculum, task), make_alone, cfg.seed)
        agent = new_agent(curriculum, with_method(make_alone, make_method, curriculum), cfg.seed, device)
        return cls(cfg, curriculum, agent, make_alone, device=device, interrupt=interrupt)

    def learn(self, run_dir: Path) -> None:
        """Learn into a directory; the single-task experts first, where the configuration asks for them."""
        with self.prepared(run_dir) as where:
            train_alone(self.curriculum, self.agent, where, self.cfg.seed, self.device)

    @contextmanager
    def prepared(
        self, run_dir: Path, together: Sequence[int] = (), experts: Sequence[Expert] | None = None
    ) -> Iterator[RunDirectory]:
        """Prepare a directory: results that are replaced are removed, experts are found or trained, trackers opened.

        Args:
            run_dir: the directory.
            together: the seeds of the group that the run is trained in, if there are others.
            experts: of each task, if they were trained before.
        """
        cfg = self.cfg
        saved = self._checkpoints(run_dir)
        with self._tracking(run_dir) as listeners:
            if self._replaces(run_dir):
                saved.clear()
                remove_results(run_dir)
            config.write_configuration(cfg, run_dir / ".hydra")
            if cfg.experts and experts is None:
                with torch.random.fork_rng():
                    experts = self._experts()
            yield RunDirectory(
                run_dir,
                config.plain(cfg),
                saved,
                together=together,
                experts=experts,
                listeners=listeners,
                console=self._console,
            )

    @property
    def _console(self) -> Console | None:
        """Where progress shows: a sweep shows none of its runs."""
        return Console(quiet=True) if config.in_sweep() else None

    @property
    def _of_experts(self) -> NamedValues:
        """The settings that the run shares with its experts."""
        return {key: value for key, value in config.plain(self.cfg).items() if key in OF_AN_EXPERT}

    @property
    def decides_experts(self) -> NamedValues:
        """All that the numbers of the run's experts depend on, beside their curriculum."""
        settings = self._of_experts
        now = _code(self.curriculum, settings)
        changed = {name: now[name] for name, as_ever in (("sources", {}), ("numbers", 1)) if now[name] != as_ever}
        return {**as_before(settings), "versions": versions(), **changed}

    def expert(self, alone: Curriculum, run_dir: Path, together: Sequence[int] = ()) -> tuple[Agent, RunDirectory]:
        """Build an agent that learns a single task, as `new_agent` does, and prepare its directory."""
        agent = new_agent(alone, self.make_alone, self.cfg.seed, self.device)
        saved = self._checkpoints(run_dir)
        return agent, RunDirectory(run_dir, self._of_experts, saved, together, console=self._console)

    def learn_alone(self, alone: Curriculum, run_dirs: RunDirs) -> Failures:
        """Let an agent learn a single task, or resume what was begun so; what a group has half learned begins again."""
        agent, where = self.expert(alone, run_dirs[self.cfg.seed])
        if is_of_group(where.run_dir) and where.checkpoints.newest_frames != alone.num_frames:
            where.checkpoints.clear()
        train_alone(alone, agent, where, self.cfg.seed, self.device)
        return {}

    def _experts(self) -> list[Expert]:
        """Return the experts of the curriculum, found or trained with the run's own agent, seed and threads."""
        folder = Path(self.cfg.experts_dir)
        keys = {self.cfg.seed: self.decides_experts}
        found, _ = find_or_train(self.curriculum, self.learn_alone, folder, keys, print, waiting=self.interrupt.check)
        return found[self.cfg.seed]

    def _checkpoints(self, run_dir: Path) -> Checkpoints:
        strict = self.cfg.resume == "strict"
        return Checkpoints(run_dir / CHECKPOINTS, self.cfg.checkpoint_seconds, strict, self.interrupt)

    def _replaces(self, run_dir: Path) -> bool:
        """Return whether a run of the directory is replaced and not resumed."""
        if self.cfg.overwrite != config.STALE:
            return bool(self.cfg.overwrite)
        about = first_line(run_dir)
        return about is not None and bool(code_changes(about, _code(self.curriculum, config.plain(self.cfg))))

    @contextmanager
    def _tracking(self, run_dir: Path) -> Iterator[list[Tracker]]:
        """Open the tracker that ``logger`` names, if it names one, and close it at the end."""
        if "logger" not in self.cfg:
            if self._replaces(run_dir):
                shutil.rmtree(run_dir / FOLDER, ignore_errors=True)
            yield []
            return
        settings = dict(flat(config.plain(self.cfg)))
        with Tracker(config.target(self.cfg, "logger"), run_dir, settings) as tracker:
            yield [tracker]


@takes_numbers
def make_agent(
    name: str,
    curriculum: Curriculum,
    seed: int | None = None,
    *,
    method: str | None = None,
    method_settings: ReadOnlyValues | None = None,
    detector: str | None = None,
    cell: str | None = None,
    device: torch.device | str | None = None,
    config_dir: Path | str | None = None,
    **settings: Any,
) -> Agent:
    """Build an agent for a curriculum from the yaml files that the command line reads, with the same weights.

    ``log = learn_curriculum(curriculum, agent, seed)`` then gives the measurements of ``ctgraph-rl agent=NAME``, with
    the same bits, and ``scores(log, curriculum)`` its metrics. As a run does, this seeds torch's global generator, sets
    the number of torch's threads to ``num_threads`` of ``conf/config.yaml``, and flushes denormal numbers to zero.

    Args:
        name: of a file in ``conf/agent``, such as ``"ppo"``.
        curriculum: what the agent will learn.
        seed: decides the weights and torch's global generator, in [0, 2**63); None: as on the command line.
        method: name of a file in ``conf/method``, such as ``"ewc"``; None: as on the command line.
        method_settings: values that replace those of the method's file, such as ``{"coeff": 50.0}``.
        detector: name of a file in ``conf/detector``, such as ``"swoks"``; None: without.
        cell: name of a file in ``conf/cell``, such as ``"gru"``; None: as on the command line.
        device: where the agent lives; None: as on the command line.
        config_dir: a directory with the user's ``agent/NAME.yaml``, ``method/NAME.yaml`` and ``cell/NAME.yaml``.
        settings: values that replace those of the agent's file, such as ``learning_rate=0.001``.

    Raises:
        ValueError: for unknown names and settings, with the one that was probably meant; for values out of range, an
            agent that cannot learn the curriculum, and a method that learns another curriculum in its place.

    Example:
        >>> import curricula
        >>> agent = make_agent("lstm_ppo", curricula.load("su_b1_4tasks"), method="ewc", learning_rate=0.001)
        >>> agent.num_envs
        256
    """
    require((isinstance(curriculum, Curriculum), f"curriculum must be a Curriculum, got {curriculum!r:.80}"))
    names = {"agent": name, "method": method, "detector": detector, "cell": cell}
    cfg = config.with_names(names, None if config_dir is None else Path(config_dir))
    cfg.seed = cfg.seed if seed is None else seed
    cfg.device = cfg.device if device is None else str(device)
    for group, values in (("agent", settings), ("method", plain(method_settings or {}))):
        cfg[group] = {**cfg[group], **values}
    config.check_values(cfg)
    prepare_torch(cfg)
    make_method = method_of(cfg)
    make_alone = config.target(cfg, "agent")
    kind = type(make_method()).__name__
    other = (
        f"{kind} learns another curriculum: replace yours by {kind}(...).prepare(curriculum), here and where it is used"
    )
    require((make_method().prepare(curriculum) == curriculum, other))
    return new_agent(curriculum, with_method(make_alone, make_method, curriculum), cfg.seed, checked_device(cfg.device))


def method_of(cfg: DictConfig) -> Callable[[], MethodLike]:
    """Return what builds the method of a configuration, labelled by its detector if it has one."""
    make_method = config.target(cfg, "method")
    if "detector" not in cfg:
        return make_method
    make_detector = config.target(cfg, "detector")
    return lambda: make_detector().labelling(make_method())


def prepare_torch(cfg: DictConfig) -> None:
    """Set how torch computes, which a run's bits depend on."""
    if cfg.portable:
        hold()
    torch.set_num_threads(cfg.num_threads)
    torch.set_flush_denormal(True)


def run_job(cfg: DictConfig, run_dir: Path, job: Job | None = None) -> None:
    """Run a configuration in an existing directory, unless its results are there; a read-only one may hold them.

    Args:
        cfg: the composed configuration.
        run_dir: the directory.
        job: its objects, if they were just built.

    Raises:
        ValueError: before any work, for a value out of range.
        FileExistsError: if the directory holds results that ``overwrite`` does not allow to replace.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if (run_dir / METRICS).exists() and not is_writable(run_dir):  # no lock either: no process can write
        config.check_values(cfg)
        if is_finished(cfg, run_dir):
            return
    with locked(run_dir):
        with mark_failure(run_dir) if config.in_sweep() and not (run_dir / METRICS).exists() else nullcontext():
            config.check_values(cfg)
            finished = is_finished(cfg, run_dir)
        if finished:
            shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)  # if it was killed at its very end
            return
        with Interrupt() if job is None else job.interrupt as interrupt, mark_failure(run_dir):
            learn(cfg, run_dir, interrupt, job)


def learn(cfg: DictConfig, run_dir: Path, interrupt: Interrupt | None = None, job: Job | None = None) -> None:
    """Build the objects of a configuration, unless they are given, and let them learn into a directory."""
    if job is None:
        job = Job.of(cfg, Interrupt() if interrupt is None else interrupt)
    if cfg.experts and not job.curriculum.evaluation.every:
        print("note: forward transfer against experts needs evaluations within blocks: set evaluation.every")
    for note in notes(job.curriculum):
        print(f"note: {note}")
    job.learn(run_dir)


def is_finished(cfg: DictConfig, run_dir: Path) -> bool:
    """Return whether the directory already holds the results of this configuration, complete.

    Raises:
        FileExistsError: if it holds a run, finished or not, of another configuration or of code that has changed;
            shows the difference.
    """
    about = None if cfg.overwrite is True else first_line(run_dir)
    if about is None:
        return False
    changed = differences(about.get("config") or {}, config.plain(cfg))
    if changed:
        advice = "choose another hydra.run.dir, or overwrite=true to replace it"
        raise FileExistsError(f"{run_dir} holds a run with {', '.join(changed)}; {advice}")
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
    """Return in words what code has changed since a configuration was run in a directory, and whether some is unknown.

    A run that was stopped before its first checkpoint has nothing that a change could concern.

    Args:
        cfg: the composed configuration.
        run_dir: the directory.
        known: the code of configurations that differ from this one in what does not matter; it is added to.
    """
    about = first_line(run_dir) if holds_results(run_dir) else None
    if about is None:
        return [], False
    now = code_of(cfg, known)
    return code_changes(about, now), is_unknown(about, now)


def code_of(cfg: DictConfig, known: dict[str, NamedValues]) -> NamedValues:
    """Return what a run of a configuration would store of its code; see `ctgraph_rl.log.provenance.code`."""
    settings = config.plain(cfg)
    deciding = {key: settings.get(key) for key in ("curriculum", "method", "detector", *config.PARTS)}
    key = json.dumps([deciding, learners(settings, None)], sort_keys=True)
    if key not in known:
        with suppress(Exception):  # of the code of a user; once imported it may find more modules
            config.target(cfg, "agent")
        known[key] = _code(curriculum_of(cfg, method_of(cfg)()), settings)
    return known[key]


def _code(curriculum: Curriculum, settings: ReadOnlyValues) -> NamedValues:
    return code(curriculum, learners(settings, None))


def first_line(run_dir: Path) -> ReadOnlyValues | None:
    """Return the first line of the log of the run that a directory holds; None without a run.

    Raises:
        FileExistsError: if it holds files that a run would replace, and that are of no run.
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
    """Return what a configuration lets an agent with a method learn.

    Raises:
        ValueError: for values out of range.
    """
    return method.prepare(with_changes(config.target(cfg, "curriculum")(), cfg))


def with_changes(curriculum: Curriculum, cfg: DictConfig) -> Curriculum:
    """Return the curriculum with what ``evaluation`` and ``protocol`` of the configuration change.

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
