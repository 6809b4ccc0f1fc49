"""Random network distillation: a bonus that falls as observations become known, beside an unchanged PPO."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.small_agents import MINIBATCHES, batches, parameters_equal

from baselines.ppo_rnd import Moments, Novelty
from curricula.paper import ct_su_b1


def test_the_bonus_of_a_few_images_without_noise_goes_to_zero_and_a_new_image_has_one():
    torch.manual_seed(0)
    novelty = Novelty(num_inputs=16, high=255, hidden_size=32, num_features=8, num_envs=4, gamma=0.9)
    images = torch.randint(256, (5, 16), dtype=torch.uint8)
    optimiser = torch.optim.Adam(novelty.predictor.parameters(), 0.01)
    batch = images[torch.randint(4, (4, 8))]

    first = novelty.bonus(batch).mean()
    for _ in range(300):
        optimiser.zero_grad()
        novelty(batch).mean().backward()
        optimiser.step()
    known, new = novelty.bonus(batch).mean(), novelty(images[4:]) / novelty(images[:4]).max()

    assert first > 0.1 and known < 1e-4 * first and new > 100


def test_a_predictor_that_equals_the_random_network_leaves_ppo_as_it_is(small_agent):
    with_bonus, plain = (small_agent(name, [ct_su_b1()], *MINIBATCHES) for name in ("ppo_rnd", "ppo"))
    with_bonus.novelty.predictor.load_state_dict(with_bonus.novelty.target.state_dict())
    for weights in with_bonus.bonus_critic.parameters():
        torch.nn.init.zeros_(weights)
    start = [weights.clone() for weights in plain.policy.parameters()]
    collected = batches(plain, ct_su_b1(), 2)

    for agent in (with_bonus, plain):
        torch.manual_seed(5)
        for batch in collected:
            agent.learn(batch)

    assert parameters_equal(with_bonus.policy, plain.policy)
    assert not any(map(torch.equal, plain.policy.parameters(), start))


def test_moments_of_parts_are_those_of_the_whole():
    torch.manual_seed(0)
    rows = 3 + 2 * torch.randn(60, 2, dtype=torch.float64)
    moments = Moments(2)

    for part in rows.split([10, 1, 49]):
        moments.update(part)

    torch.testing.assert_close(moments.mean, rows.mean(dim=0))
    torch.testing.assert_close(moments.variance, rows.var(dim=0, correction=0))
    assert moments.count == 60


def test_the_bonus_is_the_error_over_the_standard_deviation_of_its_discounted_returns():
    torch.manual_seed(0)
    novelty = Novelty(num_inputs=2, high=1, hidden_size=4, num_features=3, num_envs=1, gamma=0.5)
    observations = torch.tensor([[[0, 0], [0, 1], [1, 1]]], dtype=torch.uint8)

    bonus = novelty.bonus(observations)

    inputs = (observations[0] - torch.tensor([1 / 3, 2 / 3])) / (2 / 9 + 1e-6) ** 0.5
    one, two, three = (novelty.predictor(inputs) - novelty.target(inputs)).square().mean(dim=-1)
    returns = torch.stack([one, two + one / 2, three + two / 2 + one / 4])
    torch.testing.assert_close(bonus, torch.stack([one, two, three])[None] / returns.std(correction=0))
    torch.testing.assert_close(novelty.returns, returns[2:])


def test_returns_of_the_bonus_go_over_the_ends_of_episodes_and_are_added_to_the_rewards_advantages(small_agent):
    agent = small_agent("ppo_rnd", [ct_su_b1()], "agent.bonus_coeff=0.5", "agent.bonus_gamma=0.5", "agent.gae_lambda=1")
    batch = batches(agent, ct_su_b1(), 1)[0]
    assert batch["next", "done"][:, :-1].any()
    bonus = torch.rand(batch.shape)
    agent.novelty.bonus = lambda observations: bonus
    values, after = (agent.bonus_values(data) for data in (batch, batch["next"]))

    given = agent.with_advantage(batch, agent.one_seed)

    target = after[:, -1:]
    for step in reversed(range(8)):
        target = torch.cat([bonus[:, step, None, None] + 0.5 * target[:, :1], target], dim=1)
    agent.settings = replace(agent.settings, bonus_coeff=0.0)
    torch.testing.assert_close(given["bonus_target"], target[:, :-1])
    torch.testing.assert_close(
        given["advantage"], agent.with_advantage(batch, agent.one_seed)["advantage"] + 0.5 * (target[:, :-1] - values)
    )


@pytest.mark.parametrize("share, used", [(0.25, 16), (0.001, 1), (1.0, 64)])
def test_the_predictor_learns_from_a_share_of_each_minibatch(small_agent, share, used):
    agent = small_agent("ppo_rnd", [ct_su_b1()], *MINIBATCHES, f"agent.predictor_share={share}")
    seen, forward = [], agent.novelty.forward
    agent.novelty.forward = lambda observations: (seen.append(len(observations.flatten(0, -4))), forward(observations))[
        1
    ]

    agent.learn(batches(agent, ct_su_b1(), 1)[0])

    assert seen == [128] + [used] * 4


def test_a_task_starts_with_new_statistics_and_a_predictor_that_knows_nothing(small_agent):
    agent = small_agent("ppo_rnd", [ct_su_b1()])
    agent.learn(batches(agent, ct_su_b1(), 1)[0])
    learned = [weights.clone() for weights in agent.novelty.predictor.parameters()]
    fixed = [weights.clone() for weights in agent.novelty.target.parameters()]
    assert agent.novelty.returns.any() and agent.bonus_optimiser.state

    agent.start_task(0)

    assert not (agent.novelty.returns.any() or agent.novelty.of_observations.count or agent.bonus_optimiser.state)
    assert not any(map(torch.equal, agent.novelty.predictor.parameters(), learned))
    assert all(map(torch.equal, agent.novelty.target.parameters(), fixed))
