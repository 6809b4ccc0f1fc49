"""Reward per frame: the largest of any policy, and what four simple policies lose in a block."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch

from ctgraph_rl.tasks.task import Task
from ctgraph_rl.tasks.values import memoryless_ceiling, optimal_value, policy_measures

BISECTIONS = 80


def optimal_gain(task: Task, pause: int = 0) -> float:
    """Return g*, the largest E[return] / E[length] of any policy.

    The best value of episodes that pay g for every step is 0 at g = g*, and falls with g (Dinkelbach 1967).

    Args:
        pause: steps without a reward between two episodes: 1 where these are hidden.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_fo_b1
        >>> round(optimal_gain(ct_fo_b1()) * ct_fo_b1().graph.expected_episode_length, 12)
        1.0
    """
    low, high = -1.0, 1.0
    while _surplus(task, low, pause) < 0:
        low *= 2
    while _surplus(task, high, pause) > 0:
        high *= 2
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        if _surplus(task, middle, pause) > 0:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def _surplus(task: Task, gain: float, pause: int) -> float:
    return optimal_value(replace(task, step_reward=task.step_reward - gain), 1.0) - pause * gain


class Reached(NamedTuple):
    """What a policy reaches in a block and loses against the best, on average."""

    at_end: float  # the return of its last episode
    in_episodes: float  # lost return, in finished episodes
    in_frames: float  # lost reward, in all frames


def reached_by_policies(task: Task, num_frames: int, pause: int = 0) -> dict[str, Reached]:
    """Return what the optimal policy, a search, the best memoryless and the random policy reach in a block.

    The search tries each end state once by the best way, and then returns to the goal; each block starts a new one.

    Args:
        num_frames: of the block. The part of an episode at its end counts as its share.
        pause: as in `optimal_gain`.

    Returns:
        By name; without search and memoryless, where these have no closed form.
    """
    b = task.graph.branching_factor
    uniform = torch.full([task.images.num_images, b + 1], 1 / (b + 1), dtype=torch.float64, device="cpu")
    [chance] = policy_measures(task, uniform.unsqueeze(0))
    best = optimal_value(task, 1.0)
    gain = optimal_gain(task, pause)

    def reached(value: float, length: float) -> Reached:
        num_episodes = num_frames / (length + pause)
        return Reached(value, num_episodes * (best - value), num_frames * gain - num_episodes * value)

    found = {"optimal": Reached(best, 0.0, 0.0), "random": reached(chance.return_mean, chance.length_mean)}
    try:
        ceiling = memoryless_ceiling(task)
    except ValueError:  # not a needle, so the other two have no closed form
        return found
    length = task.graph.expected_episode_length + task.extra_end_step
    found["memoryless"] = reached(ceiling, length)
    num_goals = task.graph.num_end_states
    tried = min(num_frames / (length + pause), num_goals)
    failures = tried - tried * (tried + 1) / (2 * num_goals)
    missed = (1 - tried / num_goals) * task.goal_reward
    found["search"] = Reached(best - missed, failures * task.goal_reward, failures * task.goal_reward)
    return found
