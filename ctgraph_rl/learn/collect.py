"""Collection of batches: a policy acts in a curriculum's environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ctgraph_rl.batch.specs import Specs, make_specs
from ctgraph_rl.checks import Rule, at_least_one, is_int, require, takes_numbers
from ctgraph_rl.core.device import captures
from ctgraph_rl.core.dynamics import RowState, beside
from ctgraph_rl.core.region import Region
from ctgraph_rl.core.row_params import RowParams
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.kinds.task_like import ENVIRONMENTS, TaskLike, close_env
from ctgraph_rl.tasks.task import are_graphs

Policy = Callable[[TensorDictBase], TensorDictBase]
"""Reads a TensorDict of all environments, [num_envs], and writes ``action`` into it."""

InitialState = Callable[[int], TensorDict]
"""Return the initial recurrent state of a number of environments."""

SHOWN = ("observation", "is_init", "step_count", "episode_reward")

TRIAL = "trial"
"""A recurrent state with this key lasts over episodes: the policy resets it itself, where a trial begins."""

PREVIOUS_ACTION = "previous_action"

ENDS = "ends"
"""Key under ``next`` of what hidden episodes hide of their ends; no learner gets it."""

UNSTORED = "unstored_"
"""Prefix of recurrent states that a batch does not store for each step: every step shows the value before the first
one, and, under ``next``, the value after the last one.
"""

Step = dict[Any, Tensor]


@takes_numbers
def make_env(
    curriculum: Curriculum, tasks: Sequence[TaskLike], seed: int, device: torch.device | str = "cpu"
) -> EnvBase:
    """Return an environment with one task per row, which shows task ids if the protocol gives them.

    Held-out tasks show zeros as their id.

    Raises:
        ValueError: for an environment of a user that lacks what `TaskLike.make_env` asks for.
    """
    pool, length = _pool_and_ids(curriculum)
    task_ids = curriculum.task_ids if length else None
    kind = type(curriculum.examples[0])
    how = curriculum.protocol
    hides = {"episodes": how.episodes} if how.hides_episodes else {}
    known = f"protocol.episodes=hidden needs CT-graphs or environments of Gymnasium, not {kind.__name__}"
    require((not hides or issubclass(kind, tuple(ENVIRONMENTS)), f"{known}: set it to shown"))
    env = kind.make_env(
        tasks, seed, task_pool=pool, device=device, task_ids=task_ids, num_task_ids=length or None, **hides
    )
    if not isinstance(env, CTGraphEnv) and not hides:
        try:
            require(*_env_rules(env, kind.__name__, len(tasks), length))
        except ValueError:
            close_env(env)
            raise
    return env


def _env_rules(env: Any, kind: str, num_rows: int, num_task_ids: int) -> Iterator[Rule]:
    made = f"{kind}.make_env must return a TorchRL EnvBase of batch_size [{num_rows}]"
    is_env = isinstance(env, EnvBase)
    yield is_env and tuple(env.batch_size) == (num_rows,), f"{made}, got {env!r:.80}"
    if is_env:
        missing = [key for key in SHOWN if key not in env.observation_spec.keys()]  # noqa: SIM118, no dict
        write = "write them, or add TorchRL's InitTracker, StepCounter and RewardSum"
        yield not missing, f"the environment of {kind} must show {', '.join(missing)}: {write}"
        yield hasattr(env, "set_tasks"), f"the environment of {kind} must have set_tasks(tasks, at_episode_end)"
        ids = not num_task_ids or "task_id" in env.observation_spec.keys()  # noqa: SIM118, no dict
        yield ids, f"the environment of {kind} must show task_id, as the protocol does: take its make_env's task_ids"


def agent_specs(curriculum: Curriculum) -> Specs:
    """Return the unbatched specs of `make_env`, from which agents are built.

    Raises:
        ValueError: if the tasks cannot be rows of one environment.
    """
    pool, length = _pool_and_ids(curriculum)
    examples = (*curriculum.examples, *curriculum.evaluation.held_out)
    if are_graphs(examples):
        return make_specs(examples, num_task_ids=length, info=not curriculum.protocol.hides_episodes)
    env = make_env(curriculum, pool[:1], 0)
    try:
        return Specs(env.observation_spec_unbatched, env.action_spec_unbatched)
    finally:
        close_env(env)


def _pool_and_ids(curriculum: Curriculum) -> tuple[Sequence[TaskLike], int]:
    how = curriculum.protocol
    held_out = curriculum.evaluation.held_out
    pool = (*curriculum.tasks, *held_out) if held_out else curriculum.tasks
    return pool, how.length(len(curriculum.tasks)) if how.task_id == "one_hot" else 0


@takes_numbers
def collect(
    env: EnvBase,
    policy: Policy,
    num_frames: int,
    num_steps: int,
    initial_state: InitialState | None = None,
    between_steps: Callable[[int], object] | None = None,
) -> Iterator[TensorDictBase]:
    """Yield batches of [rows, num_steps] in time order, starting with a reset; the last one may be shorter.

    Args:
        policy: writes ``action`` and, if recurrent, its state under ``("next", key)``.
        num_frames: a multiple of the rows.
        initial_state: gives the rows' first recurrent state.
        between_steps: called before every step with the frames so far; after a batch, once it was used.

    Raises:
        ValueError: for frames that are not a multiple of the rows, or less than one step.
    """
    whole = is_int(num_frames, 1) and num_frames % env.numel() == 0
    require(
        (whole, f"num_frames must be a multiple of the {env.numel()} rows, got {num_frames!r}"),
        *at_least_one(num_steps=num_steps),
    )
    collected = batches(env, policy, num_frames, num_steps, initial_state, between_steps=between_steps)
    return (batch for batch, _ in collected)


@torch.no_grad()
def batches(
    env: EnvBase,
    policy: Policy,
    num_frames: int,
    num_steps: int,
    initial_state: InitialState | None = None,
    *,
    between_steps: Callable[[int], object] | None = None,
    carried: TensorDictBase | None = None,
    done: int = 0,
) -> Iterator[tuple[TensorDictBase, TensorDictBase]]:
    """Yield the batches of `collect` and the data ``carried`` into the next step; ``done`` frames resume from it."""
    start = make_start(env, initial_state)
    data = dict((env.reset().update(start) if carried is None else carried).items(True, True))
    is_known = type(env) is CTGraphEnv and not env.hides_episodes
    is_captured = is_known and getattr(policy, "capturable", False) and captures(env.device)
    act_once = CapturedAct(env, policy, start) if is_captured else partial(act, env, policy, start=start)
    unstored = [key for key in start if key.startswith(UNSTORED)]
    num_rows = env.numel()
    for first in range(done, num_frames, num_rows * num_steps):
        steps: list[Step] = []
        with set_exploration_type(ExplorationType.RANDOM):
            for frames in range(first, min(first + num_rows * num_steps, num_frames), num_rows):
                if between_steps is not None:
                    between_steps(frames)
                step, data = act_once(data)
                _append(steps, step, unstored)
        yield stack_steps(steps, env), TensorDict(data, env.batch_size, device=env.device)


def make_start(env: EnvBase, initial_state: InitialState | None) -> Step:
    """Return the recurrent state that every episode starts with; empty without memory."""
    return {} if initial_state is None else dict(initial_state(env.numel()).items())


def act(env: EnvBase, policy: Policy, data: Step, start: Step) -> tuple[Step, Step]:
    """Step every row; return the step and the data of the next one, reset where an episode ended.

    A policy whose class defines ``act_on_tensors`` gets a plain dict instead of a TensorDict, which is faster. Derived
    classes, modules around it and hooks are called.
    """
    step, following = take_step(env, acted(policy, data, env.device))
    for key, value in start.items():
        state = step["next", key]
        begins = beside(following["is_init"], value)
        following[key] = state if TRIAL in start else torch.where(begins, value, state)
    return step, following


def acted(policy: Policy, data: Step, device: torch.device | None) -> Step:
    """Return the data of some rows with what a policy writes, as `act`."""
    hooked = isinstance(policy, nn.Module) and (
        policy._forward_hooks or policy._forward_pre_hooks or policy._compiled_call_impl
    )
    if "act_on_tensors" in vars(type(policy)) and not hooked:
        return data | policy.act_on_tensors(data)  # type: ignore[attr-defined]
    return dict(policy(TensorDict(data, [len(data["observation"])], device=device)).items(True, True))


class CapturedAct:
    """`act` as a `Region`: on a GPU one CUDA graph, captured again when rows change tasks.

    Nothing is captured while rows may change tasks at any episode's end, which needs the host.

    Args:
        env: where to act; actions are not checked.
        policy: writes ``action``, without a branch on data.
        start: the recurrent state at the start of an episode.
    """

    def __init__(self, env: CTGraphEnv, policy: Policy, start: Step) -> None:
        self.env = env
        self.policy = policy
        self.start = start
        self._read = {*env.observation_spec.keys(), *env.done_keys, *start.keys()}
        self._region: Region | None = None
        self._params: RowParams | None = None

    def __call__(self, data: Step) -> tuple[Step, Step]:
        """Step every row, as `act`."""
        rows = self.env.rows
        if rows.tasks_change:
            return act(self.env, self.policy, data, self.start)
        if self._region is None or self._params is not rows.params:
            self._region = Region(self._act)
            self._params = rows.params
        given = {key: value for key, value in data.items() if key in self._read}
        found = self._region(_labelled("carried", given) | _labelled("rows", rows.state._asdict()))
        rows.state = RowState(**_part("rows", found))
        step = {key: value.clone() for key, value in _part("step", found).items()}
        return step, _part("following", found)

    def _act(self, given: Step) -> Step:
        env = self.env
        rows = self.env.rows
        checks = env.check_actions
        env.check_actions = False
        rows.state = RowState(**_part("rows", given))
        try:
            step, following = act(env, self.policy, _part("carried", given), self.start)
        finally:
            env.check_actions = checks
        after = _labelled("following", following) | _labelled("rows", rows.state._asdict())
        return _labelled("step", step) | after


def _labelled(label: str, values: Step) -> Step:
    return {(label, key): value for key, value in values.items()}


def _part(label: str, values: Step) -> Step:
    return {key[1]: value for key, value in values.items() if key[0] == label}


def take_step(env: EnvBase, data: Step) -> tuple[Step, Step]:
    """Step all rows; rows that are finished start an episode at once.

    Equals ``env.step_and_maybe_reset`` in half the time.

    Returns:
        The step, and the data of the next one.
    """
    if type(env) is not CTGraphEnv:
        taken, following = env.step_and_maybe_reset(TensorDict(data, env.batch_size, device=env.device))
        return with_ends(dict(taken.items(True, True)), env), dict(following.items(True, True))
    step = dict(data)
    after, restarted = env.step_and_restart_data(step.get("action"))
    step |= {("next", key): value for key, value in after.items()}
    kept = {key: value for key, value in step.items() if key[0] != "next" and key != "reward"}
    return with_ends(step, env), kept | restarted


def with_ends(step: Step, env: EnvBase) -> Step:
    """Return a step with what hidden episodes hide of it."""
    ends = getattr(env, "ends", {})
    return step | {("next", ENDS, key): value for key, value in ends.items()} if ends else step


def without_ends(batch: TensorDictBase) -> TensorDictBase:
    """Return what a learner gets of a batch."""
    return batch.exclude(("next", ENDS)) if ENDS in batch["next"].keys() else batch  # noqa: SIM118, no dict


def _append(steps: list[Step], step: Step, unstored: Sequence[str]) -> None:
    for key in unstored if steps else ():
        del steps[-1]["next", key], step[key]
    steps.append(step)


def stack_steps(steps: Sequence[Step], env: EnvBase) -> TensorDict:
    """Steps as one TensorDict, [rows, steps]."""
    batch = TensorDict(batch_size=[*env.batch_size, len(steps)], device=env.device)
    for key in {**steps[0], **steps[-1]}:
        parts = [step[key] for step in steps if key in step]
        constant = all(part is parts[0] for part in parts)  # long task ids, without a copy for each step
        values = parts[0].unsqueeze(1) if constant else torch.stack(parts, dim=1)
        batch.set(key, values.expand(-1, len(steps), *[-1] * (values.ndim - 2)))
    return batch
