"""Statistics over seeds against published and exact values."""

from __future__ import annotations

import math
import sys

import pytest

from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import compare, interquartile_mean, mean, seeds_needed, solved_rate

pytest.importorskip("scipy")


def test_a_mean_has_students_interval():
    estimate = mean([1.0, 2.0, 3.0, 4.0, 5.0])

    half = 2.7764451051977987 * math.sqrt(2.5 / 5)  # the 97.5 % quantile of t with 4 degrees of freedom
    assert (estimate.value, estimate.n, estimate.n_undefined) == (3.0, 5, 0)
    assert (estimate.low, estimate.high) == pytest.approx((3 - half, 3 + half), abs=1e-12)


def test_seeds_without_a_value_are_counted_and_not_replaced():
    estimate = mean([1.0, None, 3.0, math.nan])

    assert (estimate.value, estimate.n, estimate.n_undefined) == (2.0, 2, 2)
    assert str(estimate) == "2.00 [-10.71, 14.71] n = 2/4"


@pytest.mark.parametrize(
    ("values", "value", "reason"),
    [
        ([0.5], 0.5, "one seed has no interval"),
        ([0.5, 0.5, 0.5], 0.5, "all seeds are equal: no spread to estimate"),
        ([], None, "no seed has a value"),
        ([None, math.nan], None, "no seed has a value"),
    ],
    ids=["one", "equal", "none", "undefined"],
)
def test_an_interval_without_width_is_no_interval(values, value, reason):
    estimate = mean(values)

    assert (estimate.value, estimate.low, estimate.high, estimate.reason) == (value, None, None, reason)


@pytest.mark.parametrize(
    ("solved", "low", "high"),
    [(10, 0.69150, 1.0), (0, 0.0, 0.30850), (5, 0.18709, 0.81291), (9, 0.55498, 0.99747)],
)
def test_solved_rates_have_the_exact_interval(solved, low, high):
    estimate = solved_rate([True] * solved + [False] * (10 - solved))

    assert estimate.value == solved / 10
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=5e-6)


def test_failed_runs_are_shown_in_a_solved_rate():
    estimate = solved_rate([True, None, False])

    assert (estimate.value, estimate.n, estimate.n_undefined) == (0.5, 2, 1)
    assert solved_rate([None]).reason == "no seed has a result"


def test_the_interquartile_mean_is_of_the_middle_half_of_all_tasks_together():
    estimate = interquartile_mean([[0.0] * 10, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 100.0]])

    assert estimate.value == (5 * 0 + 1 + 2 + 3 + 4 + 5) / 10
    assert estimate.low < 1.5 < estimate.high
    assert (estimate.n, estimate.n_undefined) == (10, 0)


def test_the_bootstrap_is_stratified_so_tasks_without_spread_stay_as_they_are():
    estimate = interquartile_mean([[0.0] * 10, [1.0] * 10])

    assert (estimate.low, estimate.value, estimate.high) == (0.5, 0.5, 0.5)


def test_the_bootstrap_interval_covers_about_what_it_should_at_twenty_seeds():
    import numpy as np

    rng = np.random.default_rng(1)
    samples = rng.normal(size=(200, 20))

    estimates = [interquartile_mean([row.tolist()], resamples=400) for row in samples]
    covered = sum(estimate.low <= 0 <= estimate.high for estimate in estimates)

    assert 170 <= covered <= 199


def test_the_same_seed_gives_the_same_bootstrap():
    values = [[float(i) for i in range(12)]]

    assert interquartile_mean(values) == interquartile_mean(values)
    assert interquartile_mean(values, seed=1) != interquartile_mean(values)


def test_the_interquartile_mean_needs_ten_seeds():
    estimate = interquartile_mean([[0.0] * 12, [0.5] * 9 + [None] * 3])

    assert (estimate.value, estimate.low, estimate.n, estimate.n_undefined) == (None, None, 9, 3)
    assert estimate.reason == "needs 10 seeds of each task, got 9"


def test_a_paired_comparison_is_of_the_differences():
    comparison = compare([0.5, 1.0, 0.75, 1.0], [0.25, 0.5, 1.0, 1.0])

    assert comparison.difference == mean([0.25, 0.5, -0.25, 0.0])
    assert (comparison.wins, comparison.ties, comparison.losses) == (2, 1, 1)
    assert comparison.std == pytest.approx((0.3125 / 3) ** 0.5, abs=1e-12)


def test_few_pairs_are_tested_exactly():
    comparison = compare([1.0, 2.0, 3.0, 4.0, 5.0], [0.0] * 5)

    assert comparison.p_value == 2 / 2**5


def test_many_pairs_are_tested_by_random_flips():
    alternating, all_better = compare([1.0, -1.0] * 10, [0.0] * 20), compare([1.0] * 20, [0.0] * 20)

    mostly = compare([1.0] * 14 + [-1.0] * 6, [0.0] * 20)
    assert mostly.p_value == pytest.approx(2 * 60460 / 2**20, abs=0.02)
    assert alternating.p_value == 1.0
    assert all_better.p_value == 1 / 10_000


def test_a_pair_without_both_values_is_counted():
    comparison = compare([1.0, None, 0.5], [0.0, 0.0, math.nan])

    assert (comparison.difference.n, comparison.difference.n_undefined) == (1, 2)
    assert (comparison.std, comparison.p_value, comparison.wins) == (None, None, 1)


@pytest.mark.parametrize(
    ("effect", "paired", "n"),
    [
        (0.5, False, 64),
        (0.8, False, 26),
        (1.2, False, 12),
        (2.0, False, 6),
        (0.5, True, 34),
        (1.5, True, 6),
        (0.8, True, 15),
    ],
)
def test_seeds_needed_are_those_of_published_power_tables(effect, paired, n):
    assert seeds_needed(effect * 0.3, 0.3, paired) == n


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mean([1.0], level=95), r"level must be in \[0, 1\], got 95"),
        (lambda: compare([1.0], []), "pairs need equally many seeds, got 1 and 0"),
        (lambda: interquartile_mean([]), "needs the values of at least one task"),
        (lambda: interquartile_mean([[1.0]], resamples=1), "resamples must be an integer >= 100, got 1"),
        (lambda: seeds_needed(0.0, 1.0), "difference must be a number > 0, got 0.0"),
        (lambda: seeds_needed(1e-9, 1.0), "1048576 seeds do not find a difference of 1e-09"),
    ],
)
def test_values_out_of_range_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_without_scipy_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)

    with pytest.raises(ModuleNotFoundError, match=r"pip install 'ctgraph_rl\[stats\]'"):
        statistics.mean([1.0])
