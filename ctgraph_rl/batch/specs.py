"""The TorchRL specs of an environment for a pool of tasks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded

from ctgraph_rl.batch.params import observation_shape
from ctgraph_rl.core.dynamics import OUTCOME_GOAL, OUTCOME_RUNNING
from ctgraph_rl.tasks.images import white_level
from ctgraph_rl.tasks.task import Task


class Specs(NamedTuple):
    """The specs of what a policy reads and writes."""

    observation: Composite
    action: Categorical


def specs_of(pool: Sequence[Task], batch_size: tuple[int, ...] = (), num_task_ids: int = 0, info: bool = True) -> Specs:
    """Return the specs of an environment for a pool of tasks, on the CPU, without building one.

    Args:
        pool: the tasks that rows may have.
        batch_size: () for the unbatched specs, which agents are built from; (N,) for those of N rows.
        num_task_ids: length of ``task_id``; 0 for none.
        info: whether ``step_count``, ``episode_reward``, ``outcome`` and ``leaf`` are there.

    Raises:
        ValueError: for observations of different shapes, and for more than the machine can hold.
    """
    shape = observation_shape(pool, math.prod(batch_size))
    column = (*batch_size, 1)
    white = 255 if len(shape) == 3 else max(int(white_level(task.images)) for task in pool)
    keys: dict[str, Bounded | Binary | Unbounded] = {
        "observation": Bounded(0, white, shape=(*batch_size, *shape), dtype=torch.uint8, device="cpu"),
        "is_init": Binary(1, shape=column, dtype=torch.bool, device="cpu"),
    }
    if info:
        keys["step_count"] = Unbounded(shape=column, dtype=torch.int64, device="cpu")
        keys["episode_reward"] = Unbounded(shape=column, dtype=torch.float32, device="cpu")
        keys["outcome"] = Bounded(OUTCOME_RUNNING, OUTCOME_GOAL, shape=column, dtype=torch.uint8, device="cpu")
        keys["leaf"] = Unbounded(shape=column, dtype=torch.int64, device="cpu")
    if num_task_ids:
        keys["task_id"] = Bounded(0, 1, shape=(*batch_size, num_task_ids), dtype=torch.uint8, device="cpu")
    num_actions = 1 + max(task.graph.branching_factor for task in pool)
    action = Categorical(num_actions, shape=batch_size, dtype=torch.int64, device="cpu")
    return Specs(Composite(keys, shape=batch_size, device="cpu"), action)
