"""Metrics against what is known in closed form."""

from __future__ import annotations

import math

import pytest
import torch

from ctgraph_rl import CTGraph, evaluate, metrics
from ctgraph_rl.policies import OptimalPolicy
from ctgraph_rl.tasks.configurations import ct_su_b1

NAN = math.nan


def tensor(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_performance_is_normalised_by_what_is_possible_and_not_by_data():
    performance = tensor([[0.0, 0.0], [0.5, 1.5]])

    metric = metrics.normalised_performance(performance, best=tensor([1.0, 2.0]), zero=tensor([0.0, 1.0]))

    assert (metric.value, metric.terms) == (0.5, (0.5, 0.5))


def test_the_optimal_policy_has_a_normalised_performance_of_one():
    task = ct_su_b1((1, 2))
    reached = evaluate(OptimalPolicy, [task], num_episodes=20)["episode_reward"].double().mean().reshape(1, 1)

    metric = metrics.normalised_performance(reached, best=tensor([task.optimal_value(1.0)]))

    assert metric.value == 1.0


def test_a_task_whose_best_is_its_zero_makes_the_share_undefined():
    metric = metrics.normalised_performance(tensor([[0.0, 1.0]]), best=tensor([0.0, 1.0]))

    assert (metric.value, metric.n_undefined) == (None, 1)


def test_regret_is_the_return_lost_in_every_finished_episode():
    metric = metrics.regret(tensor([10, 0, 4]), tensor([0.0, NAN, 0.75]), tensor([1.0, 1.0, 1.0]))

    assert (metric.value, metric.terms) == (11.0, (10.0, 0.0, 1.0))


def test_regret_against_an_unknown_optimum_is_undefined():
    metric = metrics.regret(tensor([10, 4]), tensor([0.0, 0.75]), tensor([1.0, NAN]))

    assert (metric.value, metric.n_undefined) == (None, 1)


def test_the_first_reward_is_at_its_mean_place_in_its_interval():
    frames, episodes, rates = tensor([100, 200, 300, 400]), tensor([0, 7, 8, 9]), tensor([NAN, 0.0, 0.125, 1.0])

    metric = metrics.frames_to_first_reward(
        [frames, frames[:1]], [episodes, episodes[3:]], [rates, rates[3:]], [100, 10]
    )

    first = 200 + 100 * (9 / 2) / 8, 100 * (10 / 10) / 9
    assert metric.terms == (first[0] / 100, pytest.approx(first[1] / 10, abs=1e-12))


def test_the_first_reward_is_exact_for_intervals_of_one_episode():
    metric = metrics.frames_to_first_reward([tensor([4, 10, 16])], [tensor([1] * 3)], [tensor([0, 1.0, 1.0])], [20.0])

    assert metric.value == 0.5


def test_search_efficiency_is_one_for_a_search_without_repetition_on_average():
    episodes, rates = tensor([1] * 5), tensor([0, 0, 0.0, 1.0, 0.0])

    metric = metrics.search_efficiency([episodes], [rates], [CTGraph(2, 3).expected_search_episodes])

    assert metric.value == 4.5 / 4


def test_a_goal_never_reached_is_undefined_and_the_others_are_shown():
    data = [tensor([10, 20]), tensor([1.0])], [tensor([0.0, NAN]), tensor([1.0])], [1.0, 1.0]

    found = [metrics.search_efficiency(*data), metrics.frames_to_first_reward(data[0], *data)]

    assert [(metric.value, metric.terms) for metric in found] == [(None, (None, 1.0))] * 2
    assert {metric.undefined for metric in found} == {"1 of 2 terms have no value: a goal was never reached"}


def test_stages_are_fails_navigates_and_solves():
    metric = metrics.stage_reached(tensor([0.5, 1.0, 1.0, 0.9]), tensor([0.5, 0.25, 1.0, 0.9]))

    assert [metrics.STAGES[int(stage)] for stage in metric.terms] == ["fails", "navigates", "solves", "solves"]
    assert metric.value == 5 / 4


def test_a_task_that_was_not_evaluated_has_no_stage():
    metric = metrics.stage_reached(tensor([1.0, NAN]), tensor([1.0, NAN]))

    assert (metric.value, metric.terms) == (None, (2.0, None))
