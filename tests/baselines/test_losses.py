"""What agents minimise, by hand; and the steps of several seeds in one operation."""

from __future__ import annotations

import pytest
import torch
from helpers.small_agents import ONE_HOT_TASK, batches, learnt_from
from torch import nn

from baselines.networks import Encoder
from baselines.optimisers import StackedOptimiser, make_optimiser, stacked
from baselines.together import sampled
from ctgraph_rl import CTGraphEnv
from curricula.paper import ct_su_b1

SEEDS = (0, 3, 8)


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


@pytest.mark.parametrize("functional", [False, True])
@pytest.mark.parametrize("name", ["adam", "rmsprop"])
def test_a_stacked_step_is_that_of_each_optimiser_with_its_own_gradient_norm(name, functional):
    torch.manual_seed(0)
    own = [[torch.nn.Parameter(torch.randn(*shape).double()) for shape in ((3, 3), (4,))] for _ in SEEDS]
    optimisers = [make_optimiser(name, parameters, 0.1) for parameters in own]
    copies = [[torch.nn.Parameter(each.detach().clone()) for each in parameters] for parameters in own]
    others = [make_optimiser(name, parameters, 0.1) for parameters in copies]

    for _ in range(2):  # the second time with the state of the first
        kept = [stacked([each.detach() for each in pair]).requires_grad_() for pair in zip(*own, strict=True)]
        stack = StackedOptimiser(optimisers, kept)
        for _ in range(3):
            gradients = [torch.randn_like(parameter) for parameter in kept]
            one = stack.functional(kept, stack.tensors) if functional else stack
            norms = one.step(gradients, 0.5)
            stack.num_steps += functional
            for number, parameters in enumerate(copies):
                parameters[0].grad, parameters[1].grad = (
                    gradients[0][number].mT.contiguous(),
                    gradients[1][number].clone(),
                )
                norm = torch.nn.utils.clip_grad_norm_(parameters, 0.5)
                assert norms[number] == pytest.approx(norm.item(), rel=1e-12)
                others[number].step()
        stack.write()
        stack.write()  # writes no step twice
        for number, parameters in enumerate(own):
            parameters[0].data.copy_(kept[0][number].mT.detach())
            parameters[1].data.copy_(kept[1][number].detach())

    for number in range(len(SEEDS)):
        for one, other in zip(own[number], copies[number], strict=True):
            torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
            mine, its = optimisers[number].state[one], others[number].state[other]
            assert mine.keys() == its.keys()
            for key in its:
                torch.testing.assert_close(mine[key], its[key], rtol=1e-12, atol=1e-12)


def test_actions_are_drawn_as_multinomial_draws_them_from_the_seeds_own_generator():
    log_probs = torch.randn(3, 50, 4, generator=torch.Generator().manual_seed(0)).log_softmax(dim=-1)
    generators = [torch.Generator().manual_seed(seed) for seed in SEEDS]

    written = sampled({"log_probs": log_probs, "state_value": log_probs[..., :1]}, generators)

    for number, seed in enumerate(SEEDS):
        alone = torch.Generator().manual_seed(seed)
        chances = log_probs[number].softmax(dim=-1)
        assert torch.equal(written["action"][number], chances.multinomial(1, generator=alone).squeeze(-1))
        assert torch.equal(alone.get_state(), generators[number].get_state())


def test_acting_and_learning_compute_the_same_log_probabilities(small_agent):
    agent, env = small_agent("ppo", [ct_su_b1()]), CTGraphEnv([ct_su_b1()] * 16)

    with torch.no_grad():
        data = agent.policy(env.reset())
        expected = agent.outputs(data)["log_probs"].gather(-1, data["action"].unsqueeze(-1)).squeeze(-1)

    assert torch.equal(data["action_log_prob"], expected)
