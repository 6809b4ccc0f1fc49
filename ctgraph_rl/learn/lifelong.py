"""The loop over a curriculum: learn its blocks in order, and evaluate at the moments that it says."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import accumulate, pairwise
from typing import Any, NamedTuple, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import takes_numbers
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.learn.collect import batches, make_env
from ctgraph_rl.learn.evaluate import EPISODE_KEYS, Evaluator, episode_means
from ctgraph_rl.learn.guide import Guide, guided_share
from ctgraph_rl.learn.rules import check_env, check_ids, check_rows, resumes
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Block

AT_THE_END = {"alarm", "rolled_back"}
"""Measurements of the end of a batch, which are 0 in its other parts."""

OfferCheckpoint = Callable[[Callable[[], dict[str, Any]], bool], object]
"""Takes a function that makes the run's state, and whether a block ends here; saves the state if it is time."""


class Actor(Protocol):
    """What collects batches: the members of an `Agent` that act."""

    num_steps: int
    policy: Any

    def initial_state(self, num_envs: int) -> TensorDict:
        """See `ctgraph_rl.agent.Agent`."""
        ...


class Progress(Protocol):
    """What `learn_curriculum` reports to while it runs."""

    def update(self, block: int, frames: int, episode_return: float) -> None:
        """Take the present block, from 1, the frames so far and the mean return of a batch's finished episodes."""
        ...


@takes_numbers
def learn_curriculum(
    curriculum: Curriculum,
    agent: Agent,
    seed: int = 0,
    log: RunLog | None = None,
    progress: Progress | None = None,
    device: torch.device | str = "cpu",
    saved: Mapping[str, Any] | None = None,
    checkpoint: OfferCheckpoint | None = None,
) -> RunLog:
    """Let an agent learn a curriculum block by block, evaluated as the curriculum says.

    The environment draws from streams of ``seed``, the agent from torch's global generator, which the caller seeds.
    Evaluation disturbs neither. Where boundaries are announced, a batch ends with its block; where they are hidden, a
    batch may hold frames of two blocks. Where an environment cannot be saved within an episode, ``checkpoint`` is
    offered the state at announced boundaries alone.

    Args:
        curriculum: what to learn.
        agent: the learner.
        seed: the environment's seed, in [0, 2**63).
        log: where measurements are appended; default: a new one in memory.
        progress: is updated after every batch.
        device: where the environment lives.
        saved: a state that ``checkpoint`` was given, to resume from with the same bits as if the run had never stopped.
            The agent is built as it was, and the log holds what it held then.
        checkpoint: is offered the state after every batch.

    Returns:
        The log; ``log.performance()`` is the performance matrix.

    Raises:
        ValueError: before any work, if frames are not a multiple of the agent's environments, or it reads task ids that
            are not shown.
        FloatingPointError: if a loss or weight is not finite; names it, block and frames.

    Example:
        >>> import curricula
        >>> from ctgraph_rl import make_agent
        >>> curriculum = curricula.load("ct2_interfering", num_frames=4096)
        >>> log = learn_curriculum(curriculum, make_agent("ppo", curriculum))
        >>> log.performance(2).shape  # before training and after each of two blocks, on two tasks
        torch.Size([3, 2])
    """
    log = RunLog() if log is None else log
    for learned in learning(curriculum, agent, seed, log, device=device, saved=saved):
        block = curriculum.block_at(learned.frames)
        if progress is not None:
            progress.update(block, learned.frames, learned.episode_return)
        if checkpoint is not None and learned.can_resume:
            checkpoint(learned.state, curriculum.is_end(learned.frames))
    return log


class Learned(NamedTuple):
    """A batch that an agent has learned from."""

    frames: int  # of the run so far
    batch: TensorDictBase  # [num_envs, num_steps]
    episode_return: float  # mean of the episodes that ended in the batch's last block; NaN without any
    state: Callable[[], dict[str, Any]]
    """Makes all that the rest of the run depends on, as tensors and plain values, until the next batch is collected."""

    can_resume: bool = True  # whether the run can go on from this state as if it had not stopped


def learning(
    curriculum: Curriculum,
    agent: Agent,
    seed: int,
    log: RunLog,
    *,
    device: torch.device | str = "cpu",
    saved: Mapping[str, Any] | None = None,
) -> Iterator[Learned]:
    """Check the arguments of `learn_curriculum`, and return an iterator that learns a batch at each step.

    Between two steps the agent may be changed, and torch's global generator given to something else if it is put back.

    Raises:
        ValueError: before any work, as `learn_curriculum` does.
    """
    device = checked_device(device)
    check_rows(curriculum, agent.num_envs)
    check_ids(curriculum, agent)
    env = make_env(curriculum, curriculum.blocks[0].rows(agent.num_envs), seed, device)
    check_env(curriculum, env)
    return _learning(curriculum, agent, env, Evaluator(curriculum, seed, log, device), saved)


def _learning(
    curriculum: Curriculum, agent: Agent, env: EnvBase, evaluator: Evaluator, saved: Mapping[str, Any] | None
) -> Iterator[Learned]:
    """Learn block by block; see `learning`."""
    log = evaluator.log
    if saved is None:
        evaluator.evaluate_if_due(agent, 0)
    elif saved["frames"] == curriculum.num_frames:  # nothing is collected any more: the rows may be those of a group
        _restore_agent(saved, agent, env.device)
        agent.end_task()
        evaluator.evaluate_if_due(agent, saved["frames"])
        return
    frames = 0 if saved is None else saved["frames"]
    for segment in segments(curriculum, frames):
        if frames == segment.start:
            agent.start_task(announced_id(curriculum, segment.blocks[0]))
            saved = None
        evaluate = partial(evaluator.evaluate_if_due, agent)
        restore = None if saved is None else partial(_restore, saved, agent, env)
        done = frames - segment.start
        how: dict[str, Any] = {"done": done, "restore": restore, "guide_frames": curriculum.protocol.guide_frames}
        for batch, carried in collect_segment(segment, env, agent, evaluate, **how):
            frames += batch.numel()
            measurements = _learn(agent, batch, curriculum.block_at(frames), frames)
            measurements |= _guided(frames - batch.numel() - segment.start, curriculum)
            episode_return = log_training(log, curriculum, batch, frames - batch.numel(), measurements)
            state = partial(_state, frames, agent, env, carried=carried, log=log)
            yield Learned(frames, batch, episode_return, state, resumes(curriculum) or frames == segment.end)
        agent.end_task()
        evaluator.evaluate_if_due(agent, frames)


class Segment(NamedTuple):
    """Blocks with no announced boundary between them."""

    start: int  # frames of the run before it
    blocks: tuple[Block, ...]

    @property
    def end(self) -> int:
        """Frames of the run at its end."""
        return self.start + sum(block.num_frames for block in self.blocks)


def segments(curriculum: Curriculum, frames: int) -> Iterator[Segment]:
    """Yield the segments that end after ``frames`` frames of the run, or right there."""
    start = 0
    for blocks in curriculum.segments:
        segment = Segment(start, blocks)
        if frames <= segment.end:
            yield segment
        start = segment.end


def collect_segment(
    segment: Segment,
    env: EnvBase,
    agent: Actor,
    evaluate: Callable[[int], object],
    *,
    done: int = 0,
    restore: Callable[[], TensorDictBase] | None = None,
    num_seeds: int = 1,
    guide_frames: int = 0,
) -> Iterator[tuple[TensorDictBase, TensorDictBase]]:
    """Yield the batches of a segment, each with the data that the next step starts from.

    Args:
        segment: what is learned; its frames are those of one seed.
        env: has the rows of all seeds.
        agent: what acts.
        evaluate: called between two steps with the frames of the run so far.
        done: frames of the segment that were learned before.
        restore: restores a state between two batches of this segment, and returns the data of the next step.
        num_seeds: seeds whose rows the environment has, equally many of each.
        guide_frames: see `ctgraph_rl.tasks.protocol.Protocol`; with one seed alone.
    """
    ends = list(accumulate(block.num_frames for block in segment.blocks))
    following = dict(zip(ends, segment.blocks[1:], strict=False))
    _set_tasks(env, segment.blocks[sum(end <= done for end in ends[:-1])], num_seeds)
    carried = None if restore is None else restore()
    num_rows = env.numel() // num_seeds
    guide = Guide(agent.policy, env, guide_frames) if done < guide_frames else None

    def between_steps(of_all_seeds: int) -> None:
        frames = of_all_seeds // num_seeds
        if guide is not None:
            guide.frames = frames
        if frames:
            evaluate(segment.start + frames)
        next_end = frames + num_rows
        if next_end in following:  # so that a row whose episode ends with the block does not begin another of its task
            _set_tasks(env, following[next_end], num_seeds, at_episode_end=True)

    length, num_steps, state = num_seeds * ends[-1], agent.num_steps, agent.initial_state
    where: dict[str, Any] = {"between_steps": between_steps, "carried": carried, "done": num_seeds * done}
    return batches(env, agent.policy if guide is None else guide, length, num_steps, state, **where)


def _set_tasks(env: EnvBase, block: Block, num_seeds: int, at_episode_end: bool = False) -> None:
    """Give an environment the tasks of a block, the rows of each seed the same."""
    if block.switch is None:
        env.set_tasks(num_seeds * block.rows(env.numel() // num_seeds), at_episode_end)
    else:
        env.switch_tasks(block.tasks, block.switch, at_episode_end)


def announced_id(curriculum: Curriculum, block: Block) -> int | None:
    """Return the task id that the agent gets at the announced start of a block of one task, unless ids are hidden."""
    how = curriculum.protocol
    known = how.task_id != "hidden" and how.boundaries == "announced" and len(set(block.tasks)) == 1
    return curriculum.task_ids[block.tasks[0]] if known else None


def _guided(frames: int, curriculum: Curriculum) -> dict[str, float]:
    """Return the share of new episodes that was guided when a batch began; nothing without a guide."""
    guide_frames = curriculum.protocol.guide_frames
    return {"guided_share": guided_share(frames, guide_frames)} if guide_frames else {}


def _learn(agent: Agent, batch: TensorDictBase, block: int, frames: int) -> dict[str, float]:
    """Let the agent learn from a batch; a value that is not finite stops the run."""
    try:
        measurements = agent.learn(batch)
        require_finite(measurements)
    except FloatingPointError as error:
        raise FloatingPointError(f"{error} in block {block} after {frames} frames; the run stops here") from None
    return measurements


def require_finite(measurements: Mapping[str, float]) -> None:
    """Refuse a measurement that is not finite.

    Raises:
        FloatingPointError: names it.
    """
    for name, value in measurements.items():
        if not math.isfinite(value):
            raise FloatingPointError(f"{name} is {value}")


def log_training(
    log: RunLog, curriculum: Curriculum, batch: TensorDictBase, start: int, measurements: Mapping[str, float]
) -> float:
    """Append a line for each block that a batch has frames of; return the mean return of the last line."""
    frames, end = start, start + batch.numel()
    for part in _of_one_block(batch, start, curriculum.ends):
        frames += part.numel()
        after = part["next"]
        episodes = episode_means(after.select(*EPISODE_KEYS, strict=False)[after["done"].squeeze(-1)])
        events = {} if frames == end else dict.fromkeys(measurements.keys() & AT_THE_END, 0)
        given = {**episodes, **measurements, **events}
        log.append("training", block=curriculum.block_at(frames), frames=frames, **given)
    return episodes["return_mean"]


def _of_one_block(batch: TensorDictBase, start: int, ends: Sequence[int]) -> Iterator[TensorDictBase]:
    """Cut a batch that begins after ``start`` frames where blocks end within it."""
    rows, steps = batch.shape
    first, last = bisect_right(ends, start), bisect_left(ends, start + batch.numel())
    cuts = [0, *((end - start) // rows for end in ends[first:last]), steps]
    return (batch[:, first:last] for first, last in pairwise(cuts))


def _state(frames: int, agent: Agent, env: EnvBase, carried: TensorDictBase, log: RunLog) -> dict[str, Any]:
    """Return all that the rest of a run depends on, as tensors and plain values."""
    on_cuda = env.device.type == "cuda"
    return {
        "frames": frames,
        "agent": agent.state_dict(),
        "env": env.state_dict(),
        "carried": carried.to_dict(),
        "random": torch.get_rng_state(),
        "random_cuda": torch.cuda.get_rng_state(env.device) if on_cuda else None,
        "log": log.position(),
    }


def _restore(saved: Mapping[str, Any], agent: Agent, env: EnvBase) -> TensorDictBase:
    """Restore a saved state; return the data that the next step starts from.

    Raises:
        ValueError: if it is not one of this agent and curriculum.
    """
    _restore_agent(saved, agent, env.device)
    with saved_state_fits():
        env.load_state_dict(saved["env"])
    return TensorDict(saved["carried"], env.batch_size, device=env.device)


def _restore_agent(saved: Mapping[str, Any], agent: Agent, device: torch.device) -> None:
    """Restore the agent of a saved state, and the generator that it draws from.

    Raises:
        ValueError: if it is not one of this agent.
    """
    with saved_state_fits():
        agent.load_state_dict(saved["agent"])
    torch.set_rng_state(saved["random"])
    if saved["random_cuda"] is not None:
        torch.cuda.set_rng_state(saved["random_cuda"], device)


@contextmanager
def saved_state_fits() -> Iterator[None]:
    """Say what to do where a saved state is not one of an agent and curriculum."""
    try:
        yield
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        message = f"the saved state does not fit this agent and curriculum, start again (overwrite=true): {error}"
        raise ValueError(message) from error
