"""One step of all rows as the collecting loop takes it: TorchRL's data in plain tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ctgraph_rl.core.dynamics import NO_LEAF
from ctgraph_rl.env import CTGraphEnv

Step = dict[Any, Tensor]
"""What was seen, done and written in a step of all rows, and under keys ``("next", key)`` what came after it."""


def take_step(env: EnvBase, data: TensorDictBase) -> tuple[Step, TensorDictBase]:
    """Step all rows with the actions in their data; rows that are finished start an episode at once.

    The same as ``env.step_and_maybe_reset(data)``, which makes several TensorDicts a step and takes twice as long.

    Returns:
        The step, and the data that the next one starts from.
    """
    if type(env) is not CTGraphEnv:
        taken, following = env.step_and_maybe_reset(data)
        return dict(taken.items(True, True)), following
    step = dict(data.items(True, True))
    if env.check_actions:
        env.rows.check_actions(step.get("action"))
    after = _after(env, step["action"], step.get("task_id"))
    step.update({("next", key): value for key, value in after.items()})
    return step, _following(env, step, after["done"])


def _after(env: CTGraphEnv, action: Tensor, task_id: Tensor | None) -> dict[str, Tensor]:
    """What comes after the actions; every value is a column."""
    rows = env.rows
    shown = rows.step(action)
    done = shown.done.unsqueeze(-1)
    none = torch.zeros_like(done)
    after = {
        "observation": shown.observation,
        "is_init": none,
        "step_count": rows.step_count.unsqueeze(-1),
        "episode_reward": rows.episode_reward.unsqueeze(-1),
        "outcome": shown.outcome.unsqueeze(-1),
        "leaf": shown.leaf.unsqueeze(-1),
        "done": done,
        "terminated": done,
        "truncated": none,
        "reward": rows.reward.unsqueeze(-1),
    }
    return after if task_id is None else {**after, "task_id": task_id}  # which changes with the next episode


def _following(env: CTGraphEnv, step: Step, done: Tensor) -> TensorDictBase:
    """What the next step starts from: finished rows start an episode; what else a policy wrote is kept."""
    data = {key: value for key, value in step.items() if key[0] != "next" and key != "reward"}
    data["observation"] = env.rows.restart(done.squeeze(-1))
    none = torch.zeros_like(done)
    data |= {
        "is_init": done,
        "step_count": env.rows.step_count.unsqueeze(-1),
        "episode_reward": env.rows.episode_reward.unsqueeze(-1),
        "outcome": none.to(torch.uint8),
        "leaf": torch.full_like(step["next", "leaf"], NO_LEAF),
        "done": none,
        "terminated": none,
        "truncated": none,
    }
    return env._with_task_id(TensorDict(data, env.batch_size, device=env.device))


def in_time_order(steps: Sequence[Step], env: EnvBase) -> TensorDict:
    """Steps as one TensorDict, [rows, steps]."""
    batch = TensorDict(batch_size=[*env.batch_size, len(steps)], device=env.device)
    for key in steps[0]:
        batch.set(key, torch.stack([step[key] for step in steps], dim=1))
    return batch
