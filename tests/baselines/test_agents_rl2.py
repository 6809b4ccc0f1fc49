"""RL^2: what a trial is, what is remembered through it, and that searching is learned."""

from __future__ import annotations

import pytest
import torch
from helpers.small_agents import GREEDY, TWO_GOALS, batches
from torchrl.envs.utils import set_exploration_type

from ctgraph_rl import Block, CTGraphEnv, Curriculum, RunLog, evaluate, learn_curriculum
from ctgraph_rl.learn.evaluate import Evaluator
from ctgraph_rl.tasks.curriculum import Evaluation
from curricula.paper import ct_su_b1


def small_rl2(small_agent, *overrides):
    return small_agent("rl2", [ct_su_b1()], "agent.trial_episodes=2", *overrides)


def over_sequences(agent, batch):
    """What the LSTM writes over whole sequences."""
    with torch.no_grad():
        return agent.trunk.over_time(batch)


def trial_starts(batch):
    """Where the episode that begins is the first of its trial."""
    return (batch["is_init"] & (batch["next", "trial"] == 1)).squeeze(-1)


def test_the_episodes_of_a_trial_are_counted_and_the_count_starts_anew(small_agent):
    agent = small_rl2(small_agent)
    batch = torch.cat(batches(agent, ct_su_b1(), 4), dim=1)

    begun = batch["is_init"].squeeze(-1).cumsum(dim=1)

    assert begun.max() >= 5
    assert torch.equal(batch["next", "trial"].squeeze(-1), 1 + (begun - 1) % 2)


def test_memory_lasts_over_the_episodes_of_a_trial_and_not_from_one_trial_to_the_next(small_agent):
    agent = small_rl2(small_agent)
    batch = torch.cat(batches(agent, ct_su_b1(), 3), dim=1)
    changed = batch.clone()
    changed["observation"][:, 0] = 255 - changed["observation"][:, 0]

    difference = (over_sequences(agent, batch) - over_sequences(agent, changed)).abs().amax(dim=-1)

    same_trial = trial_starts(batch).cumsum(dim=1) == 1
    assert (batch["is_init"].squeeze(-1) & same_trial)[:, 1:].any()
    assert (difference[same_trial] > 0).all()
    assert (difference[~same_trial] == 0).all()


def test_values_over_a_sequence_are_those_while_acting(small_agent):
    agent = small_rl2(small_agent)
    for batch in batches(agent, ct_su_b1(), 3):
        values = agent.critic.module(over_sequences(agent, batch))

        torch.testing.assert_close(values, batch["state_value"], atol=1e-6, rtol=0)


@pytest.mark.parametrize("key", ["reward", "previous_action"])
def test_the_last_action_and_reward_are_read_within_a_trial_and_forgotten_after_it(small_agent, key):
    agent = small_rl2(small_agent)
    data = CTGraphEnv([ct_su_b1()] * 3).reset().update(agent.initial_state(3))
    data["trial"] = torch.tensor([[0], [1], [2]])
    other = data.clone()
    other[key] = other[key] + 1

    with torch.no_grad(), set_exploration_type(GREEDY):
        value, changed = (agent.policy(one)["state_value"].flatten() for one in (data, other))

    assert (value == changed).tolist() == [True, False, True]


def test_what_follows_is_told_the_action_that_was_taken_and_the_reward(small_agent):
    agent = small_rl2(small_agent)
    batch = torch.cat(batches(agent, ct_su_b1(), 2), dim=1)

    assert torch.equal(batch["previous_action"][:, 1:], batch["action"][:, :-1])
    assert torch.equal(batch["reward"][:, 1:], batch["next", "reward"][:, :-1])


def test_the_return_goes_on_over_the_episodes_of_a_trial_and_ends_with_it(small_agent):
    hand = [
        "agent.num_envs=2",
        "agent.num_steps=4",
        "agent.gamma=0.5",
        "agent.gae_lambda=1.0",
        "agent.num_minibatches=1",
    ]
    agent = small_rl2(small_agent, *hand)
    batch = batches(agent, ct_su_b1(), 1)[0]
    batch["state_value"] = torch.tensor([1.0, 2.0, 3.0, 4.0]).expand(2, 4).unsqueeze(-1).clone()
    batch["next", "reward"] = torch.tensor([0.0, 1.0, 0.0, 9.0]).expand(2, 4).unsqueeze(-1).clone()
    batch["next", "done"] = torch.tensor([False, True, False, False]).expand(2, 4).unsqueeze(-1).clone()
    batch["next", "trial"] = torch.tensor([[1, 1, 2, 2], [2, 2, 1, 1]]).unsqueeze(-1)

    learnt = agent.with_advantage(batch, agent.one_seed)

    # The value after the third step is 4. Going on: 0.5 * 4 = 2, then 1 + 0.5 * 2, then 0.5 * 2.
    # Where the trial ended after the second step: 2, then 1, then 0.5.
    assert learnt["value_target"].squeeze(-1).tolist() == [[1.0, 2.0, 2.0], [0.5, 1.0, 2.0]]


def test_an_evaluation_with_episodes_to_adapt_in_keeps_the_memory_of_a_trial(small_agent):
    agent = small_rl2(small_agent)
    how = Evaluation(4, greedy=False, adapt_episodes=1)
    curriculum = Curriculum("one", 1, "here", [Block(ct_su_b1(), 16)], evaluation=how)
    seen = []

    def act(data):
        seen.append(agent.policy(data).clone())
        return seen[-1]

    Evaluator(curriculum, 0, RunLog()).evaluate(act, 0, "before", agent.initial_state)

    played = torch.stack(seen, dim=1)
    values = agent.critic.module(over_sequences(agent, played))
    assert (played["is_init"] & (played["next", "trial"] == 2)).any(dim=1).all()
    torch.testing.assert_close(values, played["state_value"], atol=1e-6, rtol=0)


def test_one_step_teaches_nothing_and_is_no_error(small_agent):
    agent = small_rl2(small_agent)
    before = [parameter.clone() for parameter in agent.parameters()]

    agent.learn(batches(agent, ct_su_b1(), 1)[0][:, :1])

    assert all(torch.equal(*pair) for pair in zip(before, agent.parameters(), strict=True))


@pytest.mark.slow
def test_rl2_searches_like_the_best_policy_and_returns_to_what_it_found(build_agent):
    agent = build_agent("rl2", [TWO_GOALS])
    played = Evaluation(num_episodes=40, episodes_per_row=40)
    learn_curriculum(Curriculum("two_goals", 1, "theory", [Block(TWO_GOALS, 299_008)], evaluation=played), agent)

    ends = evaluate(agent.policy, [TWO_GOALS], 4000, seed=1, initial_state=agent.initial_state, episodes_per_row=40)

    reached = (ends["outcome"] == 3).view(100, 10, 4)
    later_trials = 1 + reached[:, 1:].int().argmax(dim=-1).double()  # the first goal is always the same
    success = reached.double().mean(dim=(0, 1))
    assert TWO_GOALS.graph.expected_search_episodes == 1.5
    assert later_trials.mean().item() == pytest.approx(1.5, abs=0.08)
    assert success[1:].tolist() == [1.0, 1.0, 1.0]
