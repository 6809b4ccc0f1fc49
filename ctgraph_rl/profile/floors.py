"""Floors of agents without a property: policies that count steps, and a random search."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from functools import cache
from math import prod

from ctgraph_rl.checks import require
from ctgraph_rl.tasks.task import Task
from ctgraph_rl.tasks.values import memoryless_ceiling, open_loop_ceiling, random_frames_to_goal

NEGLIGIBLE = 1e-9

STARTS = 20


def best_without_memory(task: Task) -> float:
    """Return the best mean return of a policy that sees the image and the step's number, and remembers nothing.

    It is at least that of the best memoryless policy, which may act at random, and of the best action sequence.
    """
    return max(memoryless_ceiling(task), open_loop_ceiling(task), counting_ceiling(task))


def counting_ceiling(task: Task) -> float:
    """Return the best mean return of a policy that sees the image and the step's number.

    It waits where it must. At a decision state it only knows when it is there: with random waits, an early decision is
    likely the first one. With a_t the decision at step t, success has the probability

        sum over t_1 < ... < t_d of P(t_1) P(t_2 | t_1) ... [a_(t_1) = g_1] ... [a_(t_d) = g_d].

    Each a_t is chosen in turn, with all others fixed, until none changes: a local optimum, the best of `STARTS`.

    Args:
        task: a needle with goal_reward 1 and no other reward.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_posr_b1
        >>> counting_ceiling(ct_posr_b1(goal="1.2"))
        0.75
    """
    rule = "the ceiling of counting is for a goal that pays 1 and no other reward"
    require(((task.goal_reward, task.fail_reward, task.step_reward) == (1, 0, 0), f"{rule}, got {task!r}"))
    if task.observations.unique_decisions:
        return 1.0
    return best_by_step(task.graph.branching_factor, task.graph.wait_prob, task.goal_decisions)[0]


@cache
def best_by_step(branching_factor: int, wait_prob: float, goal: tuple[int, ...]) -> tuple[float, tuple[int, ...]]:
    """Return such a policy's success where decision states share an image, and its decision at each step."""
    source = random.Random(0)
    num_steps = 2 * len(goal) + 2
    if wait_prob:  # until almost no episode still waits for a decision
        num_steps += len(goal) * math.ceil(math.log(NEGLIGIBLE) / math.log(wait_prob))
    best: tuple[float, tuple[int, ...]] = (-1.0, ())
    for _ in range(STARTS):
        decisions = [source.randint(1, branching_factor) for _ in range(num_steps)]
        value = -1.0
        while (improved := _improve(decisions, wait_prob, goal)) > value + NEGLIGIBLE:
            value = improved
        best = max(best, (round(value, 6), tuple(decisions)))
    return best


def _improve(decisions: list[int], wait_prob: float, goal: tuple[int, ...]) -> float:
    depth = len(goal)
    num_steps = len(decisions)
    later = [[0.0] * depth for _ in range(num_steps + 2)]  # success from the wait state of a level, by step
    for step in reversed(range(num_steps)):
        for level in range(depth):
            decided = _after(later, step + 2, level) if _at(decisions, step + 1) == goal[level] else 0.0
            later[step][level] = wait_prob * later[step + 1][level] + (1 - wait_prob) * decided
    waiting = [1.0] + [0.0] * (depth - 1)
    deciding = [0.0] * depth
    success = 0.0
    for step in range(1, num_steps):
        worth = dict.fromkeys(range(1, max(goal) + 1), 0.0)
        for level in range(depth):
            worth[goal[level]] += deciding[level] * _after(later, step + 1, level)
        if max(worth.values()) > worth.get(decisions[step], 0.0) + 1e-15:
            decisions[step] = max(worth, key=lambda decision: worth[decision])
        arrived = [0.0] * depth
        for level in range(depth):
            if decisions[step] != goal[level]:
                continue
            if level + 1 == depth:
                success += deciding[level]
            else:
                arrived[level + 1] = deciding[level]
        deciding = [(1 - wait_prob) * share for share in waiting]
        waiting = [wait_prob * share + new for share, new in zip(waiting, arrived, strict=True)]
    return success


def _at(decisions: list[int], step: int) -> int:
    return decisions[step] if step < len(decisions) else 0


def _after(later: list[list[float]], step: int, level: int) -> float:
    """Return the success after the right decision of a level, which leads to the next wait state at a step."""
    if level + 1 == len(later[0]):
        return 1.0
    return later[min(step, len(later) - 1)][level + 1]


def found_share(task: Task, num_frames: float) -> float:
    """Return the probability that random actions reach a goal within some frames.

    Successes come with the rate 1 / m, m = `random_frames_to_goal`, so rarely that the first one comes within n frames
    with probability 1 - exp(-n / m).
    """
    return -math.expm1(-num_frames / random_frames_to_goal(task))


def all_found_share(tasks: Sequence[Task], num_frames: Sequence[int]) -> float:
    """Return the probability that random actions reach each goal within the frames of its block."""
    return prod(found_share(task, frames) for task, frames in zip(tasks, num_frames, strict=True))
