"""The verdict on a sentence: what effects, their number and their room make of it."""

from __future__ import annotations

import pytest
from studies.verdicts import (
    AGREES,
    DISAGREES,
    UNKNOWN,
    Effect,
    compare_times,
    later,
    pairs,
    undecided,
)

from ctgraph_rl.report import statistics

CLEAR = (0.9, 0.8, 1.0, 0.9, 0.7, 0.9, 1.0, 0.9)


def turned(values):
    return [-value for value in values]


@pytest.mark.parametrize(
    ("values", "absent", "verdict"),
    [
        (CLEAR, False, AGREES),
        (turned(CLEAR), False, DISAGREES),
        (CLEAR, True, DISAGREES),
        (turned(CLEAR), True, AGREES),
        ((0.9, -0.9, 0.8, -0.8, 1.0, -1.0, 0.9, -0.9), False, UNKNOWN),  # groups that were shuffled
        (CLEAR[:3], False, UNKNOWN),  # too few seeds
        ((None,) * 8, False, UNKNOWN),  # an empty column
        ((0.0,) * 10, False, DISAGREES),  # an effect of 0.5 would have been seen
    ],
)
def test_the_verdict_follows_from_the_interval_and_changes_with_the_sign_and_the_groups(values, absent, verdict):
    assert Effect(values, counts=0.5, room=1.0, absent=absent).verdict == verdict


@pytest.mark.parametrize("values", [CLEAR, (0.0,) * 10])
def test_nothing_is_said_where_no_effect_that_counts_was_possible(values):
    assert Effect(values, counts=0.5, room=0.4).verdict == UNKNOWN


def test_the_smallest_effect_is_the_least_mean_of_these_seeds_whose_interval_is_above_0():
    effect = Effect((0.1, 0.5, -0.1, 0.3, 0.0, 0.2, 0.4, 0.1), counts=0.5, room=1.0)
    by = effect.smallest - sum(effect.values) / 8

    seen = statistics.mean([value + by + 1e-6 for value in effect.values], bounds=(-1, 1))
    not_seen = statistics.mean([value + by - 1e-3 for value in effect.values], bounds=(-1, 1))
    assert seen.low > 0 > not_seen.low
    assert Effect((0.9, 1.0, 0.8), counts=0.5, room=1.0).smallest is None  # no effect of three seeds would be seen


def test_more_seeds_would_do_where_they_differ_more():
    equal, spread = (Effect(values, counts=0.5, room=1.0) for values in ((0.3,) * 4, (1.0, -0.4, 0.9, -0.3)))

    assert statistics.mean([0.5] * equal.seeds, bounds=(-1, 1)).low > 0
    assert statistics.mean([0.5] * (equal.seeds - 1), bounds=(-1, 1)).low <= 0
    assert spread.seeds > equal.seeds
    assert Effect((0.3,) * 4, counts=0.01, room=1.0).seeds is None  # 199 seeds that all had it would not see it


def test_a_time_that_was_not_reached_is_later_than_all_that_were():
    assert [later("", "51200"), later("51200", ""), later("", ""), later("10240", "10240")] == [1, -1, 0, 0]

    slow = [{"seed": "0", "a": "", "b": "200"}, {"seed": "1", "a": "100", "b": ""}]
    fast = [{"seed": "0", "a": "900", "b": "100"}, {"seed": "1", "a": "100", "b": ""}]
    words, effect = compare_times(slow, fast, ("a", "b"))
    assert (words, effect.values, effect.room) == ("later in 2 of 4 pairs, earlier in 0", [1.0, 0.0], 0.75)
    assert compare_times(fast, slow, ("a", "b"))[1].values == [-1.0, 0.0]
    emptied = [{**line, "a": "", "b": ""} for line in slow]
    assert compare_times(emptied, emptied, ("a", "b"))[1].room == 0


@pytest.mark.parametrize("seeds", [["0", "2"], ["0"], ["0", "0"], []])
def test_pairs_have_equal_seeds_each_once(seeds):
    with pytest.raises(ValueError, match="pairs need the same seeds, each once, got"):
        pairs([{"seed": seed} for seed in seeds], [{"seed": "0"}, {"seed": "1"}])


def test_a_difference_that_was_found_is_not_called_undecided():
    open_, found = (statistics.compare(values, [0.5] * 8, bounds=(0, 1)) for values in ([0.5, 0.6] * 4, [0.9] * 8))
    one, ten = (statistics.pairs_needed(0.05, open_.std, number) for number in (1, 10))

    assert undecided(open_) == f"0.05 [-0.34, 0.40] ({one} pairs would do)"
    assert undecided(statistics.corrected(dict.fromkeys(range(10), open_))[0]).endswith(f"({ten} pairs would do)")
    assert undecided(statistics.compare([0.4, 0.6] * 4, [0.5] * 8)).endswith("]")  # no difference
    with pytest.raises(ValueError, match=r"p = 0\.0078125 is not undecided"):
        undecided(found)
