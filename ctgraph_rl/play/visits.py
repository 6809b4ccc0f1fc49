"""Visits of a policy to each state of a task, and its actions there."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ctgraph_rl.core.graph import StateType
from ctgraph_rl.draw.layout import Key
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import InitialState, Policy
from ctgraph_rl.learn.evaluate import evaluate
from ctgraph_rl.policies import RandomPolicy
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import Task


class Visits(NamedTuple):
    """Counts over episodes, by (state type, node); home and fail have node 0."""

    counts: dict[tuple[StateType, int], int]
    """Steps that began in a home, wait or decision state, and episodes that ended in an end state or in fail."""
    actions: dict[tuple[StateType, int], list[float]]
    """The share of each action in home, wait and decision states; those above b belong to other tasks and fail."""


def visits(
    task: Task,
    policy: Policy,
    initial_state: InitialState | None = None,
    num_episodes: int = 100,
    seed: int = 0,
    greedy: bool = True,
    episodes_per_row: int = 1,
    curriculum: Curriculum | None = None,
) -> Visits:
    """Count visits and actions of a policy; ``draw_task(axes, task, visits=counts, policy=actions)`` draws them.

    Args:
        policy: as for `evaluate`.
        initial_state: gives a recurrent policy's state for a number of rows.
        num_episodes: episodes in all.
        seed: of the environment and, if not greedy, of the policy's draws.
        greedy: most likely actions; False samples and explores as in training.
        episodes_per_row: successive episodes of a row, for goals that change and policies that learn in a trial.
        curriculum: whose task ids the policy sees, if its protocol shows them.

    Raises:
        ValueError: as `evaluate`.
    """
    seen: list[Tensor] = []

    class Watched:
        """The policy, noting each row's state and action."""

        def __init__(self, env: CTGraphEnv) -> None:
            self.env = env
            self.acts = policy(env) if isinstance(policy, type) else policy
            self.episode = torch.zeros_like(env.node)

        def __call__(self, data: TensorDictBase) -> TensorDictBase:
            self.episode += data["is_init"].squeeze(-1)
            state = self.env.state_type, self.env.node
            acted = self.acts(data)
            counted = (self.episode <= episodes_per_row) & (state[0] != StateType.END)  # which may take one more action
            seen.append(torch.stack([*state, acted["action"]], -1)[counted].cpu())
            return acted

    bound = isinstance(policy, RandomPolicy)  # to another environment, which evaluate refuses
    play = partial(evaluate, seed=seed, greedy=greedy, episodes_per_row=episodes_per_row)
    acting = policy if bound else Watched
    ends = play(acting, [task], num_episodes, initial_state=initial_state, curriculum=curriculum)
    return _count(task, torch.cat(seen), ends[0])


def _count(task: Task, steps: Tensor, ends: TensorDictBase) -> Visits:
    """Return counts of steps, int64 [S, 3] of state type, node and action, and of ends."""
    first = task.graph.num_decision_states
    leaves = ends["leaf"].flatten().tolist()
    num_actions = max(task.graph.branching_factor, int(steps[:, 2].max())) + 1
    counts: Counter[Key] = Counter()
    actions: dict[Key, list[float]] = {}
    for (kind, node, action), times in Counter(map(tuple, steps.tolist())).items():
        key = StateType(kind), node
        counts[key] += times
        actions.setdefault(key, [0.0] * num_actions)[action] += times
    shares = {key: [times / counts[key] for times in of] for key, of in actions.items()}
    counts.update((StateType.END, first + leaf) if leaf >= 0 else (StateType.FAIL, 0) for leaf in leaves)
    return Visits(dict(counts), shares)
