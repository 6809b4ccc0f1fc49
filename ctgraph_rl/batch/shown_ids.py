"""Ids of tasks beside the observations of Gymnasium's environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ctgraph_rl.batch.assignment import require_num_ids
from ctgraph_rl.checks import require
from ctgraph_rl.tasks.task import Task


def add_task_ids(
    space: spaces.Space[Any], pool: Sequence[Task], task_ids: Mapping[Task, int] | None, num_task_ids: int | None
) -> tuple[spaces.Space[Any], NDArray[np.uint8] | None]:
    """Return the space of observations with ids of tasks, and the id of each task of a pool as one-hot.

    Args:
        space: of observations without ids.
        pool: the tasks.
        task_ids: their ids; None: the space stays unchanged, and there are none.
        num_task_ids: length of an id; None: just enough.

    Raises:
        ValueError: for a task without an id, and ids that do not fit the length.
    """
    length = require_num_ids(task_ids, num_task_ids)
    if task_ids is None:
        return space, None
    without = [each for each in pool if each not in task_ids]
    require((not without, f"task_ids must name every task of the pool, got none for {without[:3]}"))
    ids = np.eye(length, dtype=np.uint8)[[int(task_ids[each]) for each in pool]]
    return spaces.Dict({"observation": space, "task_id": spaces.Box(0, 1, (length,), np.uint8)}), ids


def with_id(observation: NDArray[np.uint8], ids: NDArray[np.uint8] | None, task: Any) -> Any:
    """Return an observation, or those of a batch, with the ids of the numbered tasks, if there are ids."""
    return observation if ids is None else {"observation": observation, "task_id": ids[task].copy()}
