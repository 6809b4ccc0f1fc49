"""No agent scores without the property: each floor's own policy has 0, each cheat at most 0.05, and 1 can be had."""

from __future__ import annotations

import math
from statistics import fmean

import numpy as np
import pytest
from helpers.profiles import (
    LATE,
    ByStep,
    Constant,
    EachEndOnce,
    Memoryless,
    OneBranch,
    OnePath,
    RandomAtNewImages,
    SequenceByImage,
    life,
    score_of_learner,
    score_of_policy,
)

import curricula
from ctgraph_rl.policies import OptimalPolicy, RandomPolicy, SearchPolicy
from ctgraph_rl.profile.floors import found_share
from ctgraph_rl.profile.properties import Measured, measure
from ctgraph_rl.profile.scoring import score_of
from ctgraph_rl.tasks.values import random_frames_to_goal
from curricula.profile import PROPERTIES

LEARNED = ("profile_similarity", "profile_hierarchy", "profile_innate")
"""Properties that lives are compared for."""

OF_POLICIES = (
    *(("profile_observability", policy) for policy in (Constant, OneBranch, SequenceByImage, Memoryless, RandomPolicy)),
    *(("profile_memory", policy) for policy in (Constant, OneBranch, SequenceByImage, Memoryless, RandomPolicy)),
    *(("profile_sparsity", policy) for policy in (Constant, OneBranch, RandomPolicy)),
    *(("profile_attention", policy) for policy in (Constant, OneBranch, SequenceByImage, RandomAtNewImages)),
    *(("profile_exploration", policy) for policy in (OnePath, EachEndOnce, RandomPolicy)),
)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "policy"), OF_POLICIES)
def test_a_policy_without_the_property_scores_0_over_ten_seeds(name, policy):
    assert score_of_policy(name, policy).value <= 0.05


@pytest.mark.parametrize(
    ("name", "policy"), [("profile_memory", SequenceByImage), ("profile_exploration", EachEndOnce)]
)
def test_a_policy_without_the_property_scores_0(name, policy):
    assert score_of_policy(name, policy, num_seeds=2).value <= 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", ["profile_observability", "profile_memory"])
def test_the_policy_of_a_floor_scores_0_within_its_interval(name):
    score = score_of_policy(name, ByStep, num_episodes=1000)

    assert score.measured == pytest.approx(score.floor, abs=0.02)
    assert score.low == 0
    assert score.value <= 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["profile_observability", "profile_memory", "profile_sparsity", "profile_attention", "profile_exploration"]
)
def test_the_policy_of_an_optimum_scores_1(name):
    searches = name == "profile_exploration"

    score = score_of_policy(name, SearchPolicy if searches else OptimalPolicy, 400 if searches else 8)

    assert score.value >= 0.95
    assert score.absolute.endswith(f"optimum {0.62 if searches else 1:.2f}")


class OneSequence(OptimalPolicy):
    """The decisions to the first goal of each depth, which it knows from the first image."""

    def decision(self, tensordict):
        leaves = {}
        for task in self.env.tasks:
            leaves.setdefault(task.graph.depth, task.goal_leaf)
        own = [leaves[task.graph.depth] for task in self.env.tasks]
        return self._towards(self.env.goal_leaf.new_tensor(own))


@pytest.mark.slow
def test_a_sequence_that_reaches_a_goal_of_each_depth_scores_0_in_sparsity():
    assert score_of_policy("profile_sparsity", OneSequence).value == 0


def test_a_search_that_takes_the_mirrored_goal_for_the_next_one_scores_less_than_a_twentieth_in_sparsity():
    """It finds the first goal of a depth by chance, and the second one with it."""
    curriculum = curricula.load("profile_sparsity")
    shares = [found_share(task, curriculum.blocks[0].num_frames) for task in curriculum.tasks[::2]]
    floor = fmean(share**2 for share in shares)

    assert 0 < (fmean(shares) - floor) / (1 - floor) <= 0.05


# learners, whose lives are made


def fast(curriculum, block, task):
    return 1


def idle(num_frames):
    """A learner that takes two evaluations for a task, but for the first frames of its life."""

    def learner(curriculum, block, task):
        start = curriculum.ends[block] - curriculum.blocks[block].num_frames
        lost = max(0, num_frames - start) // (curriculum.evaluation.every or 1)
        return 2 + lost

    return learner


def slow_where_images_are_new(curriculum, block, task):
    """A learner that does nothing for 30,000 frames after images that it has not seen."""
    images = {task.images for task in curriculum.blocks[block].tasks}
    seen = {task.images for before in curriculum.blocks[:block] for task in before.tasks}
    return 2 if images <= seen else 2 + 30_000 // curriculum.evaluation.every


def bad_after_dissimilar_goals(curriculum, block, task):
    return LATE if curriculum.name == "profile_dissimilar" else 5


def of_first_branch(curriculum, block, task):
    return 1 if set(curriculum.tasks[task].goal) == {1} else LATE


@pytest.mark.parametrize("name", LEARNED)
@pytest.mark.parametrize("cheat", [idle(30_000), idle(80_000), slow_where_images_are_new, bad_after_dissimilar_goals])
def test_a_learner_that_is_slow_in_a_control_alone_scores_0(name, cheat):
    assert score_of_learner(name, cheat).value <= 0.05


@pytest.mark.parametrize("name", LEARNED)
def test_a_learner_of_one_branch_scores_0(name):
    assert score_of_learner(name, of_first_branch).value == 0


@pytest.mark.parametrize("num_frames", [40_960, 100_000, 300_000])
def test_an_idle_start_gives_no_speed_of_adaptation(num_frames):
    def with_idle_start(curriculum, block, task):
        return 3 + idle(num_frames)(curriculum, block, task)

    assert score_of_learner("profile_adaptation", with_idle_start).value == 0


@pytest.mark.parametrize("learner", [of_first_branch, lambda *life: 5])
def test_a_learner_that_is_no_faster_than_a_search_at_random_does_not_adapt(learner):
    assert score_of_learner("profile_adaptation", learner).value <= 0.05


@pytest.mark.parametrize("name", LEARNED)
def test_a_learner_that_solves_one_of_two_goals_scores_0(name):
    def learner(curriculum, block, task):
        return 1 if curriculum.name == name and curriculum.tasks[task].goal == (1, 2) else LATE

    assert score_of_learner(name, learner).value == 0


@pytest.mark.parametrize("name", LEARNED)
def test_a_learner_that_only_what_came_before_lets_solve_the_last_block_scores_1(name):
    def learner(curriculum, block, task):
        return 1 if curriculum.name == name else LATE

    assert score_of_learner(name, learner).value >= 0.95


def test_a_learner_that_finds_each_goal_at_once_adapts_fully():
    assert score_of_learner("profile_adaptation", fast).value >= 0.95


@pytest.mark.parametrize("name", LEARNED)
def test_a_control_that_is_solved_at_once_leaves_a_gap(name):
    score = score_of_learner(name, fast)

    assert score.value is None and score.reason.endswith("leaves no room")


@pytest.mark.parametrize("name", LEARNED)
def test_a_seed_without_room_counts_against_the_score(name):
    prop = PROPERTIES[name]

    def scored(seeds):
        results = []
        for own, other in seeds:
            controls = [life(control, lambda *life, other=other: other) for control in prop.controls]
            results.append(measure(life(name, lambda *life, own=own: own), controls, prop))
        return score_of(results, prop.controls)

    assert scored([(1, 7)]).value == 1
    assert scored([(1, 7), (4, 1)]).value == pytest.approx((6 / 12 - 3 / 12) / (6 / 12))


MOMENTS = np.arange(1, 13)
"""Evaluations of the last block of a life."""


def areas_of_a_search(rng, num_lives):
    """Areas of lives in which the time to each of two goals is drawn again for each block, in evaluations."""
    needed = rng.exponential(5, (num_lives, 2)).max(1)
    return (needed[:, None] <= MOMENTS).mean(1)


@pytest.mark.parametrize("name", LEARNED)
def test_a_search_without_transfer_scores_0(name):
    """The means of 40,000 lives count as one seed: the standard error of the score is below 0.01."""
    rng = np.random.default_rng(0)
    controls = PROPERTIES[name].controls
    areas = [areas_of_a_search(rng, 40_000) for _ in (name, *controls)]
    own, *others = (each.mean() for each in areas)

    score = score_of([Measured(own, tuple(others), 1.0, exact=False)], controls)

    assert 0.2 < own < 0.8
    assert areas[0].std() * math.sqrt(2 / 40_000) / (1 - own) < 0.01
    assert score.value <= 0.05


def test_a_search_at_random_has_the_floor_of_adaptation():
    """The means of 40,000 lives count as one seed: the standard error of the score is below 0.01."""
    curriculum = curricula.load("profile_adaptation")
    mean = random_frames_to_goal(curriculum.tasks[0])
    needed = np.random.default_rng(0).exponential(mean, (40_000, 7, 1))
    areas = (needed <= np.arange(1, 6) * curriculum.evaluation.every).mean((1, 2))
    [floor] = measure(life("profile_adaptation", fast), [], PROPERTIES["profile_adaptation"]).floors

    score = score_of([Measured(areas.mean(), (floor,), 1.0)])

    assert areas.std() / math.sqrt(40_000) / (1 - floor) < 0.01
    assert areas.mean() == pytest.approx(floor, abs=0.01)
    assert score.value <= 0.05
