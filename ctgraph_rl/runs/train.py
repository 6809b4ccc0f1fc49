"""A run in a directory: an agent learns a curriculum, and its measurements, metrics and weights are files."""

from __future__ import annotations

import io
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from inspect import signature
from pathlib import Path
from typing import NamedTuple

import torch
from rich.console import Console
from torchrl.data import Composite, TensorSpec

from ctgraph_rl.agent import Agent, MethodLike
from ctgraph_rl.batch.rows import seed_rule
from ctgraph_rl.checks import (
    NamedValues,
    ReadOnlyValues,
    Rule,
    as_path,
    is_json_object,
    require,
    require_memory,
    takes_numbers,
)
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.disk import append_line, sync_folder, sync_folders, write_whole
from ctgraph_rl.learn.collect import agent_specs
from ctgraph_rl.learn.lifelong import learn_curriculum
from ctgraph_rl.learn.loop import Group
from ctgraph_rl.learn.progress import ProgressBar
from ctgraph_rl.learn.refusals import check_adaptation, check_ids, check_rows
from ctgraph_rl.learn.stacked import learn_together
from ctgraph_rl.log.damage import damaged
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import AGENT, CHECKPOINTS, CURRICULUM, LOG, METRICS, locked
from ctgraph_rl.log.provenance import NUMBERS_TOGETHER, code_changes, learners, machine, provenance
from ctgraph_rl.log.run_log import RunLog, metrics_text, write_metrics, write_performance
from ctgraph_rl.log.scores import scores
from ctgraph_rl.log.sums import RESULTS, write_sums
from ctgraph_rl.log.tables import write_tables
from ctgraph_rl.runs.checkpoints import Checkpoints, RunState, newest_of_all, offer_all
from ctgraph_rl.runs.experts import Expert, Failures
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.curriculum_json import file_text

MakeAgent = Callable[[Composite, TensorSpec], Agent]
"""Builds an agent for an environment's unbatched observation and action specs."""

MEMBERS = (
    *("num_envs", "num_steps", "policy", "policy_for", "initial_state"),
    *("start_task", "end_task", "learn", "to", "state_dict"),
)
"""Members that a run needs of an agent."""

START_AGAIN = "overwrite=stale runs it again from the beginning, as overwrite=true does with any run"

RESTARTS = "restarts.jsonl"
"""Says, for a run that was stopped, where it was resumed and on which machine."""


def new_agent(curriculum: Curriculum, make_agent: MakeAgent, seed: int, device: torch.device | str = "cpu") -> Agent:
    """Build an agent with weights that come from the seed, which sets torch's global generator.

    Raises:
        ValueError: if it cannot learn the curriculum.
    """
    example = "make_agent must be a function of two specs, such as partial(PPO, num_envs=8, ...)"
    require(_curriculum_rule(curriculum), seed_rule(seed), (callable(make_agent), f"{example}, got {make_agent!r:.80}"))
    device = checked_device(device)
    torch.manual_seed(seed)
    specs = agent_specs(curriculum)
    require(_takes_specs(make_agent))
    agent: Agent = make_agent(*specs)
    require(_agent_rule(agent))
    frames = agent.num_envs * agent.num_steps
    batch = f"batches of num_envs={agent.num_envs} x num_steps={agent.num_steps} frames"
    require_memory(batch, 2 * frames * specs.observation["observation"].shape.numel(), "of either")
    agent = agent.to(device)
    check_rows(curriculum, agent.num_envs)
    check_adaptation(curriculum, agent)
    return agent


def _curriculum_rule(curriculum: object) -> Rule:
    return isinstance(curriculum, Curriculum), f"curriculum must be a Curriculum, got {curriculum!r:.80}"


def _agent_rule(agent: object) -> Rule:
    missing = [name for name in MEMBERS if not hasattr(agent, name)]
    built = not missing and not isinstance(agent, type)
    fix = "see ctgraph_rl.agent.Agent, and build it by new_agent(curriculum, make_agent, seed)"
    name = getattr(agent, "__name__", type(agent).__name__)
    return built, f"{name} is no agent, it lacks {', '.join(missing)}: {fix}"


def _takes_specs(make_agent: Callable[..., object]) -> Rule:
    """The rule that a function can be called with the two specs."""
    try:
        signature(make_agent).bind(None, None)
    except TypeError as error:
        name = getattr(make_agent, "__name__", type(make_agent).__name__)
        return False, f"make_agent must take two specs and nothing else, {name}: {error}; bind the rest, by partial"
    except ValueError:  # what has no signature
        pass
    return True, ""


def with_method(make_agent: MakeAgent, make_method: Callable[[], MethodLike], curriculum: Curriculum) -> MakeAgent:
    """Return a function that builds an agent and attaches a new method to it."""
    return lambda observation_spec, action_spec: make_method().attach(
        make_agent(observation_spec, action_spec), curriculum
    )


@takes_numbers
def train(
    curriculum: Curriculum,
    agent: Agent,
    run_dir: Path,
    seed: int,
    device: torch.device | str = "cpu",
    *,
    config: ReadOnlyValues | None = None,
    experts: Sequence[Expert] | None = None,
    checkpoints: Checkpoints | None = None,
    listeners: Sequence[Callable[[NamedValues], object]] = (),
    console: Console | None = None,
) -> None:
    """Let a new agent learn a curriculum, with a progress bar, and write `RESULTS` to a directory.

    A run that was stopped there is resumed from its last checkpoint, and ends as if it had never been stopped.

    Args:
        curriculum: what is learned.
        agent: just built by `new_agent`, so that torch's global generator is as its construction left it.
        run_dir: an existing directory.
        seed: decides the run, in [0, 2**63).
        device: where the environment lives, and the agent.
        config: what the first line of the log holds beside the seed, as JSON.
        experts: the single-task expert of each task; they are named in the log.
        checkpoints: default: those in the directory, every five minutes.
        listeners: are called with every measurement.
        console: where progress shows; default: standard error.

    Raises:
        ValueError: before any work, for arguments out of range and an agent that cannot learn the curriculum; and if
            the directory holds a run that cannot be resumed.
        BlockingIOError: if another writer is in the directory.
    """
    run_dir = as_path("run_dir", run_dir)
    count = len(curriculum.tasks) if isinstance(curriculum, Curriculum) else 0
    is_list = isinstance(experts, Sequence) and all(isinstance(each, Expert) for each in experts)
    one_each = experts is None or (is_list and len(experts) == count)
    can_listen = isinstance(listeners, Sequence) and all(map(callable, listeners))
    is_console = console is None or isinstance(console, Console)
    kept = checkpoints is None or isinstance(checkpoints, Checkpoints)
    require(
        _curriculum_rule(curriculum),
        _agent_rule(agent),
        seed_rule(seed),
        (is_json_object(config), f"config must be plain JSON values by name, got {config!r:.80}"),
        (run_dir.is_dir(), f"run_dir must be an existing directory, got {str(run_dir)!r:.80}; make it"),
        (one_each, f"experts must be the Expert of each of {count} tasks, or None, got {experts!r:.80}"),
        (kept, f"checkpoints must be Checkpoints(folder), or None, got {checkpoints!r:.80}"),
        (can_listen, f"listeners must be a list of functions, such as [print], got {listeners!r:.80}"),
        (is_console, f"console must be a rich.console.Console, or None, got {console!r:.80}"),
    )
    checkpoints = Checkpoints(run_dir / CHECKPOINTS) if checkpoints is None else checkpoints
    config = {"seed": seed, **(config or {})}
    where = RunDirectory(run_dir, config, checkpoints, experts=experts, listeners=listeners, console=console)
    with locked(run_dir):
        train_alone(curriculum, agent, where, seed, checked_device(device))


@dataclass(frozen=True)
class RunDirectory:
    """Where a run is written, and with what beside its measurements; see `train`."""

    run_dir: Path
    config: ReadOnlyValues
    checkpoints: Checkpoints
    together: Sequence[int] = ()  # the seeds of the group that the run is trained in; none for a single run
    experts: Sequence[Expert] | None = None
    listeners: Sequence[Callable[[NamedValues], object]] = ()
    console: Console | None = None

    def begin(self, curriculum: Curriculum, agent: Agent, saved: RunState | None) -> RunLog:
        """Return the log of a new run, or of one that is resumed from a saved state."""
        run_dir = self.run_dir
        about = provenance(curriculum, learners(self.config, agent))
        if self.together:
            about |= {"together": list(self.together), "numbers": NUMBERS_TOGETHER}
        if saved is None:
            remove_results(run_dir)  # what a run left that was stopped before its first checkpoint
            log = RunLog(run_dir / LOG)
        else:
            log = resumed_log(run_dir, saved, about, self.checkpoints.strict)
        log.listeners.extend(self.listeners)
        if saved is None:
            log.append("run", **about, config=self.config)
            if self.experts is not None:
                log.append("experts", experts=[expert.about for expert in self.experts])
            log.sync()
            sync_folders(run_dir)
        write_curriculum(curriculum, run_dir)
        return log

    def finish(self, curriculum: Curriculum, agent: Agent, log: RunLog) -> None:
        """Write the weights and the results of a run that has ended."""
        log.close()
        weights = io.BytesIO()
        torch.save(agent.state_dict(), weights)
        write_whole(self.run_dir / AGENT, weights.getvalue())
        experts = None if self.experts is None else [expert.log for expert in self.experts]
        write_results(log, curriculum, self.run_dir, experts)
        self.checkpoints.clear()


def train_alone(curriculum: Curriculum, agent: Agent, where: RunDirectory, seed: int, device: torch.device) -> None:
    """Let a new agent learn a curriculum into a directory that is locked; see `train`.

    Raises:
        ValueError: before any work, for an agent that cannot learn the curriculum, and a run that cannot be resumed.
        FloatingPointError: if it failed in a group that was stopped before it said so.
    """
    check_rows(curriculum, agent.num_envs)
    check_ids(curriculum, agent)
    checkpoints = where.checkpoints
    [saved] = _resumed_states(curriculum, [agent], [where])
    if saved is not None and "failed" in saved:
        checkpoints.clear()
        raise FloatingPointError(saved["failed"])
    done = 0 if saved is None else saved["frames"]
    progress = ProgressBar(len(curriculum.blocks), curriculum.num_frames, where.console, done)

    def learn(logs: Sequence[RunLog]) -> Failures:
        [log] = logs
        learn_curriculum(
            curriculum, agent, seed, log, progress, device=device, saved=saved, checkpoint=checkpoints.offer
        )
        return {}

    execute([Participant(curriculum, agent, where)], [saved], learn, progress)


def train_together(
    curriculum: Curriculum,
    group: Group,
    seeds: Sequence[int],
    device: torch.device,
    directories: Sequence[RunDirectory],
) -> Failures:
    """Let the agents of several seeds learn a curriculum as one batch; each is a run in its own directory.

    Runs that were stopped are resumed from the last checkpoint that all have, and end as if they had never stopped.
    Those that were stopped in their first checkpoints begin again.

    Args:
        curriculum: what is learned.
        group: the learners, just built.
        seeds: of each.
        device: where the environment lives, and the agents.
        directories: of each.

    Returns:
        The error of each seed that failed, see `learn_together`. It has no results and no checkpoint.

    Raises:
        ValueError: before any work, for an agent that cannot learn the curriculum, and runs that cannot be resumed.
    """
    checkpoints = [each.checkpoints for each in directories]
    states = _resumed_states(curriculum, group.agents, directories)
    saved = [state for state in states if state is not None] or None
    done = saved[0]["frames"] if saved else 0
    if saved:
        print(f"note: {len(saved)} seeds are resumed as one batch, after {done:,} frames", file=sys.stderr)
    progress = ProgressBar(len(curriculum.blocks), curriculum.num_frames, directories[0].console, done)

    def learn(logs: Sequence[RunLog]) -> Failures:
        offer = partial(offer_all, checkpoints)
        return learn_together(curriculum, group, seeds, logs, progress, device=device, saved=saved, checkpoint=offer)

    pairs = zip(group.agents, directories, strict=True)
    participants = [Participant(curriculum, agent, directory) for agent, directory in pairs]
    failed = execute(participants, states, learn, progress)
    for number in failed:  # last: the others could not be resumed beside a seed without a checkpoint
        directories[number].checkpoints.clear()
    return failed


class Participant(NamedTuple):
    """An agent that learns a curriculum into a directory."""

    curriculum: Curriculum
    agent: Agent
    directory: RunDirectory


def execute(
    participants: Sequence[Participant],
    saved: Sequence[RunState | None],
    learn: Callable[[Sequence[RunLog]], Failures],
    progress: ProgressBar,
) -> Failures:
    """Let agents learn, each into its directory: a single run, seeds as one batch, or members that exchange messages.

    Args:
        participants: the agents.
        saved: the state that each is resumed from.
        learn: lets all learn, given their logs; returns the error of each that failed, which then gets no results.
        progress: shows while they learn.

    Returns:
        What ``learn`` returned.
    """
    logs = []
    for participant, state in zip(participants, saved, strict=True):
        logs.append(participant.directory.begin(participant.curriculum, participant.agent, state))
    with progress:
        failed = learn(logs)
    for number, (participant, log) in enumerate(zip(participants, logs, strict=True)):
        if number in failed:
            log.close()
        else:
            participant.directory.finish(participant.curriculum, participant.agent, log)
    return failed


def _resumed_states(
    curriculum: Curriculum, agents: Sequence[Agent], directories: Sequence[RunDirectory]
) -> Sequence[RunState | None]:
    """Return the state that each of the runs that learn together is resumed from; None for all where they begin.

    Runs begin again where one has no checkpoint or was begun in another group, if all were stopped after their first
    update.

    Raises:
        ValueError: if more than that would be lost.
    """
    for each in directories:
        each.checkpoints.tidy()
    begun = [each for each in directories if each.checkpoints.files()]
    saved = newest_of_all([each.checkpoints for each in directories])
    rules = [_same_group(each.run_dir, each.together) for each in begun]
    if len(begun) < len(directories):
        rules = [_all_begun(each.run_dir, begun) for each in directories if each not in begun]
    can_resume = saved is not None and (saved[0]["frames"] == curriculum.num_frames or all(rule for rule, _ in rules))
    if saved is not None and can_resume:
        return saved
    one_update = agents[0].num_envs * agents[0].num_steps
    if any((each.checkpoints.newest_frames or 0) > one_update for each in begun):
        require(*rules)
    for each in begun:
        each.checkpoints.clear()
        why = "it was stopped in its group's first checkpoints, after one update"
        print(f"note: {terminal_text(each.run_dir)} begins again: {why}", file=sys.stderr)
    return [None] * len(directories)


def _same_group(run_dir: Path, together: Sequence[int]) -> Rule:
    """The rule that a run is resumed with the seeds beside it with which it was begun, if there were any."""
    before = (RunLog.begun(run_dir / LOG) or {}).get("together", [])
    how = "together=true and seed=" + ",".join(map(str, before)) if before else "together=false"
    began = f"{run_dir} was begun {f'with the seeds {before} together' if before else 'by itself'}"
    return before == list(together), f"{began}: resume it with {how}, or start again with overwrite=true"


def _all_begun(run_dir: Path, others: Sequence[RunDirectory]) -> Rule:
    """The rule that no run of a group has lost its checkpoints, if others have some."""
    named = ", ".join(str(each.run_dir) for each in others)
    lost = f"{run_dir} has lost its checkpoints, and learns as one batch with {named}, which have some"
    return not others, f"{lost}: restore them, or start all again with overwrite=true"


def write_curriculum(curriculum: Curriculum, run_dir: Path) -> None:
    """Write ``curriculum.json``, or say why it cannot be written: parts of a user's own classes have no JSON."""
    try:
        write_whole(run_dir / CURRICULUM, file_text(curriculum.to_json()))
    except ValueError as error:
        print(f"note: {CURRICULUM} is not written, so loading this run needs the curriculum: {terminal_text(error)}")


def write_results(log: RunLog, curriculum: Curriculum, run_dir: Path, experts: Sequence[RunLog] | None = None) -> None:
    """Write the tables of a log that is closed, the sums of all results and, last of all, the metrics."""
    write_tables(log, run_dir, parquet=False)
    write_performance(run_dir / "performance.csv", log, curriculum.labels)
    metrics = scores(log, curriculum, experts)
    write_sums(run_dir, metrics_text(metrics))
    write_metrics(run_dir / METRICS, metrics)


def remove_results(run_dir: Path) -> None:
    """Remove what a run left: first what says that it is complete, last what says that there was one."""
    _reopen(run_dir)
    for name in (*reversed(RESULTS[1:]), RESTARTS, LOG):
        (run_dir / name).unlink(missing_ok=True)


def _reopen(run_dir: Path) -> None:
    """Remove what says that a run is complete, for good before anything else of it is changed."""
    if (run_dir / METRICS).exists():
        (run_dir / METRICS).unlink()
        sync_folder(run_dir)


def resumed_log(run_dir: Path, saved: RunState, about: ReadOnlyValues, strict: bool) -> RunLog:
    """Return the log as it was at a checkpoint; warn of another machine or versions, or refuse them if ``strict``.

    Raises:
        ValueError: if the log does not fit the checkpoint, and if ``strict`` for what may change the run's bits.
    """
    path = run_dir / LOG
    before = RunLog.begun(path) or {}
    lost = f"{run_dir} has checkpoints, but no {LOG} of a run: restore it, or start with overwrite=true"
    require((bool(before), lost))
    changed = ", ".join(code_changes(before, about))
    require((not changed, f"{run_dir} was begun with other code: {changed} changed; {START_AGAIN}"))
    other = {}
    for key in ("versions", "machine", "num_threads"):
        if before.get(key) != about[key]:
            other[key] = [before.get(key), about[key]]
    message = f"{run_dir} was begun with other {other}; from here on its bits may differ from those of one machine"
    require((not (strict and other), f"{message}; resume=warn resumes it all the same"))
    if other:
        warnings.warn(message, stacklevel=2)
    _reopen(run_dir)
    log = RunLog.resume(path, saved["log"])
    append_line(run_dir / RESTARTS, {"frames": saved["frames"], "versions": about["versions"], **machine()})
    return log


def is_whole(run_dir: Path) -> bool:
    """Return whether the results of a run that says that it is complete are whole; False where it can be resumed.

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
