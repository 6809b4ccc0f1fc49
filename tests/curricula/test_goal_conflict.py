"""Goals that conflict: each run's seed draws two that disagree at every decision, on one image set."""

from __future__ import annotations

from itertools import pairwise

import pytest

import curricula


@pytest.mark.parametrize("seed", range(8))
def test_the_goals_of_goal_conflict_disagree_at_every_decision_on_the_same_images(seed):
    first, second = curricula.load("goal_conflict").for_seed(seed).tasks

    assert [a + b for a, b in zip(first.goal, second.goal, strict=True)] == [3, 3, 3]
    assert first.images == second.images


def test_seeds_draw_different_images_and_all_goals():
    life = curricula.load("goal_conflict")
    drawn = [life.for_seed(seed).tasks[0] for seed in range(40)]

    assert len({task.images for task in drawn}) == 40
    assert len({task.goal for task in drawn}) == 8


def test_with_three_branches_a_conflicting_goal_is_any_that_shares_no_decision():
    tasks = curricula.load("stream", order="conflicting", branching_factor=3, num_tasks=200).tasks

    for first, second in pairwise(tasks):
        assert not any(a == b for a, b in zip(first.goal, second.goal, strict=True))
    assert len({(*a.goal, *b.goal) for a, b in pairwise(tasks)}) == 9 * 4


def test_evaluations_of_goal_conflict_are_exact_and_of_sampled_actions():
    how = curricula.load("goal_conflict").evaluation

    assert (how.exact, how.greedy, how.every) == (True, False, 2048)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"goals": ["1.1", "1.2"]}, "order=conflicting needs goals that differ in every decision: give goals=all"),
        ({"goals": ["1.1"]}, "order=conflicting needs goals that differ in every decision"),
    ],
)
def test_goals_that_cannot_conflict_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        curricula.load("stream", order="conflicting", **settings)
