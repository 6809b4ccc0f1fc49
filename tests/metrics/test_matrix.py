"""Metrics of the performance matrix against values by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from ctgraph_rl import metrics

NAN = math.nan
PERFORMANCE = torch.tensor(
    [
        [0.25, 0.125, 0.5],
        [1.0, 0.375, 0.25],
        [0.5, 0.75, 0.625],
        [0.125, 0.875, 1.0],
    ],
    dtype=torch.float64,
)
"""Three tasks, each trained once in order; row 0 before any training. All values are exact in binary."""

IN_ORDER = [(0,), (1,), (2,)]
SUMMARY = ["average_performance", "forward_transfer", "backward_transfer", "forgetting"]
OUT_OF_ORDER = "the definition needs each task trained once, alone, in the order of the columns"
ONE_TASK = "the definition needs at least two tasks"

BY_HAND = {
    "average_performance": (0.125 + 0.875 + 1.0) / 3,
    "forward_transfer": ((0.375 - 0.125) + (0.625 - 0.5)) / 2,
    "backward_transfer": ((0.125 - 1.0) + (0.875 - 0.75)) / 2,
    "forgetting": ((1.0 - 0.125) + (0.75 - 0.875)) / 2,
    "accuracy_over_time": (1.0 + 0.5 + 0.75 + 0.125 + 0.875 + 1.0) / 6,
    "backward_transfer_over_time": ((0.5 - 1.0) + (0.125 - 1.0) + (0.875 - 0.75)) / 3,
    "remembering": 1 - 1.25 / 3,
    "positive_backward_transfer": 0.0,
    "zero_shot_performance": (0.375 + 0.25 + 0.625) / 3,
    "isolated_forgetting": ((1.0 - 0.5) / 1.0 + (0.5 - 0.125) / 1.0 + (0.75 - 0.875) / 0.875) / 3,
    "zero_shot_transfer": ((0.375 - 0.125) / 0.875 + (0.25 - 0.5) / 1.0 + (0.625 - 0.25) / 1.0) / 3,
}


def changed(**entries: float) -> torch.Tensor:
    """The matrix with other entries, such as ``r31`` for row 3 and task 1 counted from 0."""
    performance = PERFORMANCE.clone()
    for name, value in entries.items():
        performance[int(name[1]), int(name[2])] = value
    return performance


@pytest.mark.parametrize(("name", "value"), BY_HAND.items(), ids=BY_HAND)
def test_every_metric_has_the_value_by_hand(name, value):
    metric = getattr(metrics, name)(PERFORMANCE)

    assert metric.value == pytest.approx(value, abs=1e-15)
    assert (metric.undefined, metric.n_undefined) == (None, 0)


def test_all_metrics_of_the_matrix_are_computed_by_name_with_the_summary_first():
    found = metrics.of_matrix(PERFORMANCE, IN_ORDER)

    assert {name: metric.value for name, metric in found.items()} == pytest.approx(BY_HAND, abs=1e-15)
    assert list(found)[:4] == list(metrics.summary(PERFORMANCE, IN_ORDER)) == SUMMARY


def test_a_metric_says_what_it_is_and_holds_its_terms():
    metric = metrics.backward_transfer(PERFORMANCE)

    assert metric.definition == "lopez-paz2017/bwt"
    assert metric.formula == "1/(T-1) sum_{j=1..T-1} (R[T,j] - R[j,j])"
    assert "1706.08840" in metric.source
    assert metric.terms == (-0.875, 0.125)


def test_definitions_have_different_ids_and_what_they_need_to_be_cited():
    definitions = metrics.definitions()

    assert len(definitions) == len({definition.id for definition in definitions.values()}) >= 35
    assert all(definition.formula and definition.source for definition in definitions.values())
    assert all(getattr(metrics, name).__doc__ for name in definitions)


def test_forgetting_takes_the_best_block_and_not_only_the_tasks_own():
    value = metrics.forgetting(changed(r10=0.5, r20=1.0)).value

    assert value == ((1.0 - 0.125) + (0.75 - 0.875)) / 2 == 0.375


def test_the_untrained_agent_is_no_candidate_for_the_best_in_forgetting():
    value = metrics.forgetting(changed(r00=8.0, r01=8.0, r02=8.0)).value

    assert value == 0.375


def test_the_last_row_is_no_candidate_for_the_best_in_forgetting():
    value = metrics.forgetting(changed(r31=1.75)).value

    assert value == ((1.0 - 0.125) + (0.75 - 1.75)) / 2 == -0.0625


def test_remembering_and_positive_transfer_split_backward_transfer_at_zero():
    improved = changed(r20=1.0, r30=1.0)

    split = [metrics.remembering(improved).value, metrics.positive_backward_transfer(improved).value]

    assert metrics.backward_transfer_over_time(improved).value == split[1] == 0.125 / 3
    assert split[0] == 1.0


def test_zeros_are_performance_and_not_missing():
    failing = torch.zeros(4, 3, dtype=torch.float64)
    failing[3] = torch.tensor([0.0, 0.0, 0.75])

    assert metrics.average_performance(failing).value == 0.25
    assert metrics.accuracy_over_time(failing).value == 0.125
    assert metrics.backward_transfer(failing).value == 0.0


@pytest.mark.parametrize(
    ("name", "count", "of"),
    [
        ("average_performance", 1, 3),
        ("backward_transfer", 1, 2),
        ("forgetting", 1, 2),
        ("accuracy_over_time", 1, 6),
        ("backward_transfer_over_time", 1, 3),
        ("remembering", 1, 3),
        ("positive_backward_transfer", 1, 3),
        ("isolated_forgetting", 1, 3),
    ],
)
def test_a_missing_evaluation_that_a_formula_needs_makes_the_metric_undefined(name, count, of):
    metric = getattr(metrics, name)(changed(r31=NAN))

    assert (metric.value, metric.n_undefined) == (None, count)
    assert metric.undefined.startswith(f"{count} of {of} terms have no value: an evaluation is missing")
    assert metric.terms.count(None) == count


def test_no_older_row_steps_in_for_a_missing_evaluation_before_a_tasks_own_block():
    metric = metrics.forward_transfer(changed(r22=NAN))

    assert (metric.value, metric.terms) == (None, (0.25, None))
    assert metric.undefined == "1 of 2 terms have no value: an evaluation is missing"


@pytest.mark.parametrize("name", ["forward_transfer", "zero_shot_transfer"])
def test_transfer_to_untrained_tasks_needs_the_initial_evaluation(name):
    metric = getattr(metrics, name)(changed(r00=NAN, r01=NAN, r02=NAN))

    assert metric.value is None
    assert metric.undefined == "the definition needs the evaluation before any training (row 0)"


def test_an_evaluation_that_no_formula_needs_may_be_missing():
    missing = changed(r00=NAN)

    assert metrics.summary(missing, IN_ORDER) == metrics.summary(PERFORMANCE, IN_ORDER)


def test_forward_transfer_is_against_the_untrained_agent():
    gifted = changed(r01=0.375, r02=0.625)

    assert metrics.forward_transfer(gifted).value == 0.0
    assert metrics.zero_shot_performance(gifted).value == BY_HAND["zero_shot_performance"]


def test_a_single_task_has_an_average_and_an_accuracy_and_nothing_else():
    single = torch.tensor([[0.25], [0.75]], dtype=torch.float64)

    found = metrics.of_matrix(single, [(0,)])

    defined = {name: metric.value for name, metric in found.items() if metric.undefined is None}
    assert defined == {"average_performance": 0.75, "accuracy_over_time": 0.75}
    assert {metric.undefined for metric in found.values()} == {None, ONE_TASK}


@pytest.mark.parametrize(
    "trained",
    [[(0,), (1,), (2,), (0,)], [(0, 1), (2,)], [(0,), (2,), (1,)], [(0, 1, 2)]],
    ids=["a task again", "two tasks in a block", "out of order", "one block for all"],
)
def test_what_the_definitions_do_not_cover_is_undefined_with_the_reason(trained):
    performance = torch.full((len(trained) + 1, 3), 0.5, dtype=torch.float64)

    summary = metrics.summary(performance, trained)

    assert [(summary[name].value, summary[name].undefined) for name in SUMMARY] == [
        (0.5, None),
        *[(None, OUT_OF_ORDER)] * 3,
    ]


def test_isolated_forgetting_counts_blocks_of_other_tasks_after_the_first_training():
    again = torch.tensor([[0, 0], [1, 0.5], [0.75, 1], [1, 0.5]], dtype=torch.float64)

    forgotten = metrics.isolated_forgetting(again, [(0,), (1,), (0,)])
    gained = metrics.zero_shot_transfer(again, [(0,), (1,), (0,)])

    assert forgotten.terms == (0.25, 0.5)  # not of block 3, which trains the first task itself, as CORA's code has it
    assert gained.terms == (0.5,)


def test_changes_are_divided_by_a_given_scale_and_undefined_at_scale_zero():
    doubled = metrics.isolated_forgetting(PERFORMANCE, IN_ORDER, torch.tensor([2.0, 2.0, 2.0]))
    never = metrics.isolated_forgetting(PERFORMANCE * torch.tensor([1.0, 0.0, 1.0]), IN_ORDER)

    assert doubled.terms == (0.25, 0.1875, -0.0625)
    assert (never.value, never.terms) == (None, (0.5, 0.375, None))
    assert "a scale is 0" in never.undefined


def test_blocks_with_several_tasks_isolate_nothing():
    metric = metrics.isolated_forgetting(PERFORMANCE, [(0,), (1, 2), (2,)])

    assert (metric.value, metric.undefined) == (None, "the definition needs blocks that train one task each")


def test_a_matrix_that_does_not_fit_the_blocks_is_refused():
    with pytest.raises(ValueError, match="performance needs 3 rows for 2 blocks, got 4"):
        metrics.backward_transfer(PERFORMANCE, [(0,), (1,)])
    with pytest.raises(ValueError, match=r"without trained, .* got 2 blocks and 3 tasks"):
        metrics.backward_transfer(PERFORMANCE[:3])


def test_an_agent_that_learns_and_never_forgets_has_neither_transfer_nor_forgetting():
    perfect = torch.tensor([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]], dtype=torch.float64)

    found = metrics.of_matrix(perfect, IN_ORDER)

    assert [found[name].value for name in SUMMARY] == [1.0, 0.0, 0.0, 0.0]
    assert [found[name].value for name in ("accuracy_over_time", "remembering")] == [1.0, 1.0]


@pytest.mark.parametrize("make", [list, np.array, lambda rows: np.array(rows, np.float32)])
def test_a_metric_takes_lists_and_arrays_as_tensors(make):
    rows = [[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]]

    assert metrics.isolated_forgetting(make(rows), scale=make([2.0, 1.0])) == metrics.isolated_forgetting(
        torch.tensor(rows, dtype=torch.float64), scale=torch.tensor([2.0, 1.0])
    )
    assert metrics.average_performance(performance=make(rows)).value == 0.75
