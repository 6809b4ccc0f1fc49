"""Statistics over seeds against published and exact values."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctgraph_rl.report import statistics
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.report.statistics import (
    Estimate,
    compare,
    holm,
    interquartile_mean,
    iqm,
    mean,
    mean_and_std,
    median_time,
    pairs_needed,
    seeds_needed,
    solved_rate,
)

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


FIVE_OF_FIVE = 0.025 ** (1 / 5)
"""Clopper and Pearson's lower limit of 5 of 5: the rate whose chance of 5 of 5 is 2.5 %."""


def test_five_of_five_is_a_share_above_0_48_and_so_is_a_mean_of_five_ones_in_its_bounds():
    share, average = solved_rate([True] * 5), mean([1.0] * 5, bounds=(0, 1))

    assert pytest.approx(0.4782, abs=5e-5) == FIVE_OF_FIVE
    assert (share.low, share.high) == (pytest.approx(FIVE_OF_FIVE, abs=1e-12), 1.0)
    assert (average.low, average.high) == (share.low, share.high)
    assert str(average) == "1.00 [0.48, 1.00] n = 5"


@pytest.mark.parametrize("ones", range(5))
def test_two_outcomes_at_the_bounds_have_the_interval_of_a_share(ones):
    values = [1.0] * ones + [0.0] * (4 - ones)

    average, share = (
        mean([3 * value - 1 for value in values], bounds=(-1, 2)),
        solved_rate([value == 1 for value in values]),
    )

    assert (average.low, average.high) == pytest.approx((3 * share.low - 1, 3 * share.high - 1), abs=1e-12)


@pytest.mark.parametrize(
    ("values", "level", "low", "high"),
    [
        ((0.5, 0.5), 0.95, 0.5 * 0.025**0.5, 1 - 0.5 * 0.025**0.5),  # the weight of the two has P(W < w) = w**2
        ((0.5, 1.0), 0.5, 0.125**0.5, None),  # a triangle over 0, 0.5 and 1: P(mean < m) = 2 m**2 below 0.5
        ((0.0, 0.5), 0.5, None, 1 - 0.125**0.5),
    ],
)
def test_a_mean_in_its_bounds_has_gaffkes_interval_by_hand(values, level, low, high):
    estimate = mean(values, level, bounds=(0, 1))

    assert low is None or estimate.low == pytest.approx(low, abs=1e-9)
    assert high is None or estimate.high == pytest.approx(high, abs=1e-9)


def test_a_mean_in_its_bounds_has_the_quantiles_of_random_weights():
    values = [0.2, 0.4, 0.5, 0.9, 1.0]
    weights = np.random.default_rng(0).dirichlet(np.ones(6), 200_000)

    estimate = mean(values, bounds=(0, 1))

    assert estimate.low == pytest.approx(np.quantile(weights @ [*values, 0.0], 0.025), abs=2e-3)
    assert estimate.high == pytest.approx(np.quantile(weights @ [*values, 1.0], 0.975), abs=2e-3)


MILLIONTHS = st.integers(-(10**6), 2 * 10**6).map(lambda number: number / 10**6)
RETURNS = st.lists(st.one_of(st.sampled_from([-1.0, 0.0, 2.0]), MILLIONTHS), min_size=2, max_size=12)
LEVELS = st.integers(5, 99).map(lambda percent: percent / 100)


@settings(max_examples=40, deadline=None)
@given(RETURNS, LEVELS, LEVELS)
def test_an_interval_in_bounds_is_never_outside_nor_empty_and_grows_with_its_level(values, one, other):
    narrow, wide = (mean(values, level, bounds=(-1, 2)) for level in sorted((one, other)))

    assert -1 <= wide.low <= narrow.low <= narrow.high <= wide.high <= 2
    assert narrow.low < narrow.high
    assert narrow.low <= narrow.value <= narrow.high and wide.low <= wide.value <= wide.high


@pytest.mark.parametrize(
    ("values", "bounds", "low", "high"),
    [([1.0, 2.0, 3.0], (0, math.inf), 0.0, 2 + 4.302653 / 3**0.5), ([1.0, 1.0, 0.0], (-math.inf, 1), -0.76755, 1.0)],
)
def test_students_interval_is_cut_at_the_one_bound_that_is_known(values, bounds, low, high):
    estimate = mean(values, bounds=bounds)

    assert estimate.method == "mean, Student t 95%"
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-5)


def test_bounds_that_a_value_leaves_are_none():
    estimate = mean([0.5, 1.5, 1.0], bounds=(0, 1))

    assert (estimate.method, estimate.reason) == ("mean, Student t 95%", "a value is outside [0, 1]")
    assert estimate.low == mean([0.5, 1.5, 1.0]).low


def test_noise_puts_the_bounds_further_out_and_values_stay_as_they_are():
    found = mean([1.01, 0.99, 1.0], bounds=Bounds(0, 1).widened(0.01))
    clipped = mean([1.0, 0.99, 1.0], bounds=(0, 1))

    assert found.value == pytest.approx(1.0) and found.method == "mean, Gaffke 95%"
    assert found.low == pytest.approx(-0.04 + 1.08 * mean([1.05 / 1.08, 1.03 / 1.08, 1.04 / 1.08], bounds=(0, 1)).low)
    assert clipped.high < 1 < found.high < 1.04


@pytest.mark.parametrize(
    ("values", "bounds"),
    [([1 + 5e-7] * 3, (0, 1)), ([-5e-7] * 3, (0, 1)), ([-5e-7, -4e-7, -5e-7], (0, math.inf)), ([5e-7] * 3, (-1, 0))],
)
def test_a_mean_beyond_its_bounds_by_rounding_is_an_end_of_its_interval(values, bounds):
    found = mean(values, bounds=bounds)

    assert found.value in (found.low, found.high)


@pytest.mark.parametrize(("low", "high"), [(0.6, 0.9), (0.1, 0.4), (None, 0.9), (0.1, None), (math.nan, 0.9)])
def test_an_estimate_outside_of_its_interval_cannot_be_built(low, high):
    with pytest.raises(ValueError, match=r"an interval must have two ends around its value, got 0.5"):
        Estimate(0.5, 5, 0, "-", low=low, high=high)


@pytest.mark.parametrize(
    ("times", "value", "low", "high"),
    [
        ((3.0, 1.0, 2.0, 6.0, 5.0, 4.0), 3.5, 1.0, 6.0),  # 1 - 2 / 2**6 = 0.97
        ((1.0, 2.0, 3.0, 4.0, 5.0), 3.0, 0.0, math.inf),  # 1 - 2 / 2**5 = 0.94
        (tuple(map(float, range(1, 10))), 5.0, 2.0, 8.0),  # 1 - 2 (1 + 9) / 2**9 = 0.96
        ((1.0, math.inf, 2.0, math.inf, 3.0, math.inf), math.inf, 1.0, math.inf),
        ((7.0,), 7.0, 0.0, math.inf),
    ],
)
def test_times_have_the_order_statistics_of_their_median_and_never_is_infinite(times, value, low, high):
    estimate = median_time(times)

    assert (estimate.value, estimate.low, estimate.high) == (value, low, high)


def test_a_seed_that_never_got_there_is_no_seed_without_a_result():
    estimate = median_time([math.inf, 1.0, None])

    assert (estimate.n, estimate.n_undefined, estimate.value) == (2, 1, math.inf)
    assert estimate.reason == "the range of the times covers 50%"


def test_p_values_are_corrected_for_their_number():
    assert holm([0.01, None, 0.04, 0.03]) == pytest.approx([0.03, None, 0.06, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_a_difference_of_bounded_values_is_bounded():
    comparison = compare([1.0] * 5, [0.0] * 5, bounds=(0, 1))

    assert (comparison.difference.low, comparison.difference.high) == (pytest.approx(2 * FIVE_OF_FIVE - 1), 1.0)


def test_failed_runs_are_shown_in_a_solved_rate():
    estimate = solved_rate([True, None, False])

    assert (estimate.value, estimate.n, estimate.n_undefined) == (0.5, 2, 1)
    assert solved_rate([None]).reason == "no seed has a result"


def test_the_interquartile_mean_is_of_the_middle_half_of_all_tasks_together():
    estimate = interquartile_mean([[0.0] * 10, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 100.0]])

    assert estimate.value == (5 * 0 + 1 + 2 + 3 + 4 + 5) / 10
    assert estimate.low < 1.5 < estimate.high
    assert (estimate.n, estimate.n_undefined) == (10, 0)


def test_a_value_that_rounds_to_zero_has_no_sign():
    assert str(statistics.Estimate(-0.001, 3, 0, "mean", low=-0.004, high=0.2)) == "0.00 [0.00, 0.20] n = 3"


def test_the_bootstrap_is_stratified_so_tasks_without_spread_stay_as_they_are():
    estimate = interquartile_mean([[0.0] * 10, [1.0] * 10])

    assert (estimate.low, estimate.value, estimate.high) == pytest.approx((0.5, 0.5, 0.5), abs=1e-12)


def test_the_bootstrap_interval_covers_about_what_it_should_at_twenty_seeds():
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


SCORES = [[0.0, 0.1, 0.9, 1.0, 0.4], [0.2, 0.3, 0.3, 0.8, 0.7], [1.0, 1.0, 0.0, 0.6, 0.5]]


@pytest.mark.parametrize(
    ("tasks", "value"),
    [
        (SCORES, (0.2 + 0.3 + 0.3 + 0.4 + 0.5 + 0.6 + 0.7 + 0.8 + 0.9) / 9),  # 15 values: 3 are cut at each side
        ([[0.0, 0.25, 1.0]], (0.0 + 0.25 + 1.0) / 3),  # a quarter of 3 is less than one
        ([[0.0, 0.25, 0.5, 1.0]], 0.375),
        ([[0.0, None, 0.25], [0.5, 1.0, math.nan]], 0.375),
    ],
)
def test_the_iqm_is_rliables_trimmed_mean_of_all_tasks_and_seeds(tasks, value):
    assert iqm(tasks).value == pytest.approx(value, abs=1e-15)


def test_the_interval_of_the_iqm_draws_the_seeds_of_each_task_anew():
    rng = np.random.default_rng(1)
    drawn = np.concatenate([rng.choice(task, (10_000, len(task))) for task in SCORES], axis=1)
    sums = np.sort(drawn, axis=1)[:, 3:12].mean(axis=1)

    estimate = iqm(SCORES)

    assert (estimate.low, estimate.high) == pytest.approx(np.quantile(sums, (0.025, 0.975)), abs=0.02)
    assert (estimate.n, estimate.method) == (5, "IQM, percentiles of a stratified bootstrap 95%")
    constant = iqm([[0.0] * 4, [0.5] * 4, [1.0] * 4])
    assert (constant.low, constant.value, constant.high) == (0.5, 0.5, 0.5)
    assert constant.reason == "the bootstrap samples are equal: no spread to estimate" and estimate.reason is None


def test_one_seed_and_none_have_no_interval_of_the_iqm():
    assert (iqm([[0.5], [1.0]]).value, iqm([[0.5], [1.0]]).reason) == (0.75, "one seed has no interval")
    assert iqm([[None]]).reason == "no seed has a value"


def test_a_mean_is_shown_with_the_standard_deviation_of_seeds():
    estimate = mean_and_std([1.0, 2.0, None, 3.0, 4.0])

    assert (estimate.value, estimate.std) == (2.5, pytest.approx(math.sqrt(5 / 3), abs=1e-15))
    assert str(estimate) == "2.50 ± 1.29 n = 4/5"
    assert mean_and_std([1.0]).reason == "one seed has no standard deviation"


def test_an_interval_of_equal_seeds_is_explained():
    bounded, of_one_value = mean([0.0] * 3, bounds=(-1.0, 1.0)), mean([0.0] * 3, bounds=(0.0, 0.0))

    assert (str(bounded), bounded.reason) == ("0.00 [-0.71, 0.71] n = 3", statistics.EQUAL_SEEDS)
    assert of_one_value.reason is None


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


def test_no_five_pairs_are_enough_and_six_are_where_the_test_is_the_limit():
    assert [compare([1.0] * n, [0.0] * n).p_value <= 0.05 for n in (5, 6)] == [False, True]
    assert [pairs_needed(-1.0, 0.0, comparisons) for comparisons in (1, 2, 10)] == [6, 7, 9]
    assert pairs_needed(100.0, 1.0) == 6
    assert pairs_needed(-0.5, 1.0) == seeds_needed(0.5, 1.0, paired=True) == 34
    assert pairs_needed(0.5, 1.0, 10) == seeds_needed(0.5, 1.0, paired=True, level=0.995) == 58


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1.0, 0.8])
def test_so_many_pairs_find_the_difference_in_four_of_five_cases(ratio):
    rng = np.random.default_rng(0)
    n = pairs_needed(ratio, 1.0)

    found = [compare(rng.normal(ratio, 1.0, n).tolist(), [0.0] * n).p_value <= 0.05 for _ in range(400)]

    assert 0.74 <= np.mean(found) <= 0.88  # 0.8 and three standard errors of 400 cases


def test_a_comparison_that_finds_nothing_says_with_how_many_pairs_it_would():
    pairs = {
        "small": compare([0.2, 0.0, 0.3, 0.1], [0.1] * 4),
        "equal": compare([1.0] * 4, [1.0] * 4),
        "found": compare([1.0 + place / 100 for place in range(12)], [0.0] * 12),
        "none": compare([None] * 4, [0.0] * 4),
    }

    complete = statistics.corrected(pairs)

    expected = pairs_needed(0.05, pairs["small"].std, comparisons=3)
    assert {name: each.needed for name, each in complete.items()} == {
        "small": expected,
        "equal": None,
        "found": None,
        "none": None,
    }


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mean([1.0], bounds=(1.0, 0.0)), "bounds must be a lowest and a highest value, got"),
        (lambda: median_time([-1.0]), "times must be >= 0, got -1.0"),
        (lambda: mean([1.0], level=95), r"level must be in \[0, 1\], got 95"),
        (lambda: compare([1.0], []), "pairs need equally many seeds, got 1 and 0"),
        (lambda: interquartile_mean([]), "needs the values of at least one task"),
        (lambda: interquartile_mean([[1.0]], resamples=1), "resamples must be an integer >= 100, got 1"),
        (lambda: seeds_needed(0.0, 1.0), "difference must be a number > 0, got 0.0"),
        (lambda: pairs_needed(0.1, 1.0, comparisons=0), "comparisons must be an integer >= 1, got 0"),
        (lambda: pairs_needed(0.0, 1.0), "difference must be a number > 0, got 0.0"),
        (lambda: seeds_needed(1e-9, 1.0), "1048576 seeds do not find a difference of 1e-09"),
    ],
)
def test_values_out_of_range_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_without_scipy_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)

    with pytest.raises(ModuleNotFoundError, match=r"pip install 'ctgraph_rl\[stats\]'"):
        statistics.mean([0.0, 1.0], level=0.123)  # no other test has cached its quantile


def test_one_seed_and_a_median_need_no_scipy(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)

    assert str(statistics.mean([1.0])) == "1.00 n = 1"
    assert str(solved_rate([True])) == "1.00 [0.03, 1.00] n = 1"
    assert str(median_time([6.0, 5.0, 4.0, 3.0, 2.0, 1.0])) == "3.50 [1.00, 6.00] n = 6"
