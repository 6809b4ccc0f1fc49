"""The loop over curricula: members learn in lock-step, a batch each, and one object couples them.

A single run is one member. Stacked seeds are members of one `Lockstep`, which share an environment. Learners that
exchange messages are a `Lockstep` each, coupled by `ctgraph_rl.learn.collective`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import NamedValues, ReadOnlyValues
from ctgraph_rl.learn.collect import Policy, make_env, without_ends
from ctgraph_rl.learn.evaluate import Evaluator, evaluate_together, measure
from ctgraph_rl.learn.refusals import check_env, check_learner, resumes
from ctgraph_rl.learn.segments import Segment, announced_id, collect_segment, guided, log_training, segments
from ctgraph_rl.learn.unit_metrics import EACH_BATCH, UnitMeter, flat_copy, norms
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.kinds.task_like import close_env

SavedState = ReadOnlyValues
"""All that the rest of a member's run depends on, as tensors and plain values."""


Learnt = dict[str, float] | FloatingPointError
"""What an agent measured on a batch, or the error that names what is not finite."""


class Progress(Protocol):
    """What the loop reports to while it runs."""

    def update(self, block: int, frames: int, episode_return: float) -> None:
        """Take the present block, from 1, the frames so far and the mean return of a batch's finished episodes."""
        ...


class Coupling(Protocol):
    """Members that learn a batch each: a `Lockstep`, or several that exchange messages."""

    @property
    def frames(self) -> int:
        """Frames of the run so far."""
        ...

    def advance(self) -> bool:
        """Let each member learn from its next batch; False at the end."""
        ...

    @property
    def block(self) -> int:
        """The block of the last batch, from 1."""
        ...

    @property
    def returns(self) -> Sequence[float]:
        """The mean return of each member's last batch; NaN where no episode ended."""
        ...

    @property
    def is_at_block_end(self) -> bool:
        """Whether a member's last batch ends a block."""
        ...

    @property
    def can_resume(self) -> bool:
        """Whether a run can resume from this state with the same bits."""
        ...

    def state(self) -> Any:
        """Return what a resumed run needs, as tensors and plain values; valid until the next batch."""
        ...


class Group(Protocol):
    """Learners that act and learn as one, such as `Alone` and `baselines.update.seeds.SeedGroup`.

    Between two calls each agent is unaffected by the others.
    """

    @property
    def agents(self) -> Sequence[Agent]:
        """Of one configuration, with different seeds."""
        ...

    @property
    def generators(self) -> Sequence[torch.Generator] | None:
        """What each agent draws from; None: torch's global generator, for one agent."""
        ...

    @property
    def device_generators(self) -> Sequence[Any] | None:
        """What each agent draws from on a GPU, with ``get_state`` and ``set_state``; None: nothing."""
        ...

    @property
    def policy(self) -> Policy:
        """Writes the actions of all rows, [agents * num_envs]; those of an agent are adjacent."""
        ...

    @property
    def greedy_policy(self) -> Policy | None:
        """Writes the most likely actions of as many adjacent rows of each agent; None: agents are evaluated in turn.

        A group that has it also has ``action_probs``, see `ctgraph_rl.agent.Agent`.
        """
        ...

    def start_task(self, task: int | None = None) -> None:
        """Begin a task."""
        ...

    def end_task(self) -> None:
        """End a task."""
        ...

    def learn(self, batch: TensorDictBase) -> Sequence[Learnt]:
        """Learn from a batch, [agents * num_envs, num_steps]; return what each agent measured, or raised.

        An agent that raised still gets batches and never changes a bit of another's.
        """
        ...


class Alone:
    """A group of one learner."""

    generators = device_generators = greedy_policy = None

    def __init__(self, agent: Agent) -> None:
        self.agents = [agent]

    @property
    def policy(self) -> Policy:
        """The agent's policy."""
        return self.agents[0].policy

    def start_task(self, task: int | None = None) -> None:
        """Start a task of the agent."""
        self.agents[0].start_task(task)

    def end_task(self) -> None:
        """End a task of the agent."""
        self.agents[0].end_task()

    def learn(self, batch: TensorDictBase) -> list[Learnt]:
        """Let the agent learn, or return what it raised."""
        try:
            return [self.agents[0].learn(batch)]
        except FloatingPointError as error:
            return [error]


class Lockstep:
    """Members that learn one curriculum as one, batch by batch.

    A member with a loss or weight that is not finite has failed and measures nothing from then on.

    Args:
        saved: what `state` returned, to resume from; None: the beginning.
        until: the share of the curriculum's frames after which learning ends, with the batch that reaches it.
        freeze_after: the share after which no agent learns from a batch that ends later, or is notified of tasks.

    Raises:
        ValueError: for a curriculum that the learners cannot learn.
    """

    def __init__(
        self,
        curriculum: Curriculum,
        group: Group,
        seeds: Sequence[int],
        logs: Sequence[RunLog],
        *,
        device: torch.device,
        saved: Sequence[SavedState] | None = None,
        until: float = 1.0,
        freeze_after: float = 1.0,
        log_units: bool | str = False,
    ) -> None:
        check_learner(curriculum, group.agents[0])
        self.curriculum = curriculum
        self.group = group
        self.seeds = seeds
        self.logs = logs
        self.last_frames = curriculum.frames_of(until)
        self.last_learned = curriculum.frames_of(freeze_after)
        self.meters: list[UnitMeter] = []
        self._metered: int | None = None  # frames that the agents had learned from when units were measured last
        if log_units is not False:
            for agent, log in zip(group.agents, logs, strict=True):
                self.meters.append(UnitMeter(curriculum, agent, log, log_units))
        self.env = self._make_env(device)
        self.can_resume = True
        self._resumes = resumes(curriculum)
        self.events = getattr(group.agents[0], "events", ())
        self.evaluators = []
        for agent, seed, log in zip(group.agents, seeds, logs, strict=True):
            untrained = deepcopy(agent.policy) if isinstance(curriculum, Stream) else None
            self.evaluators.append(Evaluator(curriculum, seed, log, device, untrained))
        self.frames: int = 0 if saved is None else saved[0]["frames"]
        self.failed: dict[int, FloatingPointError] = {}
        for number, state in enumerate(saved or ()):
            if "failed" in state:
                self.failed[number] = FloatingPointError(state["failed"])
        self.batch: TensorDictBase | None = None
        """The last batch, [members * num_envs, num_steps]."""

        self.returns: list[float] = []
        self._carried: TensorDictBase | None = None
        self._batches = self._learn_batches(saved)

    def _make_env(self, device: torch.device) -> EnvBase:
        num_envs = self.group.agents[0].num_envs
        count = len(self.seeds)
        tasks = count * self.curriculum.blocks[0].rows(num_envs)
        env = make_env(self.curriculum, tasks, self.seeds[0], device)
        try:
            check_env(self.curriculum, env)
            if self.group.generators is not None:
                seed = torch.tensor(self.seeds, device=device, dtype=torch.int64).repeat_interleave(num_envs)
                env.rows.set_streams(seed, torch.arange(num_envs, device=device).repeat(count))
        except BaseException:
            close_env(env)
            raise
        return env

    def close(self) -> None:
        """Close the environment."""
        close_env(self.env)

    @property
    def block(self) -> int:
        """The block of the last batch, from 1."""
        return self.curriculum.block_at(self.frames)

    @property
    def is_at_block_end(self) -> bool:
        """Whether a block ends with the last batch."""
        return self.curriculum.is_end(self.frames)

    def advance(self) -> bool:
        """Let all learn from the next batch; False at the end, and where all have failed."""
        return next(self._batches, False)

    def _learn_batches(self, saved: Sequence[SavedState] | None) -> Iterator[bool]:
        if len(self.failed) == len(self.logs):
            return
        if saved is None:
            self._evaluate(0)
        elif self.frames >= self.last_frames:  # nothing is collected any more
            self._restore_agents(saved)
            self._end_segment(next(segments(self.curriculum, self.frames)))
            return
        for segment in segments(self.curriculum, self.frames):
            if self.frames == segment.start:
                saved = None
                if self.frames < self.last_learned:
                    self.group.start_task(announced_id(self.curriculum, segment.blocks[0]))
                self._measure_units(self.curriculum.block_at(segment.start + 1), "start")
            restore: Callable[[], TensorDictBase] | None = None if saved is None else partial(self._restore, saved)
            if self.frames == segment.start > 0 and self.curriculum.protocol.hides_episodes:
                restore = self._start_unnoticed
            batches = collect_segment(
                segment,
                self.env,
                self.group.agents[0],
                self._evaluate,
                policy=self._policy(segment, saved),
                done=self.frames - segment.start,
                restore=restore,
                num_seeds=len(self.logs),
                guide_frames=self.curriculum.protocol.guide_frames,
            )
            for batch, carried in batches:
                self._carried = carried
                self._learn(batch, segment)
                self.can_resume = self._resumes or self.frames == segment.end
                if len(self.failed) == len(self.logs):
                    return
                yield True
                if self.frames >= self.last_frames:
                    break
            self._end_segment(segment)
            if self.frames >= self.last_frames:
                return

    def _start_unnoticed(self) -> TensorDictBase:
        """Start the next block's episodes as if nothing had ended; return the data of the next step."""
        assert self._carried is not None
        data = self._carried.clone().update(self.env.reset())
        return data.set("is_init", torch.zeros_like(data["is_init"]))

    def _policy(self, segment: Segment, saved: Sequence[SavedState] | None) -> Policy:
        task = announced_id(self.curriculum, segment.blocks[0])
        if task is None or segment.start < self.last_learned:
            return self.group.policy
        if saved is not None:
            self._restore_agents(saved)
        [agent] = self.group.agents
        return agent.policy_for(task)

    def _end_segment(self, segment: Segment) -> None:
        if self.frames == segment.end <= self.last_learned:
            self.group.end_task()
        self._evaluate(self.frames)

    def _evaluate(self, frames: int) -> None:
        moment = self.curriculum.moment(frames)
        is_end = self.curriculum.is_end(frames)
        if moment is not None:
            evaluate_members(self.evaluators, self.group, frames, moment, self.failed)
        if frames and (is_end or moment):
            self._measure_units(self.curriculum.block_at(frames), "end" if is_end else "during", frames)

    def _measure_units(self, block: int, moment: str, frames: int | None = None) -> None:
        if moment == "during" and self._metered == self.frames:
            return
        if moment != EACH_BATCH:
            self._metered = self.frames
        for number, meter in enumerate(self.meters):
            if number not in self.failed:
                meter.measure(block, self.frames if frames is None else frames, moment)

    def _learn(self, batch: TensorDictBase, segment: Segment) -> None:
        start = self.frames
        self.frames += batch.numel() // len(self.logs)
        self.batch = without_ends(batch)
        share = guided(start - segment.start, self.curriculum)
        weights = [list(meter.agent.policy.parameters()) for meter in self.meters]
        before = [flat_copy(each) for each in weights]
        is_frozen = self.frames > self.last_learned
        learnt: Sequence[Learnt] = [{} for _ in self.logs] if is_frozen else self.group.learn(self.batch)
        logged: list[NamedValues | None] = [None] * len(self.logs)
        for number, measured in enumerate(learnt):
            if number in self.failed:
                continue
            try:
                measurements = {**_require_finite(measured), **share}
            except FloatingPointError as error:
                where = f"in block {self.block} after {self.frames} frames; the run stops here"
                seed = "" if self.group.generators is None else f"seed {self.seeds[number]}: "
                self.failed[number] = FloatingPointError(f"{seed}{error} {where}")
                continue
            if self.meters:
                measurements |= norms(weights[number], before[number], measurements)
            logged[number] = measurements
        self.returns = log_training(self.logs, self.curriculum, batch, start, logged, events=self.events)
        if self.meters and self.meters[0].each_batch:
            self._measure_units(self.block, EACH_BATCH)

    def state(self) -> list[NamedValues]:
        """Return all that the rest of each member's run depends on, as tensors and plain values."""
        assert self._carried is not None, "nothing was learned yet"
        count = len(self.logs)
        of_env = _divide(self.env.state_dict(), count)
        of_data = [self._carried] if count == 1 else [part.clone() for part in self._carried.chunk(count)]
        states = []
        for number, (agent, log) in enumerate(zip(self.group.agents, self.logs, strict=True)):
            state = {
                "frames": self.frames,
                "agent": agent.state_dict(),
                "env": of_env[number],
                "carried": of_data[number].to_dict(),
                **self._random_state(number),
                "log": log.position(),
            }
            if number in self.failed:
                state["failed"] = str(self.failed[number])
            states.append(state)
        return states

    def _restore(self, saved: Sequence[SavedState]) -> TensorDictBase:
        self._restore_agents(saved)
        with saved_state_fits():
            self.env.load_state_dict(_join([state["env"] for state in saved]))
        rows = [self.env.numel() // len(saved)]
        data = [TensorDict(state["carried"], rows, device=self.env.device) for state in saved]
        self._carried = data[0] if len(data) == 1 else torch.cat(data)
        return self._carried

    def _restore_agents(self, saved: Sequence[SavedState]) -> None:
        with saved_state_fits():
            for agent, state in zip(self.group.agents, saved, strict=True):
                agent.load_state_dict(state["agent"])
        for number, state in enumerate(saved):
            self._set_random_state(number, state)

    def _random_state(self, number: int) -> NamedValues:
        device = self.env.device
        if self.group.generators is not None:
            draws = self.group.device_generators
            of_device = None if draws is None else draws[number].get_state()
            return {"random": self.group.generators[number].get_state(), "random_cuda": of_device}
        of_cuda = torch.cuda.get_rng_state(device) if device.type == "cuda" else None
        return {"random": torch.get_rng_state(), "random_cuda": of_cuda}

    def _set_random_state(self, number: int, state: SavedState) -> None:
        if self.group.generators is not None:
            self.group.generators[number].set_state(state["random"])
            if self.group.device_generators is not None:
                self.group.device_generators[number].set_state(state["random_cuda"])
            return
        torch.set_rng_state(state["random"])
        if state["random_cuda"] is not None:
            torch.cuda.set_rng_state(state["random_cuda"], self.env.device)


def evaluate_members(
    evaluators: Sequence[Evaluator], group: Group, frames: int, moment: str, failed: Collection[int]
) -> None:
    """Evaluate all members that have not failed, in one environment where they can share one."""
    how = evaluators[0].curriculum.evaluation
    left = [number for number in range(len(evaluators)) if number not in failed]
    agents = group.agents
    draws_on_device = group.device_generators is not None and not how.greedy
    if how.exact and group.greedy_policy is not None:
        policies = [group] * len(evaluators[0].tasks_at(frames))
        start = agents[0].initial_state
        measure(evaluators, policies, frames, moment, initial_state=start, failed=failed)
    elif group.generators is None or how.exact or draws_on_device:
        for number in left:
            evaluators[number].evaluate_if_due(agents[number], frames)
    elif how.greedy and group.greedy_policy is not None:
        evaluate_together(evaluators, agents, frames, moment, policy=group.greedy_policy, logged=left)
    else:
        evaluate_together([evaluators[number] for number in left], [agents[number] for number in left], frames, moment)


def run_loop(
    members: Coupling,
    progress: Progress | None,
    checkpoint: Callable[[Callable[[], Any], bool], object] | None,
) -> None:
    """Let all members learn to the end, report progress and offer the state after every batch."""
    while members.advance():
        if progress is not None:
            known = [value for value in members.returns if not math.isnan(value)]
            episode_return = sum(known) / len(known) if known else math.nan
            progress.update(members.block, members.frames, episode_return)
        if checkpoint is not None and members.can_resume:
            checkpoint(members.state, members.is_at_block_end)


def _require_finite(measured: Learnt) -> dict[str, float]:
    if isinstance(measured, FloatingPointError):
        raise measured
    for name, value in measured.items():
        if not math.isfinite(value):
            raise FloatingPointError(f"{name} is {value}")
    return measured


def _divide(state: NamedValues, count: int) -> list[NamedValues]:
    if count == 1:
        return [state]
    parts: list[NamedValues] = [{} for _ in range(count)]
    for key, value in state.items():
        for part, of_part in zip(parts, value.chunk(count), strict=True):
            part[key] = of_part.clone()
    return parts


def _join(states: Sequence[NamedValues]) -> NamedValues:
    if len(states) == 1:
        return states[0]
    return {key: torch.cat([state[key] for state in states]) for key in states[0]}


@contextmanager
def saved_state_fits() -> Iterator[None]:
    """Say what to do where a saved state is not one of an agent and curriculum."""
    try:
        yield
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        message = f"the saved state does not fit this agent and curriculum, start again (overwrite=true): {error}"
        raise ValueError(message) from error
