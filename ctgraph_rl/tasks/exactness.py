"""Which tasks have exact measures of a policy, see `ctgraph_rl.learn.exact`, and how many histories they have."""

from __future__ import annotations

import math
from collections.abc import Iterator

from ctgraph_rl.checks import Rule
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.tasks.kinds.task_like import TaskLike
from ctgraph_rl.tasks.task import Task

INSTEAD = "set evaluation.exact=false, which plays episodes"

LEAST_STAY = 1e-12
"""Probability below which a stay at a wait state is left out."""

MOST_HISTORIES = 2**22
"""Most histories that are played: 10 s of an LSTM on one core."""


def task_rules(task: TaskLike) -> Iterator[Rule]:
    """Yield what exact measures require of a task, whatever acts."""
    kind = type(task).__name__
    yield isinstance(task, Task), f"exact evaluation needs CT-graphs, got {kind}: {INSTEAD}"
    if isinstance(task, Task):
        noise = task.observations.read_noise
        yield noise == 0, f"exact evaluation needs images without noise, got read_noise={noise}: {INSTEAD}"
        change = task.goal_change
        yield change is None, f"exact evaluation needs a goal that stays, got goal_change={change}: {INSTEAD}"


def count_histories(task: Task, reads_actions: bool) -> float:
    """Return how many histories of an episode without failure an agent with memory can have, without long stays.

    Infinite above the largest float.
    """
    graph = task.graph
    x = task.observations
    stays = longest_stay(graph.wait_prob)
    of_waits = 1 if x.is_unique(StateType.WAIT) else x.wait_ids[1] - x.wait_ids[0] + 1
    of_decisions = 1 if x.is_unique(StateType.DECISION) else x.decision_ids[1] - x.decision_ids[0] + 1
    views = num_views(task)
    first = (x.home_ids[1] - x.home_ids[0] + 1) * views * (graph.branching_factor + 1 if reads_actions else 1)
    try:
        images = of_waits * views
        waits = stays if images == 1 else (math.pow(images, stays + 1) - images) / (images - 1)
        level = waits * of_decisions * views * graph.branching_factor
        return first * math.pow(level, graph.depth) * waits
    except OverflowError:
        return math.inf


def longest_stay(wait_prob: float) -> int:
    """Return the most steps at a wait state that are played."""
    return 1 if wait_prob == 0 else 1 + math.ceil(math.log(LEAST_STAY) / math.log(wait_prob))


def num_views(task: Task) -> int:
    """Return how many different images show an observation."""
    return task.images.num_variants * (task.observations.read_rotation + 1)
