"""Small agents with a plasticity, and what they learn from."""

from __future__ import annotations

from typing import Any

import torch

from helpers.small_agents import CURRICULUM, TASKS, batches, learnt_from, small

MOMENTS = ("exp_avg", "exp_avg_sq")


def plastic(compose, plasticity: Any, agent: str = "ppo", *overrides: str) -> Any:
    """A small agent with a plasticity; equal weights for every call."""
    return plasticity.attach(small(compose, agent, TASKS, *overrides), CURRICULUM)


def minibatch_of(agent: Any, seed: int = 0) -> dict:
    """A minibatch that the agent would learn from; it has learned from the batch."""
    [batch] = batches(agent, TASKS[0], 1, seed)
    return learnt_from(agent, batch)[0]


def weights_of(agent: Any) -> list[torch.Tensor]:
    """Copies of all weights."""
    return [parameter.detach().clone() for parameter in agent.parameters()]


def equal(one: list, other: list) -> bool:
    """Whether weights are equal bit by bit."""
    return all(torch.equal(*pair) for pair in zip(one, other, strict=True))


def learned(agent: Any, count: int = 2) -> list[torch.Tensor]:
    """The weights after some batches."""
    for batch in batches(agent, TASKS[0], count):
        agent.learn(batch)
    return weights_of(agent)
