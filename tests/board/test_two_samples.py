"""The test of scores against submitted ones: its false alarms and its power are as stated."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ctgraph_rl.board import two_samples
from ctgraph_rl.board.two_samples import ALPHA, POWER, compare_samples, detectable, runs_needed


def share_found(sizes: tuple[int, int], drop: float, draw) -> float:
    samples = draw((1_000, sum(sizes)))
    return float(
        np.mean([compare_samples(row[: sizes[0]], row[sizes[0] :] - drop).p_value <= ALPHA for row in samples])
    )


@pytest.mark.parametrize("sizes", [(5, 2), (10, 3)])
def test_the_stated_drop_is_found_with_the_stated_chance(sizes, monkeypatch):
    rng = np.random.default_rng(7)
    drop = detectable(*sizes)
    monkeypatch.setattr(two_samples, "find_least", lambda *_: 0.0)  # the interval takes the time

    assert share_found(sizes, drop, rng.standard_normal) == pytest.approx(POWER, abs=0.05)


@pytest.mark.parametrize("kind", ["normal", "two values"])
def test_equal_distributions_are_called_different_as_seldom_as_stated(kind, monkeypatch):
    detectable(10, 3)
    monkeypatch.setattr(two_samples, "find_least", lambda *_: 0.0)
    rng = np.random.default_rng(7)
    draw = rng.standard_normal if kind == "normal" else lambda shape: rng.integers(0, 2, shape).astype(float)

    assert share_found((10, 3), 0.0, draw) <= ALPHA + 3 * math.sqrt(ALPHA * (1 - ALPHA) / 1_000)


@pytest.mark.parametrize("sizes", [(5, 2), (10, 3), (3, 3)])
def test_the_p_value_is_that_of_scipy(sizes):
    stats = pytest.importorskip("scipy.stats")
    rng = np.random.default_rng(7)
    for scores in (rng.integers(0, 3, sum(sizes)) / 4, rng.random(sum(sizes)).round(1)):
        submitted, found = scores[: sizes[0]], scores[sizes[0] :]

        expected = stats.permutation_test(
            (submitted, found), lambda _, last: last.sum().round(9), alternative="less", n_resamples=np.inf
        )

        assert compare_samples(submitted, found).p_value == pytest.approx(expected.pvalue, abs=1e-12)


def test_a_test_that_can_find_nothing_says_so_and_how_many_runs_it_needs():
    found = compare_samples([1.0, 1.0, 0.9], [0.0, 0.1])

    assert found.is_blind
    assert not found.is_lower
    assert "so few runs cannot show any drop" in str(found)
    assert [runs_needed(submitted) for submitted in (1, 3, 5, 10, 20)] == [19, 3, 2, 2, 1]


def test_the_interval_of_the_drop_agrees_with_the_test():
    found = compare_samples([1.0, 0.9, 0.95, 1.0, 0.85], [0.5, 0.6])

    assert found.is_lower
    assert 0 < found.low < 0.94 - 0.55 < found.high
    assert (
        compare_samples([1.0, 0.9, 0.95, 1.0, 0.85], [0.5 + found.low + 1e-6, 0.6 + found.low + 1e-6]).is_lower is False
    )


def test_equal_scores_without_spread_are_no_drop():
    assert not compare_samples([1.0] * 5, [1.0] * 2).is_lower
    assert compare_samples([1.0] * 5, [0.99] * 2).is_lower
