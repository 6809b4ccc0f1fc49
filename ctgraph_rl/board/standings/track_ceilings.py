"""Computed means of what the tasks of a curriculum allow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from ctgraph_rl.log.scores import optimal_values
from ctgraph_rl.metrics import Undefined
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Protocol
from ctgraph_rl.tasks.task import Task, are_graphs
from ctgraph_rl.tasks.values import is_needle, memoryless_ceiling, open_loop_ceiling, random_frames_to_goal


def ceilings_of(curriculum: Curriculum) -> dict[str, float | None]:
    """Return undiscounted means over the tasks of a curriculum by their names; None where there is no closed form."""
    tasks = curriculum.tasks
    if not are_graphs(tasks):
        best = optimal_values(tasks)
        return {"optimum": None if isinstance(best, Undefined) else best.mean().item()}
    changes = any(task.goal_change is not None for task in tasks)
    plain = all(map(_is_plain, tasks))
    episodes = curriculum.evaluation.episodes_per_row
    plays_all = {task.graph.num_end_states for task in tasks} == {episodes}
    searches = plain and plays_all and all(task.goal_change == (episodes, episodes) for task in tasks)
    return {
        "optimum": _mean(tasks, lambda task: task.optimal_value(1.0)),
        "one policy for all tasks that look the same, at most": _one_policy(tasks, curriculum.protocol),
        "best search for a goal that is not known": (episodes + 1) / (2 * episodes) if searches else None,
        "best policy without memory": None if changes else _mean(tasks, memoryless_ceiling),
        "best sequence of actions without observations": None if changes else _mean(tasks, open_loop_ceiling),
        "random policy": _mean(tasks, lambda task: task.graph.reward_prob_random * task.goal_reward) if plain else None,
        "frames to the first reward of a random policy, on the hardest task": max(map(random_frames_to_goal, tasks)),
    }


def write_ceiling(value: float) -> str:
    """Return a ceiling in four digits, a number of frames in whole ones."""
    if value < 100:
        return f"{value:.4g}"
    return f"{value:,.0f}" if value < 1e7 else f"{value:.1e}"


def _mean(tasks: Sequence[Task], value: Callable[[Task], float]) -> float | None:
    try:
        return sum(map(value, tasks)) / len(tasks)
    except ValueError:
        return None


def _is_plain(task: Task) -> bool:
    return is_needle(task) and task.goal_reward > 0 and task.fail_reward == task.step_reward == 0


def _one_policy(tasks: Sequence[Task], protocol: Protocol) -> float | None:
    """Return the most that one policy without ids gets; None where ids are given or tasks do not pay alike.

    Nothing distinguishes tasks with the same images and rules of what is shown. A policy that reaches the goal of the
    deepest one surely reaches those that are beginnings of it, and no mixture gets more.
    """
    alike = len({task.goal_reward for task in tasks}) == 1 and all(map(_is_plain, tasks))
    if len(tasks) < 2 or protocol.task_id != "hidden" or not alike or tasks[0].goal_change is not None:
        return None
    groups: dict[object, list[tuple[int, ...]]] = {}
    for task in tasks:
        shown = (task.images, task.observations, task.graph.branching_factor, task.graph.wait_prob)
        groups.setdefault(shown, []).append(task.goal_decisions)
    reached = 0
    for goals in groups.values():
        counts = Counter(goals)
        reached += max(sum(n for goal, n in counts.items() if path[: len(goal)] == goal) for path in counts)
    return reached / len(tasks) * tasks[0].goal_reward
