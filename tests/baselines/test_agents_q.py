"""Agents that learn action values: exploration, replay, targets, priorities."""

from __future__ import annotations

import pytest
import torch
from helpers.small_agents import GREEDY, ONE_HOT_TASK, Q_LEARNERS, SAMPLED, batches, parameters_equal, saved_and_loaded
from tensordict import TensorDict
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import set_recurrent_mode

from baselines.parts.prioritized import PrioritySampler
from baselines.parts.recurrent_q import RecurrentQ
from baselines.qrdqn_lstm import QRDQNLSTM
from ctgraph_rl import CTGraphEnv, evaluate
from ctgraph_rl.core.dynamics import OUTCOME_GOAL
from ctgraph_rl.learn.collect import collect
from curricula.paper import ct_su_b1


@pytest.mark.parametrize("name", Q_LEARNERS)
def test_a_greedy_agent_takes_the_action_of_highest_value_and_does_not_explore(small_agent, name):
    agent = small_agent(name, [ct_su_b1()], "agent.eps_init=1")
    data = CTGraphEnv([ct_su_b1()] * 200).reset().update(agent.initial_state(200))

    with set_exploration_type(GREEDY):
        greedy = agent.policy(data.clone())["action"]
    with set_exploration_type(SAMPLED):
        sampled = agent.policy(data.clone())["action"]

    best = agent.greedy(data.clone())["action_value"].argmax(dim=-1)
    assert torch.equal(greedy, best)
    assert set(sampled.tolist()) == {0, 1, 2}


def test_dqn_evaluated_greedily_plays_every_episode_alike_where_nothing_is_random(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.eps_init=1")

    greedy, sampled = (evaluate(agent.policy, [ct_su_b1()], 500, greedy=choice) for choice in (True, False))

    assert greedy["step_count"].unique().numel() == 1
    assert sampled["step_count"].unique().numel() > 1
    assert not (greedy["outcome"] == OUTCOME_GOAL).all()


@pytest.mark.parametrize(("name", "items"), [("dqn", 128), ("drqn", 16), ("qrdqn_lstm", 16)])
@pytest.mark.parametrize("setting", ["clear", "keep"])
def test_replay_is_cleared_or_kept_at_a_task_change(small_agent, name, items, setting):
    agent = small_agent(name, [ct_su_b1()], f"agent.replay_on_task_change={setting}")
    agent.start_task()
    agent.learn(batches(agent, ct_su_b1(), 1)[0])
    stored = len(agent.replay)

    agent.end_task()
    agent.start_task()

    assert (stored, len(agent.replay)) == (items, items if setting == "keep" else 0)


def test_dqn_explores_less_with_every_batch_and_anew_in_every_task(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.annealing_num_steps=512", "agent.eps_end=0.2")
    agent.start_task()

    explored = [agent.learn(batch)["exploration"] for batch in batches(agent, ct_su_b1(), 6)]
    agent.start_task()

    assert explored == pytest.approx([0.8, 0.6, 0.4, 0.2, 0.2, 0.2])
    assert agent.exploration.eps.item() == 1.0


def test_dqn_copies_to_its_target_network_once_in_every_interval_of_gradient_steps(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.target_update_interval=4", "agent.num_updates=12")
    step, targets = agent.gradient_step, []

    def target_network():
        return torch.nn.utils.parameters_to_vector(agent.target.parameters()).clone()

    agent.gradient_step = lambda batch: (targets.append(target_network()), step(batch))[1]
    agent.learn(batches(agent, ct_su_b1(), 1)[0])
    targets.append(target_network())

    changed = [i for i in range(1, 13) if not (targets[i] == targets[i - 1]).all()]
    assert changed == [4, 8, 12]


def test_dqn_targets_near_the_end_of_an_episode_are_its_rewards_and_nothing_after_it(small_agent):
    """From two steps before a terminal state, a target of six steps is the discounted reward; no value is added."""
    agent = small_agent("dqn", [ONE_HOT_TASK], "agent.num_steps=4", "agent.gamma=0.5", "agent.n_steps=6")
    env = CTGraphEnv([ONE_HOT_TASK] * 16)

    def solve(data):
        return data.set("action", 3 * data["observation"][..., 2].long())

    agent.learn(next(collect(env, solve, 64, 4)))

    stored = agent.replay[:].view(16, 4)[0]
    assert stored["next", "reward"].flatten().tolist() == [0.125, 0.25, 0.5, 1.0]
    assert stored["steps_to_next_obs"].flatten().tolist() == [4, 3, 2, 1]
    assert stored["next", "terminated"].flatten().tolist() == [True] * 4


def test_dqn_targets_of_one_step_are_the_transitions_themselves(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.n_steps=1")
    batch = batches(agent, ct_su_b1(), 1)[0]

    agent.learn(batch)

    stored, flat = agent.replay[:], batch.reshape(-1)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "terminated")):
        assert torch.equal(stored[key], flat[key])


# Priorities


def test_items_are_drawn_in_proportion_to_priorities_and_weighed_against_it():
    torch.manual_seed(0)
    sampler = PrioritySampler(num_items=4, alpha=0.5, beta=0.5)
    sampler.extend(torch.arange(3))
    sampler.update_priority(torch.arange(3), torch.tensor([1.0, 4.0, 25.0]))

    index, info = sampler.sample(range(3), 80_000)

    # Chances 1 : 2 : 5; weights chance^-0.5 relative to the least.
    assert index.bincount(minlength=4).tolist() == pytest.approx([10_000, 20_000, 50_000, 0], abs=600)
    expected = torch.tensor([1.0, 2.0, 5.0])[index] ** -0.5
    torch.testing.assert_close(info["priority_weight"], expected)


def test_a_new_item_has_the_largest_priority_so_far():
    sampler = PrioritySampler(num_items=4, alpha=1, beta=1)
    sampler.extend(torch.tensor([0, 1]))
    sampler.update_priority(torch.tensor([0, 1]), torch.tensor([0.5, 7.0]))

    sampler.extend(torch.tensor([2]))

    assert sampler.priorities.tolist() == [0.5, 7, 7, 0]


def test_dqn_with_priorities_remembers_errors_and_weighs_its_loss(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.priority_alpha=0.6", "agent.num_updates=1", "agent.batch_size=64")
    agent.learn(batches(agent, ct_su_b1(), 1)[0])

    sample = agent.replay.sample()
    losses = agent.loss(sample)

    kept = agent.replay.sampler.priorities[:128]
    assert ((kept != 1).sum() > 20) and (kept > 0).all()
    weighed = sample["priority_weight"] * losses["td_error"]
    torch.testing.assert_close(losses["loss_value"], weighed.sum() / sample["priority_weight"].sum())


def test_a_priority_is_the_size_of_an_error_and_not_its_square(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.priority_alpha=0.6", "agent.num_updates=1", "agent.batch_size=64")
    agent.learn(batches(agent, ct_su_b1(), 1)[0])

    agent.replayed = torch.tensor([3, 5])
    agent.after_update({"loss_value": torch.tensor(1.0), "td_error": torch.tensor([9.0, 0.25])})

    assert agent.replay.sampler.priorities[[3, 5]].tolist() == pytest.approx([3, 0.5], abs=1e-6)


def test_dqn_with_priorities_goes_on_as_if_never_stopped(small_agent):
    agent, other = (small_agent("dqn", [ct_su_b1()], "agent.priority_alpha=0.6", f"seed={i}") for i in (0, 1))
    first, second = batches(agent, ct_su_b1(), 2)
    agent.learn(first)

    other.load_state_dict(saved_and_loaded(agent.state_dict()))
    found = []
    for one in (agent, other):
        torch.manual_seed(4)
        found.append(one.learn(second))

    assert found[0] == found[1]
    assert parameters_equal(agent, other)


# Sequences


def over_sequences(agent, items):
    """Action values over whole sequences."""
    with set_recurrent_mode(True), torch.no_grad():
        return agent.greedy(items.select(*agent.trunk.in_keys))["action_value"]


@pytest.mark.parametrize("name", ["drqn", "qrdqn_lstm"])
def test_values_over_a_replayed_sequence_are_those_while_acting(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    first, second = batches(agent, ct_su_b1(), 2)
    items = agent.experience(agent.multi_step(second))

    acting = [agent.greedy(second[:, t].select(*agent.trunk.in_keys))["action_value"] for t in range(8)]
    found = over_sequences(agent, items)

    assert second["is_init"][:, 1:].any() and not second["is_init"][:, 0].all()
    assert items.batch_size == (16, 9)
    torch.testing.assert_close(found[:, :8], torch.stack(acting, dim=1), atol=1e-6, rtol=0)
    before = over_sequences(agent, agent.experience(agent.multi_step(first)))[:, 8]
    goes_on = ~first["next", "done"][:, -1, 0]
    torch.testing.assert_close(before[goes_on], acting[0][goes_on], atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", ["drqn", "qrdqn_lstm"])
def test_nothing_is_remembered_from_one_episode_to_the_next_in_a_sequence(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    items = agent.experience(agent.multi_step(batches(agent, ct_su_b1(), 1)[0]))
    changed = items.clone()
    changed["observation"][:, 0] = 255 - changed["observation"][:, 0]

    difference = (over_sequences(agent, items) - over_sequences(agent, changed)).abs().amax(dim=-1)

    same_episode = items["is_init"][..., 0].cumsum(dim=1) == 1
    assert (difference[same_episode] > 0).all()
    assert (difference[~same_episode] == 0).all()


def test_recurrent_targets_are_those_by_hand(small_agent, monkeypatch):
    agent = small_agent("drqn", [ct_su_b1()])
    online = torch.tensor([[[1.0, 0.0], [0.0, 2.0], [5.0, 4.0], [0.0, 1.0]]]).unsqueeze(-1)
    later = torch.tensor([[[9.0, 9.0], [9.0, 9.0], [6.0, 9.0], [9.0, 8.0]]]).unsqueeze(-1)
    for parameter in agent.target.parameters():
        parameter.zero_()
    head = agent.greedy.module[0].module[1].module
    monkeypatch.setattr(RecurrentQ, "quantiles", lambda self, batch: online if head.linear.weight.any() else later)
    given = []
    distance = agent.distance
    monkeypatch.setattr(agent, "distance", lambda *each: given.append(each) or distance(*each))
    batch = TensorDict(
        {
            "action": torch.tensor([[0, 1, 0, 0]]),
            "steps_to_next_obs": torch.tensor([[2, 1, 1, 0]]),
            "gamma": torch.tensor([[0.25, 0.5, 0.5, 0.0]]),
            "learnt": torch.tensor([[True, True, True, False]]),
            "next": {
                "reward": torch.tensor([[0.5, 1.0, 0.0, 7.0]]).unsqueeze(-1),
                "terminated": torch.tensor([[False, True, False, False]]).unsqueeze(-1),
            },
        },
        batch_size=[1, 4],
    )

    loss = agent.loss(batch)["loss_value"].item()

    [(predicted, target)] = given
    # Two steps on, action 0 is the online network's best: 0.5 + 0.25 * 6. An end: 1. One step on, action 1: 0.5 * 8.
    assert predicted.flatten().tolist() == [1, 2, 5, 0]
    assert target.flatten().tolist()[:3] == [2, 1, 4]
    assert loss == pytest.approx((1 + 1 + 1) / 3)


@pytest.mark.parametrize("name", ["dqn", "drqn", "qrdqn_lstm", "mohqa", "pearl"])
def test_targets_are_of_the_weights_that_a_loss_is_given(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    [batch] = batches(agent, ct_su_b1(), 1)
    minibatch = next(agent.minibatches(batch))
    before = agent.loss(minibatch)["loss_value"]

    given = agent.losses(agent.weights, minibatch, {key: 2 * value for key, value in agent.other_weights().items()})
    for value in agent.other_weights().values():
        value.data.mul_(2)

    assert given["loss_value"] == agent.loss(minibatch)["loss_value"] != before


def test_a_step_before_a_truncation_is_not_learned_from_and_one_before_a_terminal_state_is(small_agent):
    agent = small_agent("drqn", [ct_su_b1()], "agent.n_steps=2")
    batch = batches(agent, ct_su_b1(), 1)[0]
    batch["next", "done"] = torch.zeros_like(batch["next", "done"])
    batch["next", "done"][:2, 4] = True
    batch["next", "terminated"] = batch["next", "done"].clone()
    batch["next", "terminated"][0] = False

    learnt = agent.experience(agent.multi_step(batch))["learnt"]

    assert learnt[0].tolist() == [True, True, True, False, False, True, True, True, False]
    assert learnt[1].tolist() == [True] * 8 + [False]


def test_a_shortened_batch_is_filled_up_and_only_its_steps_are_learned_from(small_agent):
    agent = small_agent("drqn", [ct_su_b1()])
    batch = batches(agent, ct_su_b1(), 1)[0][:, :3]

    items = agent.experience(agent.multi_step(batch))
    other = items.clone()
    other["next", "reward"][:, 3:] = 100.0

    assert items.batch_size == (16, 9)
    assert items["learnt"].sum(dim=1).tolist() == [3] * 16
    assert agent.loss(items)["loss_value"] == agent.loss(other)["loss_value"]


def test_the_loss_of_quantiles_is_the_quantile_huber_loss_by_hand():
    agent = QRDQNLSTM.__new__(QRDQNLSTM)

    loss = QRDQNLSTM.distance(agent, torch.tensor([[[0.0, 1.0]]]), torch.tensor([[[3.0, 1.0]]]))
    mirrored = QRDQNLSTM.distance(agent, torch.tensor([[[-1.0, 0.0]]]), torch.tensor([[[-1.0, -3.0]]]))

    # Fractions 1/4 and 3/4; errors 3 and 1 of the first quantile, 2 and 0 of the second: Huber 2.5, 0.5, 1.5, 0.
    assert loss.item() == pytest.approx(0.25 * (2.5 + 0.5) / 2 + 0.75 * 1.5 / 2)
    assert mirrored.item() == pytest.approx(loss.item())
