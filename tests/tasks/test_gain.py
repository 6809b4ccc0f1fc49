"""Reward per frame, and what simple policies lose."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ctgraph_rl import evaluate
from ctgraph_rl.core.rewards import Gradient
from ctgraph_rl.policies import RandomPolicy, SearchPolicy
from ctgraph_rl.tasks.configurations import ct_fo_b1, ct_su_b1
from ctgraph_rl.tasks.gain import optimal_gain, reached_by_policies


@pytest.mark.parametrize("wait_prob", [0.0, 0.5])
@pytest.mark.parametrize("depth", [1, 3])
def test_a_needles_largest_gain_is_its_reward_over_the_shortest_episode(depth, wait_prob):
    task = ct_su_b1(goal="1.1")
    task = replace(
        task, graph=replace(task.graph, depth=depth, wait_prob=wait_prob), goal=(1,) * depth, goal_reward=3.0
    )

    assert optimal_gain(task) == pytest.approx(3 / task.graph.expected_episode_length, abs=1e-12)


def test_where_failing_at_once_pays_most_per_frame_the_largest_gain_is_that_of_failing():
    task = replace(ct_fo_b1(), fail_reward=0.6)  # 0.6 in 2 steps, against 1 in 6

    assert task.optimal_value(1.0) == 1.0
    assert optimal_gain(task) == pytest.approx(0.3, abs=1e-12)


def test_a_reward_of_every_step_adds_to_the_largest_gain():
    assert optimal_gain(replace(ct_fo_b1(), step_reward=-0.5)) == pytest.approx(1 / 6 - 0.5, abs=1e-12)


def test_what_policies_reach_and_lose_in_a_block_by_hand():
    found = reached_by_policies(ct_fo_b1(), num_frames=6 * 10)  # four goals, ten optimal episodes

    assert found["optimal"] == (1.0, 0.0, 0.0)
    assert found["memoryless"] == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)  # all is observed
    assert found["search"] == pytest.approx((1.0, 1.5, 1.5))  # 3/4 + 2/4 + 1/4
    assert reached_by_policies(ct_fo_b1(), num_frames=12)["search"] == pytest.approx((0.5, 1.25, 1.25))
    hidden = reached_by_policies(ct_fo_b1(), num_frames=14, pause=1)  # again two episodes
    assert hidden["search"] == pytest.approx((0.5, 1.25, 1.25))
    assert hidden["memoryless"] == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)


def test_the_random_policy_loses_what_it_is_measured_to_lose():
    task = ct_fo_b1()
    played = evaluate(RandomPolicy, [task], 4000, seed=3)
    value = played["episode_reward"].double().mean().item()
    length = played["step_count"].double().mean().item()

    at_end, in_episodes, in_frames = reached_by_policies(task, 1000)["random"]

    assert at_end == pytest.approx(value, abs=0.003)  # standard error 0.001
    assert in_episodes == pytest.approx(1000 / length * (1 - value), rel=0.04)  # standard error 1%
    assert in_frames == pytest.approx(1000 * (1 / 6 - value / length), rel=0.04)


def test_a_search_fails_as_often_as_it_is_measured_to():
    task = ct_fo_b1()
    played = evaluate(SearchPolicy, [task], 2000, seed=3, episodes_per_row=5)

    failures = 5 - 5 * played["episode_reward"].double().mean().item()

    assert reached_by_policies(task, 5 * 6)["search"].in_episodes == 1.5
    assert failures == pytest.approx(1.5, abs=0.2)  # standard error 0.06


def test_rewards_without_closed_forms_have_no_lines_of_search_and_memoryless_policies():
    found = reached_by_policies(replace(ct_fo_b1(), reward_fn=Gradient()), 100)

    assert {*found} == {"optimal", "random"}
