"""The fast path: steps of many rows into buffers, without TensorDict or Gymnasium."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.batch.native import kernel_rule, require_kernel
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.checks import at_least_one, require
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.dynamics import RowState
from ctgraph_rl.core.tree import is_done

TensorPolicy = Callable[[Tensor, Tensor], Tensor]
"""A policy: (observation uint8 [N, *shape], is_init bool [N]) -> action int64 [N]."""


class Steps(NamedTuple):
    """T steps of N rows; finished rows are reset at once, without the last observation of the episode."""

    observation: Tensor  # uint8 [T + 1, N, *shape]; number t is seen before action t, number T comes after the last one
    is_init: Tensor  # bool [T + 1, N]: the observation is the first of an episode
    action: Tensor  # int64 [T, N]
    reward: Tensor  # float32 [T, N]
    done: Tensor  # bool [T, N]: the step ended an episode
    outcome: Tensor  # uint8 [T, N]: 0 running, 1 fail, 2 another end state, 3 the goal

    @classmethod
    def empty(cls, rows: Rows, num_steps: int, device: torch.device | str | None = None) -> Steps:
        """Buffers for ``num_steps`` steps, to fill repeatedly; by default on the rows' device."""
        require(*at_least_one(num_steps=num_steps))
        t = num_steps
        n = rows.num_rows
        device = rows.device if device is None else device
        return cls(
            observation=torch.empty(t + 1, n, *rows.image_shape, dtype=torch.uint8, device=device),
            is_init=torch.empty(t + 1, n, dtype=torch.bool, device=device),
            action=torch.empty(t, n, dtype=torch.int64, device=device),
            reward=torch.empty(t, n, device=device, dtype=torch.float32),
            done=torch.empty(t, n, dtype=torch.bool, device=device),
            outcome=torch.empty(t, n, dtype=torch.uint8, device=device),
        )


@torch.no_grad()
def rollout(rows: Rows, policy: TensorPolicy | Tensor, steps: Steps, kernel: str = "auto") -> Steps:
    """Fill buffers with steps; rows that have not begun or are finished start an episode first.

    The bits are those of `CTGraphEnv` and the Gymnasium environments with the same seeds and actions.

    Args:
        rows: the batch, left where the last step led.
        policy: what acts, or actions, int64 [T, N].
        kernel: ``"auto"`` takes the rows' engine, ``"off"`` the tensor engine and ``"required"`` the C kernel, as in
            `Rows`. Given actions are one call of the kernel.

    Returns:
        ``steps``.

    Raises:
        ValueError: for buffers of another shape, invalid actions, and what a required kernel cannot run; the rows stay
            unchanged.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> rows = Rows([ct_su_b1()] * 64, seed=0)
        >>> steps = rollout(rows, torch.zeros(16, 64, dtype=torch.int64), Steps.empty(rows, 16))  # wait, 16 times
        >>> steps.observation.shape, steps.reward.shape
        (torch.Size([17, 64, 1, 12, 12]), torch.Size([16, 64]))
    """
    t = len(steps.action)
    wanted = Steps.empty(rows, t, "meta")
    for name, buffer, like in zip(Steps._fields, steps, wanted, strict=True):
        fits = buffer.shape == like.shape and buffer.dtype == like.dtype and buffer.device == rows.device
        got = f"{buffer.dtype} {list(buffer.shape)} on {buffer.device}"
        require((fits, f"buffers must be those of Steps.empty(rows, {t}), got {name} {got}"))
    require(
        (not rows.tasks_change, "rollout needs rows that keep their tasks; step rows with `Rows.act` and `restart`")
    )
    is_policy = isinstance(policy, Tensor) or callable(policy)
    require((is_policy, f"policy must be a function or a tensor of actions, got {type(policy).__name__}"))
    if isinstance(policy, Tensor):
        _check_actions(rows, policy, steps.action.shape)
    require(kernel_rule(kernel))
    if kernel == "required":
        require_kernel(rows.uses.reward_fns, rows.device)
    is_native = kernel == "required" or (kernel == "auto" and rows.uses_kernel)
    rows.state = _native(rows, policy, steps) if is_native else _tensors(rows, policy, steps)
    return steps


def _native(rows: Rows, policy: TensorPolicy | Tensor, steps: Steps) -> RowState:
    start = rows.state
    state = rows.native.run(start, mask=rows.is_done, observation=steps.observation[0])
    torch.eq(state.step_count, 0, out=steps.is_init[0])
    if isinstance(policy, Tensor):
        steps.action.copy_(policy)
        return _fill(rows, state, steps, slice(None))
    for t in range(len(steps.action)):
        steps.action[t] = _choose_actions(rows, policy, steps, t, start)
        state = _fill(rows, state, steps, slice(t, t + 1))
    return state


def _fill(rows: Rows, state: RowState, steps: Steps, part: slice) -> RowState:
    outputs = {name: getattr(steps, name)[part] for name in ("action", "reward", "done", "outcome")}
    seen = steps.observation[1:][part]
    is_init = steps.is_init[1:][part]
    state = rows.native.run(state, num_steps=len(is_init), restarts=True, observation=seen, **outputs)
    is_init.copy_(outputs["done"])
    return state


def _tensors(rows: Rows, policy: TensorPolicy | Tensor, steps: Steps) -> RowState:
    params = rows.params
    uses = rows.uses
    start = rows.state
    state = dynamics.begin(start, rows.is_done, params, uses)
    words = dynamics.words_of(state.tick, params, uses)
    steps.observation[0] = dynamics.observe(state, words, params, uses)
    torch.eq(state.step_count, 0, out=steps.is_init[0])
    plain = not (uses.pixel_noise or uses.reward_cue or params.x.taps)
    for t in range(len(steps.action)):
        action = policy[t] if isinstance(policy, Tensor) else _choose_actions(rows, policy, steps, t, start)
        state = dynamics.advance(state, action, words, params, uses, absorbing=False)
        done = is_done(state, params.tree)
        steps.action[t] = action
        steps.reward[t] = state.reward
        steps.done[t] = done
        steps.is_init[t + 1] = done
        steps.outcome[t] = dynamics.arrivals(state, done, params)[0]
        state = dynamics.begin(state, done, params, uses)
        words = dynamics.words_of(state.tick, params, uses)
        seen = dynamics.look(state, words, params, uses)
        if plain:
            torch.index_select(params.bank, 0, seen.rows, out=steps.observation[t + 1])
        else:
            steps.observation[t + 1] = dynamics.read(seen, state, params, uses)
    return state


def _choose_actions(rows: Rows, policy: TensorPolicy, steps: Steps, t: int, start: RowState) -> Tensor:
    params = rows.params
    action = policy(steps.observation[t], steps.is_init[t])
    same = rows.params is params and all(map(operator.is_, rows.state, start))
    require((same, "a policy must not change the rows during a rollout: change them between two rollouts"))
    _check_actions(rows, action, steps.action.shape[1:])
    return action


def _check_actions(rows: Rows, action: Tensor, shape: torch.Size) -> None:
    """Refuse invalid actions; the range is checked on the CPU only, as elsewhere the host would wait."""
    spec = f"actions must be int64 of shape {list(shape)} with values in 0..{rows.max_branching}"
    require((isinstance(action, Tensor), f"{spec}, got {type(action).__name__}"))
    got = f"{action.dtype} {list(action.shape)}"
    require((action.dtype == torch.int64 and action.shape == shape, f"{spec}, got {got}"))
    if action.device.type == "cpu":
        low, high = (int(value) for value in action.aminmax())
        require((low >= 0 and high <= rows.max_branching, f"{spec}, got {low}..{high}"))
