"""A session: runs that this process writes at once, each begun or resumed in a locked directory, and finished there.

A single run, or a `ctgraph_rl.runs.recorder.Recorder`, is a session of one member; seeds that learn as one batch,
experts and collectives are sessions of several. A `SessionCoupling` lets them learn.
"""

from __future__ import annotations

import io
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import torch
from typing_extensions import override

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, Rule, require
from ctgraph_rl.disk import append_line, make_folder, remove_empty, sync_folder, sync_folders, write_whole
from ctgraph_rl.learn.collective import Member
from ctgraph_rl.learn.loop import Alone, Group, Lockstep, run_loop
from ctgraph_rl.learn.progress import ProgressBar
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import AGENT, CHECKPOINTS, CURRICULUM, FAILURE, LOG, METRICS, Locks
from ctgraph_rl.log.provenance import NUMBERS_TOGETHER, code_changes, machine, provenance
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.saved import without_moments
from ctgraph_rl.log.scores import scores
from ctgraph_rl.log.sums import RESULTS, damaged, write_metrics
from ctgraph_rl.metrics.windows import OF_LIFE
from ctgraph_rl.packages import check_packages
from ctgraph_rl.runs import config
from ctgraph_rl.runs.checkpoints import Checkpoints, RunState, newest_of_all, offer_all
from ctgraph_rl.runs.explain import explain
from ctgraph_rl.tasks.curriculum_json import file_text

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console

    from ctgraph_rl.runs.experts import Expert

START_AGAIN = "overwrite=stale runs it again from the beginning, as overwrite=true does with any run"

RESTARTS = "restarts.jsonl"
"""Where a stopped run was resumed, and on which machine."""

Failures = dict[int, FloatingPointError]

Opened = TypeVar("Opened")


@dataclass(kw_only=True, eq=False)
class RunMember(Member):
    """A learner and its run's directory. Its log is in memory until `begin`.

    Args:
        config: settings in the log's first line, with the seed, as JSON.
        sources: classes and functions that learn, for `provenance`, if known.
        together: the seeds of its batch; none for a single run.
        experts: each task's single-task expert, named in the log.
        save_optimiser: whether the weights at the end come with the optimiser's moments.
    """

    run_dir: Path
    config: ReadOnlyValues
    checkpoints: Checkpoints
    sources: Iterable[str] | None
    together: Sequence[int] = ()
    experts: Sequence[Expert] | None = None
    save_optimiser: bool = True
    listeners: list[Callable[[NamedValues], object]] = field(default_factory=list)

    @property
    def about(self) -> NamedValues:
        """The first line of the log."""
        about = provenance(self.curriculum, self.sources)
        if self.together:
            about |= {"together": list(self.together), "numbers": NUMBERS_TOGETHER}
        return {**about, "config": self.config}

    def begin(self, saved: RunState | None) -> None:
        """Open the log of a new run, or of one resumed from a saved state.

        Raises:
            ValueError: if the log does not fit the saved state; if ``strict``, also for another machine or versions.
        """
        about = self.about
        if saved is not None:
            self._check_unchanged(about)
            reopen(self.run_dir)
            self.log = RunLog.resume(self.run_dir / LOG, saved["log"])
            restart = {"frames": saved["frames"], "versions": about["versions"], **machine()}
            append_line(self.run_dir / RESTARTS, restart)
            self.log.listeners.extend(self.listeners)
        else:
            if self.agent is not None or (self.run_dir / LOG).exists():  # a user's file is of no run
                remove_results(self.run_dir)  # what a run left that was stopped before its first checkpoint
            self.log = RunLog(self.run_dir / LOG)
            self.log.listeners.extend(self.listeners)
            self.log.append("run", **about)
            if self.experts is not None:
                self.log.append("experts", experts=[expert.about for expert in self.experts])
            self.log.sync()
            sync_folders(self.run_dir)
        try:
            write_whole(self.run_dir / CURRICULUM, file_text(self.curriculum.to_json()))
        except ValueError as error:  # a part of a user's class
            said = f"{CURRICULUM} is not written, so loading this run needs the curriculum"
            print(f"note: {said}: {terminal_text(error)}")

    def _check_unchanged(self, about: ReadOnlyValues) -> None:
        run_dir = self.run_dir
        before = RunLog.begun(run_dir / LOG) or {}
        lost = f"{run_dir} has checkpoints, but no {LOG} of a run: restore it, or start with overwrite=true"
        require((bool(before), lost))
        changed = ", ".join(code_changes(before, about))
        require((not changed, f"{run_dir} was begun with other code: {changed} changed; {START_AGAIN}"))
        other = {}
        for key in ("versions", "machine", "num_threads"):
            if before.get(key) != about[key]:
                other[key] = [before.get(key), about[key]]
        message = f"{run_dir} was begun with other {other}; from here on its bits may differ from those of one machine"
        require((not (self.checkpoints.strict and other), f"{message}; resume=warn resumes it all the same"))
        if other:
            warnings.warn(message, stacklevel=2)

    def finish(self) -> None:
        """Write the weights and results of a run."""
        self.log.close()
        if self.agent is not None:
            weights = io.BytesIO()
            state = self.agent.state_dict()
            torch.save(state if self.save_optimiser else without_moments(state), weights)
            write_whole(self.run_dir / AGENT, weights.getvalue())
        experts = None if self.experts is None else [expert.log for expert in self.experts]
        metrics = scores(self.log, self.curriculum, experts)
        write_metrics(self.run_dir / METRICS, metrics, OF_LIFE)
        self.checkpoints.clear()


class SessionCoupling(Protocol):
    """Lets the members of a session learn."""

    def resume(self, members: Sequence[RunMember]) -> Sequence[RunState | None]:
        """Return the state that each resumes from, None to begin; remove half-written files.

        Raises:
            ValueError: if they cannot be resumed, or cannot learn.
        """
        ...

    def learn(
        self, members: Sequence[RunMember], saved: Sequence[RunState | None], console: Console | None
    ) -> Failures:
        """Let all learn into their logs; return errors by position."""
        ...

    def end(self, members: Sequence[RunMember], failed: Failures) -> None:
        """Write what all have in common, once those that did not fail are finished."""
        ...


class Session:
    """Runs that this process writes; a context manager that unlocks at its end. Progress shows on ``console``."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console
        self._stack = ExitStack()
        self._folders = self._stack.enter_context(ExitStack())
        self._locks = self._stack.enter_context(closing(Locks()))

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def pop_all(self) -> Session:
        """Return a session that takes over what this one would close."""
        other = Session(self.console)
        other._stack = self._stack.pop_all()
        other._folders = self._folders
        other._locks = self._locks
        return other

    def lock(self, run_dir: Path, waiting: Callable[[], object] | None = None) -> None:
        """Make a directory, which is removed if it stays empty, and keep other writers out, by `Locks.add`."""
        if not run_dir.is_dir():
            make_folder(run_dir)
            self._folders.callback(remove_empty, run_dir)
        self._locks.add(run_dir, waiting)

    def enter(self, part: AbstractContextManager[Opened]) -> Opened:
        """Open what is closed at the end, such as a tracker."""
        return self._stack.enter_context(part)

    def learn(self, members: Sequence[RunMember], coupling: SessionCoupling) -> Failures:
        """Let members learn, each into its locked directory.

        Returns:
            Errors of failed ones, without results, by position.

        Raises:
            ValueError: before any work, for members that cannot learn or resume.
        """
        saved = coupling.resume(members)
        for member, state in zip(members, saved, strict=True):
            member.begin(state)
        failed = coupling.learn(members, saved, self.console)
        for number, member in enumerate(members):
            if number in failed:
                member.log.close()
            else:
                member.finish()
        coupling.end(members, failed)
        return failed


class OneBatch(SessionCoupling):
    """A coupling of seeds that learn one curriculum as one batch, or of a single run.

    Stopped runs resume from the last checkpoint that all have, and end as if they had never stopped. Those stopped in
    their first checkpoints begin again. Environment and agents live on ``device``; ``until`` and ``freeze_after`` are
    those of `Lockstep`.
    """

    def __init__(self, device: torch.device, until: float = 1.0, freeze_after: float = 1.0) -> None:
        self.device = device
        self.until = until
        self.freeze_after = freeze_after

    @override
    def resume(self, members: Sequence[RunMember]) -> Sequence[RunState | None]:
        curriculum = members[0].curriculum
        agent = members[0].agent
        for each in members:
            each.checkpoints.tidy()
        begun = [each for each in members if each.checkpoints.files()]
        saved = newest_of_all([each.checkpoints for each in members])
        named = ", ".join(str(each.run_dir) for each in begun)
        rules = []
        for each in members:
            if each not in begun:
                lost = f"{each.run_dir} has lost its checkpoints, and learns as one batch with {named}, which have some"
                rules.append((not begun, f"{lost}: restore them, or start all again with overwrite=true"))
        rules = rules or [_same_group(each) for each in begun]
        can_resume = saved is not None and (
            saved[0]["frames"] >= curriculum.frames_of(self.until) or all(rule for rule, _ in rules)
        )
        if saved is not None and can_resume:
            return saved
        one_update = agent.num_envs * agent.num_steps
        if any((each.checkpoints.newest_frames or 0) > one_update for each in begun):
            require(*rules)
        for each in begun:
            each.checkpoints.clear()
            why = "it was stopped in its group's first checkpoints, after one update"
            print(f"note: {terminal_text(each.run_dir)} begins again: {why}", file=sys.stderr)
        return [None] * len(members)

    @override
    def learn(
        self, members: Sequence[RunMember], saved: Sequence[RunState | None], console: Console | None
    ) -> Failures:
        curriculum = members[0].curriculum
        states = [state for state in saved if state is not None] or None
        done = 0 if states is None else states[0]["frames"]
        checkpoints = [each.checkpoints for each in members]
        group: Group
        offer: Callable[[Callable[[], list[NamedValues]], bool], object]
        if members[0].together:
            if states is not None:
                print(f"note: {len(states)} seeds are resumed as one batch, after {done:,} frames", file=sys.stderr)
            generators = [torch.Generator(device="cpu").set_state(each.random) for each in members]
            group = agents_together([each.agent for each in members], generators, self.device)
            offer = partial(offer_all, checkpoints)
        else:
            group = Alone(members[0].agent)
            offer = checkpoints[0].offer_one
        seeds = [each.seed for each in members]
        logs = [each.log for each in members]
        with ProgressBar(len(curriculum.blocks), curriculum.frames_of(self.until), console, done) as progress:
            lockstep = Lockstep(
                curriculum,
                group,
                seeds,
                logs,
                device=self.device,
                saved=states,
                until=self.until,
                freeze_after=self.freeze_after,
                log_units=members[0].log_units,
            )
            with closing(lockstep):
                run_loop(lockstep, progress, offer)
        self._had_failed = [number for number, state in enumerate(states or ()) if "failed" in state]
        return lockstep.failed

    @override
    def end(self, members: Sequence[RunMember], failed: Failures) -> None:
        # others could not be resumed beside one without checkpoints
        for number in failed:
            if members[number].together or number in self._had_failed:
                members[number].checkpoints.clear()


def _same_group(member: RunMember) -> Rule:
    before = (RunLog.begun(member.run_dir / LOG) or {}).get("together", [])
    how = "together=true and seed=" + ",".join(map(str, before)) if before else "together=false"
    began = f"{member.run_dir} was begun {f'with the seeds {before} together' if before else 'by itself'}"
    return before == list(member.together), f"{began}: resume it with {how}, or start again with overwrite=true"


def why_agents_learn_alone(agent: object, device: torch.device) -> str | None:
    """Return why agents like this one cannot learn as one batch of seeds on a device; None if they can."""
    check_packages()
    if device.type == "cpu":
        return import_module("baselines.update.seeds").why_not_together(agent)
    return import_module("baselines.update.captured").why_not_captured(agent)


def agents_together(agents: Sequence[object], generators: Sequence[object], device: torch.device) -> Any:
    """Return the `ctgraph_rl.learn.loop.Group` of agents on a device, each with what it draws from."""
    check_packages()
    if device.type == "cpu":
        return import_module("baselines.update.seeds").SeedGroup(agents, generators)
    return import_module("baselines.update.captured").CapturedGroup(agents, generators)


@contextmanager
def mark_failure(run_dir: Path) -> Iterator[None]:
    """Write ``failed.txt`` with the reason where a run that began or failed before, or a cell, ends by an error."""
    mark = run_dir / FAILURE
    failed_before = mark.exists()
    mark.unlink(missing_ok=True)
    try:
        yield
    except Exception as error:
        if failed_before or (run_dir / LOG).exists() or config.in_sweep():
            with suppress(OSError):
                write_whole(mark, f"{type(error).__name__}: {explain(error)}\n", synced=False)
        raise


def remove_results(run_dir: Path) -> None:
    """Remove a run's files: first the mark of completeness, last the mark of a run."""
    reopen(run_dir)
    for name in (*reversed(RESULTS[1:]), RESTARTS, LOG):
        (run_dir / name).unlink(missing_ok=True)


def reopen(run_dir: Path) -> None:
    """Remove the mark of completeness durably before other changes."""
    if (run_dir / METRICS).exists():
        (run_dir / METRICS).unlink()
        sync_folder(run_dir)


def is_whole(run_dir: Path) -> bool:
    """Return whether a complete run's results are whole; False where it can be resumed.

    Raises:
        ValueError: if they are damaged and there is no checkpoint.
    """
    lost = damaged(run_dir)
    if not lost:
        return True
    said = f"{run_dir} says that it is complete, but {', '.join(lost)} cannot be read or is not what was written"
    has_checkpoint = bool(Checkpoints(run_dir / CHECKPOINTS).files())
    require((has_checkpoint, f"{said}: restore it, or run again with overwrite=true"))
    print(f"{said}: the run is resumed from its last checkpoint")
    return False
