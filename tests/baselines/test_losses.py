"""What agents minimise, by hand."""

from __future__ import annotations

import pytest
import torch
from helpers.small_agents import ONE_HOT_TASK, batches, learnt_from
from torch import nn

from baselines.networks import Encoder
from curricula.paper import ct_su_b1


def test_images_reach_the_network_between_zero_and_one():
    encoder = Encoder(torch.Size([1, 2, 2]), high=255, num_features=3)
    nn.init.ones_(encoder.linear.weight)
    nn.init.zeros_(encoder.linear.bias)

    features = encoder(torch.tensor([[[[255, 0], [51, 102]]]], dtype=torch.uint8))

    torch.testing.assert_close(features, torch.full((1, 3), 1.6))


@pytest.mark.parametrize("name", ["a2c", "lstm_ppo", "ppo", "ppo_count", "rl2"])
def test_entropy_is_rewarded_and_the_critics_error_is_weighed(small_agent, name):
    agent = small_agent(name, [ct_su_b1()], "agent.entropy_coeff=0.25", "agent.critic_coeff=2.0")
    minibatch = learnt_from(agent, batches(agent, ct_su_b1(), 1)[0])[0]

    losses = agent.loss(minibatch)

    values = agent.critic.module(agent.trunk.over_time(minibatch))
    error = (values - minibatch["value_target"]).square().mean()
    torch.testing.assert_close(losses["loss_entropy"], -0.25 * losses["entropy"])
    torch.testing.assert_close(losses["loss_critic"], 2.0 * error)


def test_gradients_are_scaled_down_to_the_largest_norm(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()], "agent.max_grad_norm=0.001")

    learnt_from(agent, batches(agent, ct_su_b1(), 1)[0])

    norm = nn.utils.get_total_norm([p.grad for p in agent.parameters() if p.grad is not None])
    assert 0 < norm <= 0.001 * (1 + 1e-4)


def test_dqn_takes_the_online_networks_best_action_at_the_target_networks_value(small_agent):
    agent = small_agent("dqn", [ONE_HOT_TASK], "agent.gamma=0.5", "agent.n_steps=1")
    agent.learn(batches(agent, ONE_HOT_TASK, 1)[0])
    for parameter in agent.greedy.parameters():
        nn.init.normal_(parameter, generator=torch.Generator().manual_seed(1))
    batch = agent.replay[:]

    loss = agent.loss(batch)["loss_value"]

    online = _values(agent, batch["next", "observation"])
    with agent.dqn.target_value_network_params.to_module(agent.dqn.value_network):
        of_target = agent.dqn.value_network(_observed(batch["next", "observation"]))["action_value"]
    assert (online.argmax(-1) != of_target.argmax(-1)).any()
    value = of_target.gather(-1, online.argmax(-1, keepdim=True))
    target = batch["next", "reward"] + 0.5 * value * ~batch["next", "terminated"]
    chosen = _values(agent, batch["observation"]).gather(-1, batch["action"].unsqueeze(-1))
    torch.testing.assert_close(loss, (chosen - target).square().mean())


def _observed(observation):
    from tensordict import TensorDict

    return TensorDict({"observation": observation}, observation.shape[:1])


def _values(agent, observation):
    return agent.greedy(_observed(observation))["action_value"]
