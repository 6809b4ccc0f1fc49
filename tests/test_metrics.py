"""Lifelong-learning metrics against values by hand."""

from __future__ import annotations

import math

import pytest
import torch

from ctgraph_rl import metrics

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
NAMES = ["average_performance", "forward_transfer", "backward_transfer", "forgetting"]


def test_average_performance_is_the_mean_of_the_last_row():
    assert metrics.average_performance(PERFORMANCE) == pytest.approx((0.125 + 0.875 + 1.0) / 3, abs=1e-15)


def test_backward_transfer_is_the_change_from_right_after_a_tasks_own_block_to_the_end():
    value = metrics.backward_transfer(PERFORMANCE)

    assert value == ((0.125 - 1.0) + (0.875 - 0.75)) / 2 == -0.375


def test_forward_transfer_is_the_gain_over_the_untrained_agent_right_before_a_tasks_own_block():
    value = metrics.forward_transfer(PERFORMANCE)

    assert value == ((0.375 - 0.125) + (0.625 - 0.5)) / 2 == 0.1875


def test_forgetting_is_the_drop_from_the_best_after_an_earlier_block_to_the_end():
    value = metrics.forgetting(PERFORMANCE)

    assert value == ((1.0 - 0.125) + (0.75 - 0.875)) / 2 == 0.375


def test_forgetting_takes_the_best_block_and_not_only_the_tasks_own():
    best_later = PERFORMANCE.clone()
    best_later[1, 0], best_later[2, 0] = 0.5, 1.0

    value = metrics.forgetting(best_later)

    assert value == ((1.0 - 0.125) + (0.75 - 0.875)) / 2 == 0.375


def test_the_untrained_agent_is_no_candidate_for_the_best_in_forgetting():
    lucky = PERFORMANCE.clone()
    lucky[0] = 8.0

    value = metrics.forgetting(lucky)

    assert value == metrics.forgetting(PERFORMANCE) == 0.375


def test_the_last_row_is_no_candidate_for_the_best_in_forgetting():
    improved = PERFORMANCE.clone()
    improved[3, 1] = 1.75

    value = metrics.forgetting(improved)

    assert value == ((1.0 - 0.125) + (0.75 - 1.75)) / 2 == -0.0625


def test_the_summary_holds_all_metrics_in_order_with_what_they_mean():
    summary = metrics.summary(PERFORMANCE, IN_ORDER)

    assert list(summary) == NAMES
    assert [metric.value for metric in summary.values()] == pytest.approx([2 / 3, 0.1875, -0.375, 0.375], abs=1e-15)
    assert all(metric.definition and metric.formula and metric.source for metric in summary.values())
    assert all(metric.undefined is None for metric in summary.values())


def test_a_single_task_has_an_average_and_nothing_else():
    single = torch.tensor([[0.25], [0.75]], dtype=torch.float64)

    summary = metrics.summary(single, [(0,)])

    assert [summary[name].value for name in NAMES] == [0.75, None, None, None]
    assert {summary[name].undefined for name in NAMES[1:]} == {"the definition needs at least two tasks"}
    transfers = (metrics.backward_transfer, metrics.forward_transfer, metrics.forgetting)
    assert all(math.isnan(function(single)) for function in transfers)


@pytest.mark.parametrize(
    "trained",
    [
        [(0,), (1,), (2,), (0,)],
        [(0, 1), (2,)],
        [(0,), (2,), (1,)],
        [(0, 1, 2)],
    ],
    ids=["a task again", "two tasks in a block", "out of order", "one block for all"],
)
def test_what_the_definitions_do_not_cover_is_undefined_with_the_reason(trained):
    performance = torch.full((len(trained) + 1, 3), 0.5, dtype=torch.float64)

    summary = metrics.summary(performance, trained)

    reason = "the definition needs each task trained once, alone, in the order of the columns"
    assert [(summary[name].value, summary[name].undefined) for name in NAMES] == [(0.5, None)] + [(None, reason)] * 3


def test_an_agent_that_learns_and_never_forgets_has_neither_transfer_nor_forgetting():
    perfect = torch.tensor([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]], dtype=torch.float64)

    summary = metrics.summary(perfect, IN_ORDER)

    assert [summary[name].value for name in NAMES] == [1.0, 0.0, 0.0, 0.0]
