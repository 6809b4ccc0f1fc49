"""How far a policy's decisions depend on the images of wait states, which say nothing about the goal."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ctgraph_rl.checks import at_least_one, require, takes_numbers
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import InitialState, Policy, act, start_of_episodes
from ctgraph_rl.tasks.task import Task


@torch.no_grad()
@takes_numbers
def changed_decisions(
    policy: Policy,
    task: Task,
    swapped: Task,
    num_episodes: int = 100,
    *,
    seed: int = 0,
    initial_state: InitialState | None = None,
) -> float:
    """Return the share of greedy decisions that change when wait states show other images.

    The policy acts in the task. A second copy of it observes the same states with the images of the swapped task, and
    its actions are replaced by those of the first one. The share is over the decision states of the episodes: 0 for a
    policy that ignores wait images, and 1 - 1 / (b + 1) for uniformly random actions. Failures at swapped wait
    images do not count here: they show in ``evaluate(policy, [swapped])``.

    Args:
        policy: reads the data of all rows and writes ``action``; greedy where exploration is off.
        task: where it acts.
        swapped: the task with other wait images, as ``curricula.axes.new_images(task, 2, ("wait",))`` makes both.
        num_episodes: episodes.
        seed: of both environments.
        initial_state: gives a recurrent policy's state for a number of environments.

    Returns:
        The share; NaN if no episode meets a decision state.

    Raises:
        ValueError: for tasks that differ in more than their wait images.
    """
    same = replace(swapped.observations, wait_ids=task.observations.wait_ids)
    differs = (
        "task and swapped must differ in their wait images only: use curricula.axes.new_images(task, 2, ('wait',))"
    )
    require((replace(swapped, observations=same) == task, differs), *at_least_one(num_episodes=num_episodes))
    envs = []
    data = []
    for each in (task, swapped):
        env = CTGraphEnv([each] * num_episodes, seed=seed)
        start = start_of_episodes(env, initial_state)
        envs.append(env)
        data.append(dict(env.reset().update(start).items(True, True)))
    running = torch.ones(num_episodes, dtype=torch.bool, device=envs[0].device)
    changed = 0
    decided = 0
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while running.any():
            decides = running & (envs[0].state_type == StateType.DECISION)
            step, data[0] = act(envs[0], policy, data[0], start)
            follower = _Follower(policy, step["action"])
            _, data[1] = act(envs[1], follower, data[1], start)
            changed += int((decides & (follower.own != step["action"])).sum())
            decided += int(decides.sum())
            running &= ~step["next", "done"].squeeze(-1)
    return changed / decided if decided else math.nan


class _Follower:
    """A policy whose actions are replaced; its own ones are kept.

    Args:
        policy: what chooses ``own``.
        action: what is done, int64 [rows].
    """

    def __init__(self, policy: Policy, action: torch.Tensor) -> None:
        self.policy = policy
        self.action = action
        self.own = action

    def __call__(self, data: TensorDictBase) -> TensorDictBase:
        """Write the given action."""
        written = self.policy(data)
        self.own = written["action"]
        return written.set("action", self.action)
