"""Small agents with a lifelong-learning method."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from baselines.learner import Learner
from baselines.methods.importance import Importance
from baselines.methods.method import AgentWithMethod, Method
from ctgraph_rl import Block, CTGraphEnv
from ctgraph_rl.runs import config
from helpers.scripted import ONE, THREE, TWO, of
from helpers.small_agents import SMALL_AGENT, batches

TASKS = (ONE, TWO, THREE)


def made(compose, group: str, name: str, *overrides: str) -> Any:
    """What builds the choice of a group of the configuration."""
    return config.target(compose(f"{group}={name}", *overrides), group)


def small(compose, agent: str, tasks=TASKS, *overrides: str) -> Any:
    """An agent as the fixture ``small_agent`` builds it."""
    env = CTGraphEnv(tasks)
    torch.manual_seed(0)
    make_agent = made(compose, "agent", agent, *SMALL_AGENT[agent], *overrides)
    return make_agent(env.observation_spec_unbatched, env.action_spec_unbatched)


def with_method(compose, agent: str, method: Method, tasks=TASKS, *overrides: str) -> AgentWithMethod:
    """A small agent with a method, which is told the ids of tasks that have a block each."""
    curriculum = method.prepare(of(*(Block(task, 160) for task in tasks), task_id="at_boundaries"))
    return method.attach(small(compose, agent, tasks, *overrides), curriculum)


def stay(attached: AgentWithMethod, number: int, tasks=TASKS, number_of_batches: int = 2) -> None:
    """A block of some batches."""
    attached.start_task(number)
    for batch in batches(attached, tasks[number], number_of_batches, seed=number):
        attached.learn(batch)
    attached.end_task()


def weights_for(attached, number: int) -> list[torch.Tensor]:
    """Copies of the weights that a task is acted in with."""
    return [parameter.detach().clone() for parameter in attached.policy_for(number).parameters()]


RATE = 0.1


class Tiny(Learner):
    """Two inputs and three outputs, linear: logits of a policy, or action values; learns by plain gradient descent."""

    output_keys = ("log_probs",)
    minibatch_size = 0

    def __init__(self) -> None:
        super().__init__(num_envs=1, num_steps=1, max_grad_norm=1e9)
        self.linear = nn.Linear(2, 3)
        self.policy = TensorDictModule(self.linear, in_keys=["observation"], out_keys=["logits"])
        self.optimiser = torch.optim.SGD(self.parameters(), RATE)

    def outputs(self, data: Any) -> dict[str, Tensor]:
        outputs = self.linear(data["observation"])
        return {"log_probs": outputs.log_softmax(dim=-1), "action_value": outputs}

    def loss(self, batch: Any) -> dict[str, Tensor]:
        """Linear in the outputs: two parts, and something that is only measured."""
        each = (batch["factor"] * self.linear(batch["observation"])).mean(dim=0)
        return {"loss_first": each[0], "loss_others": each[1:].sum(), "entropy": each.sum() * 100}


def seen(number: int, seed: int = 0) -> dict[str, Tensor]:
    """A minibatch."""
    generator = torch.Generator().manual_seed(seed)
    observation, factor = (torch.randn(number, width, generator=generator) for width in (2, 3))
    return {"observation": observation, "factor": factor, "action": torch.zeros(number, dtype=torch.int64)}


def same(one: Any, other: Any) -> bool:
    """Whether two lists or dictionaries of tensors are equal bit by bit."""
    pairs = zip(one, other, strict=True) if isinstance(one, list) else [(one[key], other[key]) for key in one]
    return all(torch.equal(*pair) for pair in pairs)


CURRICULUM = of(*(Block(task, 64) for task in TASKS), task_id="at_boundaries")


def tiny(method: Importance, kind: type[Tiny] = Tiny) -> AgentWithMethod:
    torch.manual_seed(0)
    return AgentWithMethod(kind(), method, CURRICULUM)
