"""Metrics of lives, by a hand-made life of three tasks."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from ctgraph_rl import metrics
from ctgraph_rl.metrics.windows import LifeCurves

NAN = math.nan


def float64(values):
    return torch.tensor(values, dtype=torch.float64)


THREE = LifeCurves(
    frames=100,
    moments=float64([0, 50, 100]),
    returns=float64([[0.0, 0.5, 0.95], [0.2, 1.8, 1.0], [0.5, 0.5, 0.25]]),
    success=float64([0.9, 0.5, 0.25]),
    best=float64([1.0, 2.0, 1.0]),
    zero=float64([0.0, 0.0, 0.0]),
    untrained=float64([NAN, 0.1, 0.0]),
    lagged={1: float64([NAN, 0.57, 0.4]), 10: float64([NAN] * 3), 100: float64([NAN] * 3)},
    reward=float64([10.0, 30.0, 5.0]),
    gain=float64([0.25, 0.5, 0.25]),
    alike=True,
)
"""Task 1 is adapted to at its block's end, task 2 in the middle, task 3 never."""


@pytest.mark.parametrize(
    ("name", "terms", "value"),
    [
        ("window_return", [0.95, 1.0, 0.25], 0.25),
        ("window_success", [0.9, 0.5, 0.25], 0.25),
        ("window_regret", [0.05, 1.0, 0.75], 0.75),
        ("window_solved", [1.0, 0.0, 0.0], 0.0),
        ("jump_start", [None, 0.1, 0.5], 0.3),
        ("adaptation_frames", [100.0, 50.0, 100.0], 250 / 3),
        ("never_adapted", [0.0, 0.0, 1.0], 1 / 3),
        ("adaptation_area", [0.725, 0.7, 0.375], 0.6),
        ("retention_1", [None, 0.57 / 1.45, 0.2 / 1.45], 0.77 / 1.45),  # of 0.95 and 1.0 / 2
        ("frame_regret", [15.0, 20.0, 20.0], 55.0),
    ],
)
def test_a_life_of_three_tasks(name, terms, value):
    metric = metrics.METRICS[name].metric(THREE)

    assert metric.terms == tuple(None if term is None else pytest.approx(term) for term in terms)
    assert metric.value == pytest.approx(value)


def test_retention_is_measured_from_each_tasks_failure():
    failures = float64([1.0, -2.0, 4.0])
    moved = replace(
        THREE,
        returns=THREE.returns + failures.unsqueeze(1),
        best=THREE.best + failures,
        zero=failures,
        lagged={1: THREE.lagged[1] + failures.roll(1)},
    )

    assert metrics.retention_1(moved).terms == pytest.approx(metrics.retention_1(THREE).terms, nan_ok=True)


def test_learnability_is_over_the_first_tasks_frames_and_needs_equal_difficulty():
    quick = replace(THREE, returns=float64([[0.0, 0.95, 0.95], [0.2, 1.8, 1.0], [0.5, 0.5, 0.25]]))

    assert metrics.learnability(quick).terms == (1.0, 1.0, 2.0)
    assert metrics.learnability(quick).value == 2.0
    assert metrics.learnability(THREE).undefined == "task 1 was adapted to at once, or never in its block"
    assert "differ in graph" in metrics.learnability(replace(quick, alike=False)).undefined


def test_a_lag_beyond_the_life_and_a_life_that_learned_nothing_retain_nothing_that_is_known():
    assert metrics.retention_10(THREE).undefined == "the life has 3 blocks, and none is 10 blocks after another"
    assert metrics.retention_1(replace(THREE, returns=THREE.returns * 0)).value is None


def test_ten_windows_are_of_successive_blocks_as_equal_as_possible():
    blocks = torch.arange(25.0, dtype=torch.float64)
    long = replace(THREE, returns=blocks.unsqueeze(1), success=blocks, best=blocks, zero=blocks * 0)

    terms = metrics.window_return(long).terms

    assert terms[:6] == (1.0, 4.0, 7.0, 10.0, 13.0, 15.5)
    assert terms[-1] == 23.5
    assert len(terms) == 10
