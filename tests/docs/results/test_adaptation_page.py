"""docs/results/adaptation.md: made from the raw results beside it, and what it says of them holds."""

from __future__ import annotations

from itertools import product
from statistics import fmean

import pytest
from helpers.paths import CHECKOUT
from studies import adaptation, adaptation_swap

import curricula


def test_the_page_is_made_from_the_raw_results():
    assert adaptation.page() == (CHECKOUT / "docs" / "results" / "adaptation.md").read_text(encoding="utf-8")


def test_the_best_policy_without_memory_has_the_mean_of_the_ceilings_of_the_goals():
    (block,) = curricula.load("nm_uniform_goals", kind="surjective").blocks

    assert fmean(task.memoryless_ceiling() for task in block.tasks) == pytest.approx(adaptation.WITHOUT_MEMORY)


def test_the_best_search_for_a_swapped_goal_is_what_playing_it_gives():
    """Goals 0 to 3 in turn; after a miss of a known goal, the others in turn."""
    misses = []
    for first, second in product(range(4), repeat=2):
        others = [goal for goal in range(4) if goal != first]
        misses.append(first + (0 if first == second else 1 + others.index(second)))

    assert adaptation_swap.best_search(4, swapped=True) == pytest.approx(1 - fmean(misses) / 100)
    assert adaptation_swap.best_search(4, swapped=False) == pytest.approx(0.985)


@pytest.mark.parametrize("swapped", [False, True])
def test_penn_a_is_within_a_point_of_the_best_search(swapped):
    (share,) = adaptation_swap.shares("penn_a", held_out=swapped)

    assert abs(adaptation_swap.best_search(4, swapped) - share) < 0.01
