"""The only loop of the project: learn the blocks of a curriculum in order, evaluate all tasks at every boundary."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ctgraph_rl.agent import Agent
from ctgraph_rl.batch.native import is_native
from ctgraph_rl.checks import at_least_one, is_int, require
from ctgraph_rl.core.dynamics import OUTCOME_FAIL, OUTCOME_GOAL
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import Step, in_time_order, take_step
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.policies import RandomPolicy
from ctgraph_rl.tasks.curriculum import Block, Curriculum, Evaluation
from ctgraph_rl.tasks.task import Task

Policy = Callable[[TensorDictBase], TensorDictBase]
Checkpoint = Callable[[Callable[[], dict[str, Any]], bool], object]
"""Is offered a function that makes the run's state, and whether a block ends here."""

InitialState = Callable[[int], TensorDict]


TRIAL = "trial"
"""A recurrent state with this key lasts over episodes: the policy starts it anew itself, where a trial begins."""


class Progress(Protocol):
    """What `learn_curriculum` tells while it runs."""

    def update(self, block: int, frames: int, episode_return: float) -> None:
        """A batch is done: block counted from 1, frames of the run so far, mean return of its finished episodes."""
        ...


def learn_curriculum(
    curriculum: Curriculum,
    agent: Agent,
    seed: int = 0,
    log: RunLog | None = None,
    progress: Progress | None = None,
    device: torch.device | str = "cpu",
    saved: Mapping[str, Any] | None = None,
    checkpoint: Checkpoint | None = None,
) -> RunLog:
    """Let an agent learn a curriculum block by block, evaluated as the curriculum says.

    Training randomness of the environment comes from ``seed``; the agent draws from torch's global generator, which
    is the caller's to seed. Evaluation disturbs neither. Where boundaries are announced, a batch ends with its block;
    where they are hidden, batches go over them.

    Args:
        curriculum: what to learn.
        agent: who learns.
        seed: the environment's seed, in [0, 2**63).
        log: where measurements go; default: a new one in memory.
        progress: is told after every batch.
        device: where the environment lives.
        saved: a state that ``checkpoint`` was offered, to go on from as if never stopped; the agent is built as it was,
            and the log holds what it held then.
        checkpoint: is offered the state after every update.

    Returns:
        The log; ``log.performance()`` is the performance matrix.

    Raises:
        ValueError: before any work, if frames are not a multiple of the agent's rows, or it reads task ids that are not
            shown.
        FloatingPointError: if a loss or weight is not finite; names it, block and frames.
    """
    log = RunLog() if log is None else log
    check_rows(curriculum, agent.num_envs)
    _check_ids(curriculum, agent)
    env = make_env(curriculum, curriculum.blocks[0].rows(agent.num_envs), seed, device)
    examiner = Examiner(curriculum, seed, log, device)
    if saved is None:
        examiner.examine(agent, 0)
    frames = 0 if saved is None else saved["frames"]
    for start, blocks in _left(curriculum, frames):
        if frames == start:
            agent.start_task(_given_id(curriculum, blocks[0]))
            saved = None
        for batch, carried in _collect_blocks(env, agent, blocks, partial(examiner.examine, agent), start, saved):
            after = frames + batch.numel()
            measurements = _learn(agent, batch, curriculum.block_at(after), after)
            for part in _of_one_block(batch, frames, curriculum.ends):
                frames += part.numel()
                block = curriculum.block_at(frames)
                episodes = episode_means(part["next"][part["next", "done"].squeeze(-1)])
                log.append("training", block=block, frames=frames, **episodes, **measurements)
            if progress is not None:
                progress.update(block, frames, episodes["return_mean"])
            if checkpoint is not None:
                checkpoint(partial(_state, frames, agent, env, carried, log), frames in curriculum.ends)
        agent.end_task()
        examiner.examine(agent, frames)
    return log


def make_env(
    curriculum: Curriculum, tasks: Sequence[Task], seed: int, device: torch.device | str = "cpu"
) -> CTGraphEnv:
    """An environment for a curriculum's tasks, one per row, that shows task ids where the protocol gives them.

    Held-out tasks have no id, which shows as zeros. The environment is a C kernel where there can be one, with the same
    bits.
    """
    how, pool = curriculum.protocol, (*curriculum.tasks, *curriculum.evaluation.held_out)
    place: dict[str, Any] = {"task_pool": pool, "device": device}
    place["compiled"] = is_native((task.reward_fn for task in pool), device)
    if how.task_id != "one_hot":
        return CTGraphEnv(tasks, seed, **place)
    length = how.length(len(curriculum.tasks))
    return CTGraphEnv(tasks, seed, task_ids=curriculum.task_ids, num_task_ids=length, **place)


def _left(curriculum: Curriculum, frames: int) -> Iterator[tuple[int, tuple[Block, ...]]]:
    """The stretches that do not end before ``frames`` frames of the run, each with the frames at its start."""
    start = 0
    for blocks in curriculum.stretches:
        end = start + sum(block.num_frames for block in blocks)
        if frames <= end:
            yield start, blocks
        start = end


def _state(frames: int, agent: Agent, env: CTGraphEnv, carried: TensorDictBase, log: RunLog) -> dict[str, Any]:
    """All that the rest of a run depends on, as tensors and plain values."""
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


def _restore(saved: Mapping[str, Any], agent: Agent, env: CTGraphEnv) -> TensorDictBase:
    """Go back to a saved state; returns what the next step starts from.

    Raises:
        ValueError: if it is not one of this agent and curriculum.
    """
    try:
        agent.load_state_dict(saved["agent"])
        env.load_state_dict(saved["env"])
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        message = f"the saved state does not fit this agent and curriculum, start anew (overwrite=true): {error}"
        raise ValueError(message) from error
    torch.set_rng_state(saved["random"])
    if saved["random_cuda"] is not None:
        torch.cuda.set_rng_state(saved["random_cuda"], env.device)
    return TensorDict(saved["carried"], env.batch_size, device=env.device)


def _collect_blocks(
    env: CTGraphEnv,
    agent: Agent,
    blocks: Sequence[Block],
    examine: Callable[[int], object],
    start: int,
    saved: Mapping[str, Any] | None = None,
) -> Iterator[tuple[TensorDictBase, TensorDictBase]]:
    """Batches of blocks with hidden boundaries between them, after ``start`` frames of the run.

    With each comes what the next step starts from. A saved state is one between two batches of these blocks.
    """
    ends = list(accumulate(block.num_frames for block in blocks))
    following = dict(zip(ends, blocks[1:], strict=False))
    done = 0 if saved is None else saved["frames"] - start
    _enter(env, blocks[sum(end <= done for end in ends[:-1])])
    carried = None if saved is None else _restore(saved, agent, env)

    def between_steps(frames: int) -> None:
        if frames:
            examine(start + frames)
        next_end = frames + env.numel()
        if next_end in following:  # so that a row whose episode ends with the block does not begin another of its task
            _enter(env, following[next_end], at_episode_end=True)

    return _batches(env, agent.policy, ends[-1], agent.num_steps, agent.initial_state, between_steps, carried, done)


def _of_one_block(batch: TensorDictBase, start: int, ends: Iterable[int]) -> Iterator[TensorDictBase]:
    """A batch that begins after ``start`` frames, cut where blocks end within it."""
    rows, steps = batch.shape
    cuts = [0, *((end - start) // rows for end in ends if start < end < start + batch.numel()), steps]
    return (batch[:, first:last] for first, last in pairwise(cuts))


def _enter(env: CTGraphEnv, block: Block, at_episode_end: bool = False) -> None:
    """Go over to a block's tasks."""
    if block.switch is None:
        env.set_tasks(block.rows(env.numel()), at_episode_end)
    else:
        env.switch_tasks(block.tasks, block.switch, at_episode_end)


def _given_id(curriculum: Curriculum, block: Block) -> int | None:
    """The task id that the agent is given at the announced start of a block of one task, unless ids are hidden."""
    how = curriculum.protocol
    told = how.task_id != "hidden" and how.boundaries == "announced" and len(set(block.tasks)) == 1
    return curriculum.task_ids[block.tasks[0]] if told else None


def check_rows(curriculum: Curriculum, num_envs: int) -> None:
    """Refuse a curriculum whose blocks cannot be learned in whole steps of ``num_envs`` rows.

    Raises:
        ValueError: names the block and the nearest possible numbers of frames, or the tasks that cannot share the rows.
    """
    evaluation = curriculum.evaluation
    evaluation.check((*curriculum.tasks, *evaluation.held_out))
    rules: dict[Any, tuple[bool, str]] = {"every": evaluation.every_rule(num_envs)}
    for block in curriculum.blocks:
        block.rows(num_envs)
        alike = [str(i) for i, other in enumerate(curriculum.blocks, 1) if other.num_frames == block.num_frames]
        rules[block.num_frames] = block.frame_rule(num_envs, f"block {', '.join(alike)}")
    require(*rules.values())


def _check_ids(curriculum: Curriculum, agent: Agent) -> None:
    """Refuse an agent that was made for task ids in its observations where the curriculum shows none."""
    reads = "task_id" in (getattr(agent.policy, "in_keys", None) or ())
    shows = curriculum.protocol.task_id == "one_hot"
    message = f"{type(agent).__name__} reads task ids, which {curriculum.name} does not show"
    require((shows or not reads, f"{message}; give it a curriculum with protocol.task_id=one_hot, or make a new agent"))


def collect(
    env: CTGraphEnv,
    policy: Policy,
    num_frames: int,
    num_steps: int,
    initial_state: InitialState | None = None,
    between_steps: Callable[[int], object] | None = None,
) -> Iterator[TensorDictBase]:
    """Batches of [rows, num_steps] in time order, from a reset on; the last one may be shorter.

    Args:
        env: where to act.
        policy: writes ``action`` and, if recurrent, its state under ``("next", key)``.
        num_frames: frames in all, a multiple of the rows.
        num_steps: steps in a batch.
        initial_state: gives the recurrent state that the rows start with.
        between_steps: called before every step with the frames collected so far, after what was made of a batch.

    Raises:
        ValueError: for a number of frames that is not a multiple of the rows, and less than one step.
    """
    whole = is_int(num_frames, 1) and num_frames % env.numel() == 0
    require(
        (whole, f"num_frames must be a multiple of the {env.numel()} rows, got {num_frames!r}"),
        *at_least_one(num_steps=num_steps),
    )
    return (batch for batch, _ in _batches(env, policy, num_frames, num_steps, initial_state, between_steps))


@torch.no_grad()
def _batches(
    env: CTGraphEnv,
    policy: Policy,
    num_frames: int,
    num_steps: int,
    initial_state: InitialState | None = None,
    between_steps: Callable[[int], object] | None = None,
    carried: TensorDictBase | None = None,
    done: int = 0,
) -> Iterator[tuple[TensorDictBase, TensorDictBase]]:
    """`collect`, with what the step after each batch starts from; goes on from there after ``done`` frames."""
    start = _start(env, initial_state)
    carried = env.reset().update(start) if carried is None else carried
    steps: list[Step] = []
    for frames in range(done, num_frames, env.numel()):
        if between_steps is not None:
            between_steps(frames)
        with set_exploration_type(ExplorationType.RANDOM):
            step, carried = _act(env, policy, carried, start)
        steps.append(step)
        if len(steps) == num_steps or frames + env.numel() == num_frames:
            yield in_time_order(steps, env), carried
            steps = []


@torch.no_grad()
def evaluate(
    policy: Policy,
    tasks: Sequence[Task],
    num_episodes: int = 100,
    seed: int = 0,
    greedy: bool = True,
    initial_state: InitialState | None = None,
    device: torch.device | str = "cpu",
    episodes_per_row: int = 1,
    curriculum: Curriculum | None = None,
) -> TensorDict:
    """Play the same number of episodes on every task, all in one batch; every row plays equally many.

    The environment is its own, and torch's global generator is left as it was found.

    Args:
        policy: who plays; a class such as `ctgraph_rl.policies.OptimalPolicy` is built on the environment.
        tasks: what is played.
        num_episodes: episodes per task.
        seed: decides the environment and, if not greedy, the policy's draws.
        greedy: most likely actions; False samples and explores as in training.
        initial_state: gives a recurrent policy's state for a number of rows.
        device: where the environment lives.
        episodes_per_row: episodes that a row plays one after the other; a divisor of ``num_episodes``. More than one is
            needed where the goal changes from episode to episode.
        curriculum: whose task ids the policy sees, if its protocol shows them with observations.

    Returns:
        ``episode_reward`` float32, ``step_count`` int64, ``outcome`` uint8 and ``leaf`` int64, each
        [tasks, num_episodes, 1], as they are at the end of the episodes; those of a row follow each other.

    Raises:
        ValueError: for values out of range, a task with changing goals and one episode a row, and a reference policy
            that was built on another environment.
    """
    Evaluation(num_episodes, greedy, episodes_per_row).check(tasks)
    bound = isinstance(policy, RandomPolicy)
    require((not bound, f"{type(policy).__name__} acts in the environment that it was built on: give the class itself"))
    num_rows = num_episodes // episodes_per_row
    rows = [task for task in tasks for _ in range(num_rows)]
    env = CTGraphEnv(rows, seed, device=device) if curriculum is None else make_env(curriculum, rows, seed, device)
    acts = policy(env) if isinstance(policy, type) else policy
    exploration = ExplorationType.DETERMINISTIC if greedy else ExplorationType.RANDOM
    with torch.random.fork_rng(devices=[env.device] if env.device.type == "cuda" else []):
        torch.manual_seed(seed)
        with set_exploration_type(exploration):
            result = _first_episodes(env, acts, initial_state, episodes_per_row)
    return result.view(len(tasks), num_episodes)


def _first_episodes(
    env: CTGraphEnv, policy: Policy, initial_state: InitialState | None, num_episodes: int
) -> TensorDict:
    """The ends of each row's first episodes, [rows, num_episodes]."""
    start = _start(env, initial_state)
    carried = env.reset().update(start)
    result = carried.select("episode_reward", "step_count", "outcome", "leaf")
    result = result.unsqueeze(-1).expand(env.numel(), num_episodes).clone()
    played = torch.zeros(env.batch_size, dtype=torch.int64, device=env.device)
    while (played < num_episodes).any():
        step, carried = _act(env, policy, carried, start)
        ends = (step["next", "done"].squeeze(-1) & (played < num_episodes)).nonzero().squeeze(-1)
        for key, value in result.items():
            value[ends, played[ends]] = step["next", key][ends]
        played[ends] += 1
    return result


def _start(env: CTGraphEnv, initial_state: InitialState | None) -> TensorDict:
    """The recurrent state that every episode starts with; empty without memory."""
    return TensorDict(batch_size=env.batch_size) if initial_state is None else initial_state(env.numel())


def _act(env: CTGraphEnv, policy: Policy, carried: TensorDictBase, start: TensorDict) -> tuple[Step, TensorDictBase]:
    """One step of every row, and what the next one starts from: a new episode with the state of a start."""
    step, following = take_step(env, policy(carried))
    lasts = TRIAL in start.keys()  # noqa: SIM118, a TensorDict iterates over rows
    for key, value in start.items():
        state = step["next", key]
        begins = following["is_init"].view(-1, *[1] * (value.ndim - 1))
        following.set(key, state if lasts else torch.where(begins, value, state))
    return step, following


def episode_means(ends: TensorDictBase) -> dict[str, Any]:
    """Number of finished episodes, their mean return and length, and the shares at the goal and at any end state.

    NaN for none.

    Args:
        ends: the data of the last step of each episode.
    """
    return {
        "episodes": ends.batch_size[0],
        "return_mean": ends["episode_reward"].double().mean().item(),
        "success_rate": (ends["outcome"] == OUTCOME_GOAL).double().mean().item(),
        "end_rate": (ends["outcome"] != OUTCOME_FAIL).double().mean().item(),
        "length_mean": ends["step_count"].double().mean().item(),
    }


def derive_seed(seed: int, *purpose: str | int) -> int:
    """A seed in [0, 2**63) for a purpose, unrelated to the run's own and to other purposes'."""
    text = "/".join(map(str, (seed, *purpose)))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


class Examiner:
    """Evaluates at the moments and in the way that a curriculum says, and writes what it finds to a log.

    Args:
        curriculum: says when and how.
        seed: of the run; each evaluation derives its own.
        log: where measurements go.
        device: where the environments live.
    """

    def __init__(self, curriculum: Curriculum, seed: int, log: RunLog, device: torch.device | str = "cpu") -> None:
        self.curriculum, self.seed, self.log, self.device = curriculum, seed, log, device

    def examine(self, agent: Agent, frames: int) -> None:
        """Evaluate the agent if an evaluation is due after ``frames`` frames of the run."""
        moment = self.curriculum.moment(frames)
        if moment is not None:
            self.evaluate(self._policy(agent, self.examined(frames)), frames, moment, agent.initial_state)

    def evaluate(self, policy: Policy, frames: int, moment: str, initial_state: InitialState | None = None) -> None:
        """Evaluate a policy after ``frames`` frames and write one line for each task."""
        tasks, curriculum = self.examined(frames), self.curriculum
        if not tasks:
            return
        how = curriculum.evaluation
        result = evaluate(
            policy,
            list(tasks),
            how.num_episodes,
            derive_seed(self.seed, "evaluation", frames),
            how.greedy,
            initial_state,
            self.device,
            how.episodes_per_row,
            curriculum,
        )
        for (number, label), episodes in zip(tasks.values(), result, strict=True):
            where = {"block": curriculum.block_at(frames), "frames": frames, "task": number, "label": label}
            held_out = number > len(curriculum.tasks)
            self.log.append("evaluation", moment=moment, **where, held_out=held_out, **episode_means(episodes))

    def examined(self, frames: int) -> dict[Task, tuple[int, str]]:
        """The tasks that an evaluation after ``frames`` frames is of, with their numbers and labels."""
        curriculum = self.curriculum
        held_out = curriculum.evaluation.held_out
        named = dict(zip((*curriculum.tasks, *held_out), enumerate(curriculum.evaluated_labels, 1), strict=True))
        if curriculum.evaluation.tasks == "all":
            return named
        seen = {task for block in curriculum.blocks[: curriculum.block_at(frames)] for task in block.tasks}
        return {task: name for task, name in named.items() if task in seen or task in held_out}

    def _policy(self, agent: Agent, tasks: Iterable[Task]) -> Policy:
        """The agent's policy; where task ids are told, the one for each task."""
        if self.curriculum.protocol.task_id == "hidden":
            return agent.policy
        ids = self.curriculum.task_ids
        policies = [agent.policy_for(ids[task]) if task in ids else agent.policy for task in tasks]
        return agent.policy if all(policy is agent.policy for policy in policies) else by_slices(policies)


def by_slices(policies: Sequence[Policy]) -> Policy:
    """A policy that gives each of as many equal slices of the rows to one of the policies."""

    def act(data: TensorDictBase) -> TensorDictBase:
        slices = data.chunk(len(policies))
        return torch.cat([policy(part) for policy, part in zip(policies, slices, strict=True)])

    return act


def _learn(agent: Agent, batch: TensorDictBase, block: int, frames: int) -> dict[str, float]:
    """Let the agent learn; what is not finite stops the run."""
    where = f"in block {block} after {frames} frames; the run stops here"
    try:
        measurements = agent.learn(batch)
    except FloatingPointError as error:
        raise FloatingPointError(f"{error} {where}") from None
    for name, value in measurements.items():
        if not math.isfinite(value):
            raise FloatingPointError(f"{name} is {value} {where}")
    return measurements
