"""What predictors learn from, and their score: bits a step above the environment's exact entropy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ctgraph_rl.checks import require
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import InitialState, Policy, collect
from ctgraph_rl.learn.histories import distinct
from ctgraph_rl.policies import NavigationPolicy
from ctgraph_rl.tasks.observability import transition_entropy
from ctgraph_rl.tasks.task import Task, ct_graphs

NUM_ROWS = 64


class Transitions(NamedTuple):
    """Steps of rows in time order, int64 [rows, steps] each."""

    image: Tensor  # number of the image before the step
    context: Tensor  # number of the pair of image and action
    pair: Tensor  # number of the pair of image and reward after the step


class Symbols:
    """The images and rewards of tasks as numbers, to which predictors give probabilities.

    Args:
        tasks: whose images differ in pixels only, without noise or rotation on read.

    Raises:
        ValueError: for tasks whose images vary on read, or differ in shape.
    """

    def __init__(self, tasks: Sequence[Task]) -> None:
        tasks = ct_graphs(tasks, "a model of the environment")
        varied = any(task.observations.read_noise or task.observations.read_rotation for task in tasks)
        shapes = {task.observation_shape for task in tasks}
        require(
            (not varied, "a model numbers images: tasks need read_noise=0 and read_rotation=0"),
            (len(shapes) == 1, f"tasks of a model need observations of one shape, got {sorted(shapes)}"),
        )
        banks = {task.images: task.images.bank(0).flatten(1) for task in tasks}
        self.images = torch.cat(list(banks.values())).unique(dim=0)
        paid = {0.0}
        for task in tasks:
            paid.update((task.goal_reward, task.fail_reward))
        every: set[float] = set()
        for step in {task.step_reward for task in tasks}:
            every.update(reward + step for reward in paid)
        self.rewards = torch.tensor(sorted(every), dtype=torch.float32, device="cpu")
        self.num_actions = max(task.num_actions for task in tasks)
        self.num_contexts = len(self.images) * self.num_actions
        self.num_pairs = len(self.images) * len(self.rewards)

    def of(self, batch: TensorDictBase) -> Transitions:
        """Return a batch's transitions, [rows, steps] in time order.

        Raises:
            ValueError: for an image that no task has.
        """
        reward = (batch["next", "reward"].squeeze(-1).unsqueeze(-1) - self.rewards).abs().argmin(-1)
        seen = self._numbers(batch["observation"], batch.ndim)
        after = self._numbers(batch["next", "observation"], batch.ndim)
        return Transitions(seen, seen * self.num_actions + batch["action"], after * len(self.rewards) + reward)

    def _numbers(self, observation: Tensor, num_dims: int) -> Tensor:
        known = len(self.images)
        flat = observation.flatten(num_dims).flatten(0, num_dims - 1)
        examples, groups = distinct([flat])
        images, numbers = torch.cat([self.images, flat[examples]]).unique(dim=0, return_inverse=True)
        require((len(images) == known, "the data show an image that no task has"))
        return numbers[known:][groups].view(observation.shape[:num_dims])


class Predictor(Protocol):
    """Gives the next observation and reward probabilities, given all observations and actions so far."""

    def learn(self, transitions: Transitions) -> None:
        """Learn from data, in addition to earlier ones."""
        ...

    def bits(self, transitions: Transitions) -> Tensor:
        """Return -log2 of the probability that each step's pair had before it came, float [rows, steps]."""
        ...


def experience(
    task: Task,
    symbols: Symbols,
    policy: Policy | type = NavigationPolicy,
    num_steps: int = 256,
    seed: int = 0,
    initial_state: InitialState | None = None,
) -> Transitions:
    """Return what a policy meets in a task.

    Args:
        symbols: of it and all tasks that the predictor meets.
        policy: an agent's ``policy``, which samples, or a class of `ctgraph_rl.policies`.
        num_steps: steps of each of 64 rows.
        seed: of the environment and of torch's generator, whose state is restored.
        initial_state: of an agent with memory.
    """
    env = CTGraphEnv([task] * NUM_ROWS, seed)
    acts = policy(env) if isinstance(policy, type) else policy
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        [batch] = collect(env, acts, NUM_ROWS * num_steps, num_steps, initial_state)
    return symbols.of(batch)


def learned_share(model: Predictor, test: Transitions, task: Task, policy: str = "navigation") -> float:
    """Return the share of what can be predicted: 1 is the exact model, 0 knows frequencies only.

    1 - (bits - H) / (U - H), with the exact H and U of `transition_entropy` with and without information. It is below 0
    for a predictor that is wrong and sure.

    Args:
        test: transitions of the named policy that it has not learned from.
        policy: a name as for `transition_entropy`.
    """
    exact = transition_entropy(task, policy)
    frequencies = transition_entropy(task, policy, informed=False)
    return 1 - (model.bits(test).double().mean().item() - exact) / (frequencies - exact)
