"""What agents minimise, by hand; and the steps of several seeds in one operation."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from helpers.small_agents import ONE_HOT_TASK, Tiny, batches, learnt_from
from torch import nn

from baselines.parts.networks import Encoder
from baselines.update.seeds import sampled
from baselines.update.stack import Stack
from baselines.update.update import make_optimiser, update
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


def test_gradients_are_scaled_down_to_the_largest_norm(small_agent, monkeypatch):
    agent = small_agent("lstm_ppo", [ct_su_b1()], "agent.max_grad_norm=0.001")
    given = []
    monkeypatch.setattr("baselines.update.update.step", lambda optimiser, gradients: given.append(gradients))

    agent.learn(batches(agent, ct_su_b1(), 1)[0])

    norm = nn.utils.get_total_norm(given[-1])
    assert 0 < norm <= 0.001 * (1 + 1e-4)


def test_dqn_takes_the_online_networks_best_action_at_the_target_networks_value(small_agent):
    agent = small_agent("dqn", [ONE_HOT_TASK], "agent.gamma=0.5", "agent.n_steps=1")
    agent.learn(batches(agent, ONE_HOT_TASK, 1)[0])
    for parameter in agent.greedy.parameters():
        nn.init.normal_(parameter, generator=torch.Generator().manual_seed(1))
    batch = agent.replay[:]

    loss = agent.loss(batch)["loss_value"]

    online = _values(agent, batch["next", "observation"])
    of_target = agent.target(_observed(batch["next", "observation"]))["action_value"]
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


class Noisy(Tiny):
    """Has a loss whose gradients are those of its batch, of a matrix and a vector."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.double()
        self.max_grad_norm = 0.5
        self.optimiser = make_optimiser(name, self.parameters(), 0.1)

    def loss(self, batch):
        return {"loss_all": sum((batch[name] * each).sum() for name, each in self.linear.named_parameters())}


@pytest.mark.parametrize("name", ["adam", "rmsprop"])
def test_a_stacked_update_is_that_of_each_learner_with_its_own_gradient_norm(name):
    torch.manual_seed(0)
    learners = [Noisy(name) for _ in SEEDS]
    others = [deepcopy(learner) for learner in learners]
    shapes = {name: each.shape for name, each in learners[0].linear.named_parameters()}

    for _ in range(2):  # the second time with the state of the first
        stack = Stack(learners)
        for _ in range(3):
            batch = {name: torch.randn(len(SEEDS), *shape).double() for name, shape in shapes.items()}
            measured = update(learners[0], stack.state, batch)
            for number, other in enumerate(others):
                alone = {name: value[number] for name, value in batch.items()}
                for part, parameter in other.linear.named_parameters():
                    parameter.grad = alone[part].clone()
                norm = torch.nn.utils.clip_grad_norm_(other.parameters(), 0.5)
                assert measured["grad_norm"][number] == pytest.approx(norm.item(), rel=1e-12)
                other.optimiser.step()
        stack.write()
        stack.write()  # writes no step twice

    for learner, other in zip(learners, others, strict=True):
        for one, its in zip(learner.parameters(), other.parameters(), strict=True):
            torch.testing.assert_close(one, its, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(
            learner.optimiser.state_dict()["state"], other.optimiser.state_dict()["state"], rtol=1e-12, atol=1e-12
        )


def test_actions_are_drawn_as_multinomial_draws_them_from_a_generator():
    log_probs = torch.randn(3, 50, 4, generator=torch.Generator().manual_seed(0)).log_softmax(dim=-1)
    noise = torch.stack([torch.empty(50, 4).exponential_(generator=seeded(seed)) for seed in SEEDS])

    written = sampled({"log_probs": log_probs, "state_value": log_probs[..., :1]}, noise)

    for number, seed in enumerate(SEEDS):
        chances = log_probs[number].softmax(dim=-1)
        assert torch.equal(written["action"][number], chances.multinomial(1, generator=seeded(seed)).squeeze(-1))


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_acting_and_learning_compute_the_same_log_probabilities(small_agent):
    agent, env = small_agent("ppo", [ct_su_b1()]), CTGraphEnv([ct_su_b1()] * 16)

    with torch.no_grad():
        data = agent.policy(env.reset())
        expected = agent.outputs(data)["log_probs"].gather(-1, data["action"].unsqueeze(-1)).squeeze(-1)

    assert torch.equal(data["action_log_prob"], expected)
