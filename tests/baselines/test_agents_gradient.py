"""Agents that follow a policy's gradient: memory, advantages, minibatches, the exploration bonus."""

from __future__ import annotations

import pytest
import torch
from helpers.small_agents import GREEDY, POLICY_GRADIENTS, batches, learnt_from
from torch import nn
from torchrl.envs.utils import set_exploration_type

from baselines.ppo_count import SimHashCounts
from ctgraph_rl import CTGraphEnv
from curricula.paper import ct_su_b1

TINY = ("agent.num_envs=3", "agent.num_steps=2", "agent.gamma=0.5")
HAND = (*TINY, "agent.gae_lambda=0.25", "agent.num_minibatches=1", "agent.num_epochs=1")


def values_in_loss(agent, batch):
    """The critic's values while the loss of a batch is computed: the trunk runs over whole sequences."""
    keys = (*agent.policy.in_keys, "action", "action_log_prob")
    zeros = torch.zeros(*batch.batch_size, 1)
    values = []
    hook = agent.critic.module.register_forward_hook(lambda module, given, value: values.append(value.detach()))
    agent.loss(batch.select(*keys).set("advantage", zeros).set("value_target", zeros))
    hook.remove()
    return values[-1]


def test_lstm_ppo_remembers_the_same_step_by_step_and_over_whole_sequences(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()])

    for batch in batches(agent, ct_su_b1(), 2):
        over_sequences = values_in_loss(agent, batch)

        assert batch["is_init"][:, 1:].any()
        torch.testing.assert_close(over_sequences, batch["state_value"], atol=1e-6, rtol=0)


def test_lstm_ppo_forgets_where_an_episode_starts_in_a_sequence(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()])
    batch = batches(agent, ct_su_b1(), 1)[0]
    row, step = (batch["is_init"][:, 1:-1, 0].nonzero()[0] + torch.tensor([0, 1])).tolist()
    fresh = batch[row : row + 1, step:].clone()
    for key in agent.initial_state(1).keys():  # noqa: SIM118
        fresh[key] = torch.zeros_like(fresh[key])

    after_reset = values_in_loss(agent, batch)[row, step:]

    torch.testing.assert_close(after_reset, values_in_loss(agent, fresh)[0], atol=1e-6, rtol=0)


def test_lstm_ppo_forgets_where_an_episode_starts_while_acting(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()])
    data = CTGraphEnv([ct_su_b1()] * 3).reset().update(agent.initial_state(3))
    stale = data.clone().update({key: data[key] + 1 for key in agent.initial_state(3).keys()})  # noqa: SIM118
    running = stale.clone().update({"is_init": torch.zeros(3, 1, dtype=torch.bool)})

    with torch.no_grad(), set_exploration_type(GREEDY):
        expected, reset, kept = (agent.policy(start)["state_value"] for start in (data, stale, running))

    assert torch.equal(reset, expected)
    assert not torch.equal(kept, expected)


def test_lstm_ppo_remembers_within_an_episode(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()])
    batch = batches(agent, ct_su_b1(), 1)[0]
    changed = batch.clone()
    changed["observation"][:, 0] = 255 - changed["observation"][:, 0]

    difference = (values_in_loss(agent, batch) - values_in_loss(agent, changed)).abs()[..., 0]

    same_episode = batch["is_init"][..., 0].cumsum(dim=1) == 1
    assert (difference[same_episode] > 1e-4).all()
    assert (difference[~same_episode] < 1e-6).all()  # rounding, as other frames are computed together


def small_batch(agent):
    """Three rows of two steps with chosen values and rewards, and a critic that says 4 everywhere."""
    batch = batches(agent, ct_su_b1(), 1)[0]
    batch["state_value"] = torch.tensor([1.0, 2.0]).expand(3, 2).unsqueeze(-1).clone()
    batch["next", "reward"] = torch.tensor([0.0, 1.0]).expand(3, 2).unsqueeze(-1).clone()
    ended = torch.tensor([[False, False], [True, False], [False, True]]).unsqueeze(-1)
    batch["next", "done"], batch["next", "terminated"] = ended, ended.clone()
    torch.nn.init.zeros_(agent.critic.module.weight)
    torch.nn.init.constant_(agent.critic.module.bias, 4.0)  # the value after the last step
    return batch


@pytest.mark.parametrize("name", ["lstm_ppo", "ppo"])
def test_advantages_equal_the_generalised_estimate_by_hand(small_agent, name):
    agent = small_agent(name, [ct_su_b1()], *HAND)
    batch = small_batch(agent)

    learnt = agent.with_advantage(batch, agent.one_seed)

    # Running on: 1 + 0.5 * 4 - 2 = 1, and (0 + 0.5 * 2 - 1) + 0.125 * 1 = 0.125.
    # Ended by the first step: 0 - 1 = -1, then as above. Ended by the last: 1 - 2 = -1, and 0 + 0.125 * -1 = -0.125.
    expected = torch.tensor([[0.125, 1.0], [-1.0, 1.0], [-0.125, -1.0]]).unsqueeze(-1)
    torch.testing.assert_close(learnt["advantage"], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(learnt["value_target"], expected + batch["state_value"], atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", ["lstm_ppo", "ppo"])
def test_a_truncated_episode_counts_with_the_value_of_what_would_have_followed(small_agent, name):
    agent = small_agent(name, [ct_su_b1()], *HAND)
    batch = small_batch(agent)
    batch["next", "terminated"] = torch.zeros_like(batch["next", "done"])

    advantage = agent.with_advantage(batch, agent.one_seed)["advantage"]

    # Cut after the first step: 0 + 0.5 * 4 - 1 = 1. Cut after the last: as if running on.
    expected = torch.tensor([[0.125, 1.0], [1.0, 1.0], [0.125, 1.0]]).unsqueeze(-1)
    torch.testing.assert_close(advantage, expected, atol=1e-6, rtol=0)


def test_reinforce_weighs_log_probabilities_by_the_return_less_the_baseline(small_agent):
    agent = small_agent("reinforce", [ct_su_b1()], *TINY)
    batch = small_batch(agent)

    learnt = agent.with_advantage(batch, agent.one_seed)

    # Returns: 1 + 0.5 * 4 = 3 and 0.5 * 3; 0 and 3; 0.5 * 1 and 1.
    returns = torch.tensor([[1.5, 3.0], [0.0, 3.0], [0.5, 1.0]]).unsqueeze(-1)
    torch.testing.assert_close(learnt["value_target"], returns, atol=1e-6, rtol=0)
    losses = agent.loss({key: value.flatten(0, 1) for key, value in learnt.items()})
    expected = -(batch["action_log_prob"].unsqueeze(-1) * (returns - batch["state_value"])).mean()
    torch.testing.assert_close(losses["loss_actor"], expected)


@pytest.mark.parametrize("again", [False, True])
def test_an_orthogonal_start_has_small_heads_and_no_biases(build_agent, again):
    agent = build_agent("ppo_published", [ct_su_b1()])
    before = agent.trunk.module.linear.weight.clone()
    if again:
        agent.reset_parameters()

    assert torch.equal(agent.trunk.module.linear.weight, before) is not again
    trunk = [layer for layer in agent.trunk.modules() if isinstance(layer, nn.Linear)]
    heads = [agent.actor.module[0].module, agent.critic.module]
    assert len(trunk) == 3
    for layer, size in [*((layer, 1.0) for layer in trunk), *((head, 1e-3) for head in heads)]:
        rows = layer.weight if len(layer.weight) <= layer.weight.shape[1] else layer.weight.T
        torch.testing.assert_close(rows @ rows.T, torch.eye(len(rows)) * size**2, atol=1e-5 * size**2, rtol=0)
        assert not layer.bias.any()
    with pytest.raises(ValueError, match="orthogonal_init must be true or false, got 1"):
        build_agent("ppo_published", [ct_su_b1()], "agent.orthogonal_init=1")


@pytest.mark.parametrize("name", POLICY_GRADIENTS)
def test_advantages_are_normalised_over_the_batch_where_configured(small_agent, name):
    agent = small_agent(name, [ct_su_b1()], "agent.normalize_advantage=true")

    advantage = agent.with_advantage(batches(agent, ct_su_b1(), 1)[0], agent.one_seed)["advantage"]

    assert advantage.mean().item() == pytest.approx(0, abs=1e-6)
    assert advantage.std(correction=0).item() == pytest.approx(1, abs=1e-4)


def test_one_step_of_one_row_is_normalised_to_zero(small_agent):
    agent = small_agent("a2c", [ct_su_b1()], "agent.normalize_advantage=true", "agent.num_envs=1", "agent.num_steps=1")

    agent.learn(batches(agent, ct_su_b1(), 1)[0])

    assert agent.with_advantage(batches(agent, ct_su_b1(), 1)[0], agent.one_seed)["advantage"].item() == 0


def test_lstm_ppo_learns_from_every_row_once_in_every_epoch(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()], "agent.num_epochs=3", "agent.num_minibatches=4")
    batch = batches(agent, ct_su_b1(), 1)[0]
    logged = batch["action_log_prob"].sum().item()

    seen = learnt_from(agent, batch)

    assert [tuple(minibatch["advantage"].shape[:-1]) for minibatch in seen] == [(4, 8)] * 12
    epochs = [sum(m["action_log_prob"].sum().item() for m in seen[i : i + 4]) for i in (0, 4, 8)]
    assert epochs == pytest.approx([logged] * 3, rel=1e-5)


def test_ppo_learns_from_every_frame_once_in_every_epoch(small_agent):
    agent = small_agent("ppo", [ct_su_b1()], "agent.num_epochs=3", "agent.num_minibatches=4")
    batch = batches(agent, ct_su_b1(), 1)[0]
    logged = batch["action_log_prob"].sum().item()

    seen = learnt_from(agent, batch)

    assert [tuple(minibatch["advantage"].shape[:-1]) for minibatch in seen] == [(32,)] * 12
    epochs = [sum(m["action_log_prob"].sum().item() for m in seen[i : i + 4]) for i in (0, 4, 8)]
    assert epochs == pytest.approx([logged] * 3, rel=1e-5)


@pytest.mark.parametrize("name", ["a2c", "reinforce"])
def test_a_batch_is_one_gradient_step(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])

    seen = learnt_from(agent, batches(agent, ct_su_b1(), 1)[0])

    assert [tuple(minibatch["advantage"].shape[:-1]) for minibatch in seen] == [(128,)]


def test_the_published_settings_of_ppo_can_be_expressed(build_agent):
    """Ben-Iwhiwhu et al. 2023 (TMLR): 4 workers of 128 steps, minibatches of 8, RMSprop, three layers of 200."""
    settings = {
        "num_envs": 4,
        "num_steps": 128,
        "hidden_size": 200,
        "num_layers": 3,
        "optimiser": "rmsprop",
        "learning_rate": 0.00015,
        "gae_lambda": 0.99,
        "normalize_advantage": "true",
        "clip_epsilon": 0.1,
        "entropy_coeff": 0.1,
        "num_epochs": 1,  # 8 there
        "num_minibatches": 64,
        "max_grad_norm": 5,
    }
    agent = build_agent("ppo", [ct_su_b1()], *(f"agent.{key}={value}" for key, value in settings.items()))

    seen = learnt_from(agent, batches(agent, ct_su_b1(), 1)[0])

    assert type(agent.optimiser) is torch.optim.RMSprop
    assert [tuple(minibatch["advantage"].shape[:-1]) for minibatch in seen] == [(8,)] * 64
    widths = [layer.weight.shape for layer in agent.trunk.modules() if isinstance(layer, torch.nn.Linear)]
    assert widths == [(200, 144), (200, 200), (200, 200)]


def test_equal_observations_share_a_count_and_different_ones_do_not():
    torch.manual_seed(0)
    counts = SimHashCounts(num_inputs=4, high=1, num_bits=16)
    observation = torch.eye(4, dtype=torch.uint8)[[0, 1, 0, 0]]

    assert counts(observation).tolist() == [3, 1, 3, 3]
    assert counts(observation[:2]).tolist() == [4, 2]


def test_the_bonus_falls_with_the_root_of_the_count_and_is_paid_on_top_of_the_reward(small_agent):
    agent = small_agent("ppo_count", [ct_su_b1()], "agent.bonus_coeff=0.5", "agent.num_envs=1", "agent.num_steps=4")
    agent.num_minibatches = 1
    batch = batches(agent, ct_su_b1(), 1)[0]
    batch["next", "observation"] = batch["observation"][:, :1].expand(1, 4, 1, 12, 12).clone()
    batch["next", "reward"] = torch.tensor([[[0.0], [0.0], [1.0], [0.0]]])

    first, second = agent.reward(batch), agent.reward(batch)

    assert first.flatten().tolist() == pytest.approx([0.25, 0.25, 1.25, 0.25])
    assert second.flatten().tolist() == pytest.approx([0.5 / 8**0.5] * 2 + [1 + 0.5 / 8**0.5, 0.5 / 8**0.5])


def test_counts_start_anew_with_a_task_and_are_saved(small_agent):
    agent, other = (small_agent("ppo_count", [ct_su_b1()]) for _ in range(2))
    agent.learn(batches(agent, ct_su_b1(), 1)[0])

    other.load_state_dict(agent.state_dict())
    agent.start_task(0)

    assert (agent.seen.counts.sum().item(), other.seen.counts.sum().item()) == (0, 128)


def test_observations_on_either_side_of_the_middle_of_their_range_differ_in_sign():
    counts = SimHashCounts(1, 255, 1)
    counts.projection.fill_(1.0)

    assert counts(torch.tensor([[127]], dtype=torch.uint8)).tolist() == [1]
    assert counts(torch.tensor([[128]], dtype=torch.uint8)).tolist() == [1]
