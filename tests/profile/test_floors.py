"""Floors: no policy that counts steps has more, and a search at random finds goals as the closed form says."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import pytest
import torch

from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.policies import RandomPolicy
from ctgraph_rl.profile.floors import best_without_memory, counting_ceiling, found_share
from ctgraph_rl.tasks.configurations import ct_fo_b1, ct_graph, ct_posr_b1
from ctgraph_rl.tasks.values import memoryless_ceiling, open_loop_ceiling


def success_by_step(goal, decisions, wait_prob):
    """Add up all times of decisions, as long as they are less than the length of ``decisions``."""

    def from_level(level, first):
        if level == len(goal):
            return 1.0
        total = 0.0
        for step in range(first, len(decisions)):
            if decisions[step] == goal[level]:
                waits = wait_prob ** (step - first) * (1 - wait_prob)
                total += waits * from_level(level + 1, step + 2)
        return total

    return from_level(0, 2)


@pytest.mark.parametrize("goal", [(1, 2), (1, 2, 1)])
def test_no_decisions_by_step_have_more_than_the_ceiling(goal):
    best = 0.0
    for middle in product((1, 2), repeat=8):
        best = max(best, success_by_step(goal, (0, 0, *middle, *goal[-1:] * 10), 0.5))

    assert counting_ceiling(ct_graph(2, len(goal), 0.5, goal, fully_observable=False)) == pytest.approx(best, abs=2e-3)


def test_counting_steps_is_worth_more_than_the_other_floors():
    task = ct_posr_b1(goal=(1, 2))

    assert (memoryless_ceiling(task), open_loop_ceiling(task), best_without_memory(task)) == (0.25, 0.25, 0.75)


def test_without_shared_images_nothing_need_be_remembered():
    assert best_without_memory(ct_fo_b1(goal=(1, 2))) == 1


def test_a_goal_that_pays_otherwise_is_refused():
    with pytest.raises(ValueError, match="a goal that pays 1 and no other reward"):
        counting_ceiling(replace(ct_posr_b1(goal=(1, 2)), fail_reward=-1.0))


@pytest.mark.slow
def test_random_search_finds_a_goal_in_time_with_the_probability_of_the_floor():
    task = ct_graph(2, 3)
    steps = 4000
    env = CTGraphEnv([task] * 500, 0)
    torch.manual_seed(0)
    rewarded = env.rollout(steps, RandomPolicy(env), break_when_any_done=False)["next", "reward"].amax(1) > 0

    expected = found_share(task, steps)

    assert 0.4 < expected < 0.8
    assert rewarded.double().mean().item() == pytest.approx(expected, abs=4 * math.sqrt(0.25 / 500))
