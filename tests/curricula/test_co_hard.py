"""The confounding graph that memories are compared on."""

from __future__ import annotations

import pytest

import curricula


@pytest.mark.parametrize(("depth", "length"), [(2, 6), (2, 30), (3, 100), (4, 300)])
def test_an_expected_length_decides_how_long_waits_are(depth, length):
    [task] = curricula.load("co_hard", depth=depth, expected_length=length).tasks

    assert task.graph.expected_episode_length == pytest.approx(length)
    assert task.goal == (1, 2, 1, 2)[:depth]


@pytest.mark.parametrize(("unique", "ceiling"), [(False, 0.0), (True, 1.0)])
def test_the_goal_needs_memory_where_decisions_share_an_image(unique, ceiling):
    [task] = curricula.load("co_hard", unique_decisions=unique, num_wait_images=7).tasks
    ids = task.observations

    assert task.memoryless_ceiling(deterministic=True) == ceiling
    first, last = ids.wait_ids
    assert last - first + 1 == 7
    assert ids.decision_ids[1] - ids.decision_ids[0] == (2 if unique else 0)
    assert ids.decision_ids[1] < first and last + 1 == ids.end_ids[0] == ids.end_ids[1] == task.images.num_images - 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"expected_length": 5}, "expected_length must be a number >= 6 at depth 2, got 5"),
        ({"depth": 0}, r"depth must be an integer in 1..16, got 0"),
        ({"unique_decisions": 1}, "unique_decisions must be true or false"),
    ],
)
def test_what_cannot_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        curricula.load("co_hard", **arguments)
