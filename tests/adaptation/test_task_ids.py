"""Agents that adapt within trials read a task's number in place of its one-hot id."""

from __future__ import annotations

import pytest
import torch
from helpers.scripted import ONE, TWO
from helpers.small_agents import ADAPTING, agent_of
from torchrl.data import Composite

from baselines.pearl import PEARL
from ctgraph_rl import CTGraphEnv
from ctgraph_rl.learn.collect import collect

OVERRIDES = {
    "maml": ["agent.adapt_episodes=1", "agent.gate=soft"],
    "cavia": ["agent.adapt_episodes=1", "agent.outer=ppo", "agent.entropy_coeff=0.1"],
    "pearl": ["agent.num_context=2", "agent.context_size=8", "agent.batch_size=8", "agent.gate=soft"],
}
each = pytest.mark.parametrize("name", ADAPTING)


class OneHotIds(CTGraphEnv):
    """An environment, such as a user's, that shows no numbers."""

    @property
    def observation_spec_unbatched(self) -> Composite:
        spec = super().observation_spec_unbatched.clone()
        del spec["task_number"]
        return spec


def made(compose, name: str, kind: type[CTGraphEnv], num_task_ids: int = 5):
    """An agent and a batch that it collected."""
    env = kind([ONE, TWO] * 8, seed=1, task_ids={ONE: 3}, num_task_ids=num_task_ids)
    agent = agent_of(compose, name, env, "agent.num_steps=16", *OVERRIDES[name])
    torch.manual_seed(1)
    return agent, next(collect(env, agent.policy, 16 * 16, 16, agent.initial_state))


def losses(agent, batch) -> dict:
    agent.double()
    torch.manual_seed(2)
    [minibatch, *_] = agent.minibatches(batch)
    doubled = {key: value.double() if value.is_floating_point() else value for key, value in minibatch.items()}
    found = agent.loss(doubled)
    total = sum(value for key, value in found.items() if key.startswith("loss_"))
    return {"losses": found, "gradients": torch.autograd.grad(total, agent.weights, allow_unused=True)}


@each
def test_acting_and_learning_by_number_are_those_by_the_one_hot_vector(compose, name):
    by_number, batch = made(compose, name, CTGraphEnv)
    by_vector, other_batch = made(compose, name, OneHotIds)

    assert {"task_number", "task_id"} & set(by_number.policy.in_keys) == {"task_number"}
    assert {"task_number", "task_id"} & set(by_vector.policy.in_keys) == {"task_id"}
    assert torch.equal(batch["action"], other_batch["action"])
    found, expected = losses(by_number, batch), losses(by_vector, batch)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-10)


@each
def test_nothing_that_is_kept_of_a_step_is_as_long_as_an_id(compose, name):
    agent, batch = made(compose, name, CTGraphEnv, num_task_ids=20_000)

    kept = dict(agent.initial_state(1)[0].items()) | next(agent.minibatches(batch))
    if isinstance(agent, PEARL):
        kept |= agent.replay
    own = getattr(agent.policy, "own_keys", {}).values()
    assert max(value.shape[-1] for key, value in kept.items() if value.ndim and key not in own) < 1000
    assert "task_number" in kept


def test_weights_of_all_rows_that_exceed_the_memory_are_refused(compose, monkeypatch):
    env = CTGraphEnv([ONE] * 16, task_ids={ONE: 3}, num_task_ids=5)
    monkeypatch.setattr("ctgraph_rl.checks.memory_bytes", lambda: 40_000)

    agent_of(compose, "cavia", env, *OVERRIDES["cavia"])
    with pytest.raises(ValueError, match=r"weights of each of num_envs=16 rows, .* use fewer rows or smaller layers"):
        agent_of(compose, "maml", env, *OVERRIDES["maml"])
