"""An agent that wears a method: to a run it is an agent like any other."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from baselines.learner import Learner
from baselines.methods.method import Method
from baselines.methods.weights import Weights
from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import require
from ctgraph_rl.tasks.curriculum import Curriculum


class Wearing(nn.Module):
    """An agent and what tells its method where tasks begin and end.

    Args:
        agent: any `Learner`; the method is part of it from now on.
        method: what it wears.
        curriculum: what will be learned.

    Raises:
        ValueError: if the two cannot go together.
    """

    def __init__(self, agent: Learner, method: Method, curriculum: Curriculum) -> None:
        super().__init__()
        self.agent: Learner = agent
        method.put_on(agent, Weights(agent.policy, agent.weights), curriculum)
        agent.method = method
        self.num_envs, self.num_steps = agent.num_envs, agent.num_steps
        self.memory = agent.memory
        self.policy: TensorDictModuleBase = agent.policy
        self._copies: dict[int, TensorDictModuleBase] = {}

    def policy_for(self, task: int) -> TensorDictModuleBase:
        """The agent's policy, or where the method has other weights for a task, a copy of the policy with them."""
        weights = self.agent.method.weights_of(task)
        policy = self.agent.policy_for(task)
        if weights is None:
            return policy
        if task not in self._copies:
            self._copies[task] = deepcopy(policy)
        copy = self._copies[task]
        copy.load_state_dict(policy.state_dict())
        self.agent.method.weights.give(copy, weights)
        return copy

    def initial_state(self, num_envs: int) -> TensorDict:
        """The agent's."""
        return self.agent.initial_state(num_envs)

    def start_task(self, task: int | None = None) -> None:
        """Tell the method, then the agent."""
        self.agent.method.start_task(task)
        self.agent.start_task(task)

    def end_task(self) -> None:
        """Tell the agent, then the method."""
        self.agent.end_task()
        self.agent.method.end_task()

    def loss(self, batch: Mapping[Any, Tensor] | TensorDictBase) -> Mapping[str, Tensor]:
        """The agent's losses and the method's."""
        return self.agent.losses(batch)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Let the method see the batch and the agent learn from it."""
        self.agent.method.see(batch)
        return self.agent.learn(batch)


def wear(agent: Agent, method: Method, curriculum: Curriculum) -> Agent:
    """An agent with a method for a curriculum.

    Raises:
        ValueError: if the two cannot go together.
    """
    name = type(method).__name__
    message = f"method {name} needs an agent that derives from baselines.learner.Learner, got {type(agent).__name__}"
    require((isinstance(agent, Learner), f"{message}; method=finetune goes with any"))
    assert isinstance(agent, Learner)
    return Wearing(agent, method, curriculum)
