"""The TorchRL specs of environments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torchrl.data import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded

from ctgraph_rl.batch.params import observation_shape
from ctgraph_rl.core.dynamics import OUTCOME_GOAL, OUTCOME_RUNNING
from ctgraph_rl.tasks.images import white_level
from ctgraph_rl.tasks.task import Task

TASK_NUMBER = "task_number"
"""The key of task ids as one integer a row, int64 [N, 1]: where ``task_id`` has its 1, and -1 where it is zero."""


class Specs(NamedTuple):
    """What a policy reads and writes."""

    observation: Composite
    action: Categorical


def make_specs(
    pool: Sequence[Task], batch_size: tuple[int, ...] = (), num_task_ids: int = 0, info: bool = True
) -> Specs:
    """Return the specs of an environment for a pool of tasks, on the CPU, without building one.

    Args:
        batch_size: () for unbatched specs, from which agents are built; (N,) for N rows.
        num_task_ids: length of ``task_id``; 0 for none.
        info: with ``step_count``, ``episode_reward``, ``outcome`` and ``leaf``.

    Raises:
        ValueError: for observations of different shapes, and more than the machine can hold.
    """
    shape = observation_shape(pool, math.prod(batch_size))
    white = 255 if len(shape) == 3 else max(int(white_level(task.images)) for task in pool)
    image = Bounded(0, white, shape=(*batch_size, *shape), dtype=torch.uint8, device="cpu")
    observation = observation_spec(image, batch_size, num_task_ids, info=info, ends=info)
    num_actions = 1 + max(task.graph.branching_factor for task in pool)
    action = Categorical(num_actions, shape=batch_size, dtype=torch.int64, device="cpu")
    return Specs(observation, action)


def observation_spec(
    observation: TensorSpec, batch_size: tuple[int, ...], num_task_ids: int, info: bool = True, ends: bool = False
) -> Composite:
    """Return the spec of what rows show, on the CPU.

    Args:
        num_task_ids: length of ``task_id``; 0 for none.
        info: with ``step_count`` and ``episode_reward``.
        ends: with ``outcome`` and ``leaf``.
    """
    column = (*batch_size, 1)
    number = Unbounded(shape=column, dtype=torch.int64, device="cpu")
    keys = {"observation": observation, "is_init": _flag(batch_size)}
    if info:
        keys["step_count"] = number
        keys["episode_reward"] = reward_spec(batch_size)
    if ends:
        keys["outcome"] = Bounded(OUTCOME_RUNNING, OUTCOME_GOAL, shape=column, dtype=torch.uint8, device="cpu")
        keys["leaf"] = number.clone()
    if num_task_ids:
        keys["task_id"] = Binary(num_task_ids, shape=(*batch_size, num_task_ids), dtype=torch.uint8, device="cpu")
        keys[TASK_NUMBER] = Bounded(-1, num_task_ids - 1, shape=column, dtype=torch.int64, device="cpu")
    return Composite(keys, shape=batch_size, device="cpu")


def reward_spec(batch_size: tuple[int, ...]) -> Unbounded:
    """Return the spec of rewards, on the CPU."""
    return Unbounded(shape=(*batch_size, 1), dtype=torch.float32, device="cpu")


def done_spec(batch_size: tuple[int, ...], truncated: bool = True) -> Composite:
    """Return the spec of episodes' ends, with or without ``truncated``, on the CPU."""
    keys = ["done", "terminated", "truncated"] if truncated else ["done", "terminated"]
    return Composite({key: _flag(batch_size) for key in keys}, shape=batch_size, device="cpu")


def _flag(batch_size: tuple[int, ...]) -> Binary:
    return Binary(1, shape=(*batch_size, 1), dtype=torch.bool, device="cpu")
