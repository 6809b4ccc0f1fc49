"""The rows of a batch as text: the place of each, and its observation in grey blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ctgraph_rl.core.dynamics import RowState
from ctgraph_rl.core.goal import write_goal
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.tasks.task import Task

GREYS = " ░▒▓█"


def as_text(tasks: Sequence[Task], state: RowState, observation: Tensor, white: int) -> tuple[str, ...]:
    """Return a text for every row.

    Args:
        observation: uint8 [N, 1, r, r], or [N, K] when one-hot.
        white: the largest value of an observation.
    """
    fields = (state.state_type, state.node, state.goal_leaf, state.step_count)
    values = zip(*(field.tolist() for field in fields), strict=True)
    rows = zip(tasks, values, observation.numpy(), strict=True)
    return tuple(f"{_place(task, *value)}\n{_blocks(image, white)}" for task, value, image in rows)


def _place(task: Task, kind: int, node: int, goal_leaf: int, step_count: int) -> str:
    graph = task.graph
    goal = write_goal(graph.path(graph.num_decision_states + goal_leaf))
    way = f" after {write_goal(graph.path(node))}" if node else ""
    text = f"{StateType(kind).name.lower()} state{way}, step {step_count}, goal {goal}"
    if task.swapped_branches is None:
        return text
    path, (first, second) = task.swapped_branches
    at = f"after {write_goal(path)}" if path else "at the first decision"
    return f"{text}, {first} and {second} swapped {at}"


def _blocks(observation: NDArray[np.uint8], white: int) -> str:
    pixels = observation.reshape(-1, observation.shape[-1]).astype(int)
    lines = []
    for levels in (pixels * 4 // white).clip(0, 4):
        lines.append("".join(GREYS[level] * 2 for level in levels))
    return "\n".join(lines)
