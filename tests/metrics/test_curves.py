"""Metrics of evaluation curves against values by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from ctgraph_rl import metrics
from ctgraph_rl.metrics import Curves

NAN = math.nan


def tensor(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


CURVES = Curves(
    tensor(
        [
            [0.0, 0.25, 0.0],
            [0.5, 0.25, 0.0],
            [1.0, 0.5, 0.25],
            [0.75, 0.5, 0.25],
            [0.5, 1.0, 0.25],
            [0.25, 0.75, 0.5],
            [0.25, 0.5, 0.75],
        ]
    ),
    blocks=(0, 1, 1, 2, 2, 3, 3),
    frames=(0, 10, 20, 30, 40, 50, 60),
    trained=((0,), (1,), (2,)),
)
"""Three tasks in order, each evaluated before, twice in each block."""

EXPERTS = tensor([0.5, 0.5, 0.75])


def with_entry(row: int, task: int, value: float) -> Curves:
    performance = CURVES.performance.clone()
    performance[row, task] = value
    return replace(CURVES, performance=performance)


def test_the_performance_matrix_is_the_last_evaluation_of_each_block():
    ends = CURVES.ends

    assert ends.tolist() == [[0.0, 0.25, 0.0], [1.0, 0.5, 0.25], [0.5, 1.0, 0.25], [0.25, 0.5, 0.75]]


def test_a_block_without_evaluation_is_a_row_of_nan():
    some = Curves(CURVES.performance[:1], (1,), (10,), ((0,), (1,)))

    assert some.ends.isnan().tolist() == [[True] * 3, [False] * 3, [True] * 3]


def test_continual_world_by_hand():
    found = [metrics.continual_world_performance(CURVES), metrics.continual_world_forgetting(CURVES)]

    assert (found[0].value, found[0].terms) == (0.5, (0.25, 0.5, 0.75))
    assert found[1].value == ((1.0 - 0.25) + (1.0 - 0.5) + 0.0) / 3
    assert found[1].terms[-1] == 0.0


def test_the_end_may_be_the_mean_of_the_last_evaluations():
    found = [metrics.continual_world_performance(CURVES, 2), metrics.continual_world_forgetting(CURVES, 2)]

    assert found[0].value == (0.25 + 0.625 + 0.625) / 3
    assert found[1].terms == (0.75 - 0.25, 0.75 - 0.625, 0.0)
    with pytest.raises(ValueError, match="last must be an integer >= 1, got 0"):
        metrics.continual_world_performance(CURVES, 0)


def test_more_last_evaluations_than_a_block_has_are_undefined():
    metric = metrics.continual_world_performance(CURVES, last=5)

    assert (metric.value, metric.undefined) == (None, "the definition needs 5 evaluations in block 3, it has 2")


def test_the_two_areas_differ_by_how_they_treat_the_ends():
    curve = tensor([0.0, 1.0, 1.0, 1.0])

    assert metrics.mean_area(curve).item() == 0.75
    assert metrics.trapezoid_area(curve).item() == (0.5 + 1.0 + 1.0) / 3
    assert metrics.trapezoid_area(curve[:1]).isnan()


def test_the_area_of_a_stage_is_of_the_evaluations_in_and_after_the_own_block():
    assert metrics.stage_areas(CURVES).tolist() == [0.75, 0.75, 0.625]
    assert metrics.stage_areas(CURVES, trapezoids=True).tolist() == [0.75, 0.75, 0.625]


def test_forward_transfer_is_the_share_of_what_was_left_to_gain():
    metric = metrics.continual_world_forward_transfer(metrics.stage_areas(CURVES), EXPERTS)

    assert metric.terms == (0.5, 0.5, -0.5)
    assert metric.value == 0.5 / 3


def test_forward_transfer_over_seeds_is_a_ratio_of_means_and_not_a_mean_of_ratios():
    areas, experts = tensor([[0.5], [1.0]]), tensor([[0.0], [0.5], [0.25]])

    metric = metrics.continual_world_forward_transfer(areas, experts)

    assert metric.value == (0.75 - 0.25) / (1 - 0.25)


def test_a_perfect_expert_leaves_nothing_to_gain_and_divides_nothing_by_zero():
    found = [
        function(metrics.stage_areas(CURVES), tensor([0.5, 1.0, 0.75]))
        for function in (metrics.continual_world_forward_transfer, metrics.forward_transfer_from_experts)
    ]

    reason = "1 of 3 terms have no value: the expert leaves nothing to gain (task 2)"
    assert [(metric.value, metric.undefined, metric.n_undefined) for metric in found] == [(None, reason, 1)] * 2


def test_each_cause_of_an_undefined_forward_transfer_is_named_with_its_tasks():
    experts = tensor([1.0, NAN, 1.0, 0.5])

    metric = metrics.continual_world_forward_transfer(tensor([0.5, 0.5, 0.75, NAN]), experts)

    causes = "an evaluation is missing (task 2, 4); the expert leaves nothing to gain (task 1, 3)"
    assert metric.undefined == f"4 of 4 terms have no value: {causes}"


def test_the_labs_forward_transfer_needs_a_headroom_of_a_thousandth():
    areas = tensor([0.9999, 0.5])

    metric = metrics.forward_transfer_from_experts(areas, tensor([0.9995, 0.25]))

    assert metric.terms == (None, pytest.approx(1 / 3, abs=1e-15))
    assert metric.undefined == "1 of 2 terms have no value: the expert leaves nothing to gain (task 1)"


def test_a_task_trained_twice_has_no_own_stage():
    again = replace(CURVES, trained=((0,), (1,), (0,)))

    metric = metrics.continual_world_forgetting(again)

    assert metric.undefined == "the definition needs each task trained once, task 1 is in 2 blocks"
    assert metrics.stage_areas(again).isnan().tolist() == [True, False, True]


def test_tasks_trained_together_have_no_own_stage():
    together = replace(CURVES, trained=((0, 1), (1, 0), (2,)))

    assert metrics.stage_areas(together).isnan().tolist() == [True, True, False]
    assert metrics.stage_areas(replace(CURVES, trained=((0, 1), (3,), (2,)))).isnan().tolist() == [True, True, False]


def test_evaluations_at_unequal_distances_have_no_area():
    uneven = Curves(tensor([[0.0], [0.5], [1.0]]), (1, 1, 1), (10, 20, 35), ((0,),))

    assert metrics.stage_areas(uneven).isnan().tolist() == [True]


def test_cumulative_return_is_the_sum_over_tasks_and_its_total_the_sum_over_time():
    now, total = metrics.instant_cumulative_return(CURVES), metrics.total_performance_over_time(CURVES)

    assert now.terms == (0.25, 0.75, 1.75, 1.5, 1.75, 1.5, 1.5)
    assert total.terms == now.terms[1:]  # the published protocol has no evaluation before training
    assert (now.value, total.value) == (1.5, 8.75)


def test_relative_forgetting_is_the_share_of_the_best_that_is_gone():
    metric = metrics.relative_forgetting(CURVES)

    assert metric.terms == (0.75, 0.5, 0.0)
    assert metric.value == 1.25 / 3


def test_a_task_that_never_got_above_zero_is_left_out_and_counted():
    zeros = replace(CURVES, performance=CURVES.performance * tensor([1.0, 0.0, 1.0]))

    metric = metrics.relative_forgetting(zeros)

    assert (metric.value, metric.n_undefined, metric.terms) == (0.375, 1, (0.75, None, 0.0))


def test_relative_forgetting_needs_the_last_evaluation_and_takes_the_best_of_those_that_there_are():
    without_last, without_first = (metrics.relative_forgetting(with_entry(row, 0, NAN)) for row in (6, 0))

    assert (without_last.value, without_last.undefined) == (None, "the last evaluation of a task is missing")
    assert without_first.terms == (0.75, 0.5, 0.0)


def test_tasks_learned_counts_what_was_mastered_after_its_last_block():
    learned = [metrics.tasks_learned(CURVES, threshold).value for threshold in (0.9, 0.75, tensor([1.1, 1.0, 0.7]))]
    again = metrics.tasks_learned(replace(CURVES, trained=((0,), (1,), (0,))))

    assert learned == [2.0, 3.0, 2.0]
    assert (again.value, again.terms) == (1.0, (0.0, 1.0))


def test_frames_to_mastery_count_from_the_start_of_the_first_block_of_a_task_alone():
    low = [0.5, 1.0, 0.5]
    together_first = replace(CURVES, trained=((0, 1), (1,), (2,)))
    again = replace(CURVES, trained=((0,), (1,), (0,)))

    assert metrics.frames_to_mastery(CURVES, tensor(low)).terms == (10.0, 20.0, 10.0)
    assert metrics.frames_to_mastery(together_first, tensor(low)).terms == (10.0,)
    assert metrics.frames_to_mastery(again, tensor(low)).terms == (10.0, 20.0)
    never = metrics.frames_to_mastery(CURVES)
    assert (never.value, never.n_undefined) == (None, 1)


@pytest.mark.parametrize(
    "metric",
    [metrics.continual_world_performance, metrics.instant_cumulative_return, metrics.total_performance_over_time],
)
def test_a_missing_evaluation_is_never_taken_for_a_zero(metric):
    found = metric(with_entry(6, 1, NAN))

    assert (found.value, found.n_undefined) == (None, 1)


def test_all_metrics_without_experts_are_computed_by_name():
    found = metrics.of_curves(CURVES)

    assert list(found) == [
        "continual_world_performance",
        "continual_world_forgetting",
        "instant_cumulative_return",
        "total_performance_over_time",
        "relative_forgetting",
        "tasks_learned",
        "frames_to_mastery",
        "regain",
    ]
    assert [name for name, metric in found.items() if metric.value is None] == ["frames_to_mastery", "regain"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"blocks": (0, 1, 1)}, r"performance must be \[evaluations, tasks\] with a block and frames each"),
        ({"blocks": (0, 1, 1, 3, 2, 3, 3)}, "blocks must rise from 0 to at most 3"),
        ({"blocks": (0, 1, 1, 2, 2, 3, 4)}, "blocks must rise from 0 to at most 3"),
        ({"frames": (0,)}, "with a block and frames each"),
    ],
)
def test_parts_that_do_not_fit_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(CURVES, **change)


def test_experts_with_another_number_of_evaluations_are_refused():
    metrics.check_experts(CURVES, [tensor([0.5, 0.5])] * 3)

    with pytest.raises(ValueError, match="the expert of task 2 needs 2 evaluations as its block, got 3"):
        metrics.check_experts(CURVES, [tensor([0.5, 0.5]), tensor([0.5, 0.5, 1.0])])
