"""Protocols, switches and blocks: what is refused, and the ids and boundaries that they give."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.scripted import ONE, TWO, sequence

from ctgraph_rl import Block
from ctgraph_rl.learn.segments import segments
from ctgraph_rl.tasks.curriculum import Protocol
from ctgraph_rl.tasks.switch import ByEpisode, Drift

THREE = replace(ONE, goal_reward=3.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task_id": "shown"}, "task_id must be one of hidden, one_hot, at_boundaries, got 'shown'"),
        ({"boundaries": "blurred"}, "boundaries must be one of announced, hidden, got 'blurred'"),
        ({"task_id": "one_hot", "num_task_ids": 0}, "num_task_ids must be an integer in 1..1048576, got 0"),
        ({"task_id": "one_hot", "num_task_ids": 2.5}, "num_task_ids must be an integer in 1..1048576, got 2.5"),
        (
            {"task_id": "one_hot", "task_ids": ()},
            r"task_ids must be integers in 0..1048576, one for each task, got \(\)",
        ),
        ({"task_id": "one_hot", "task_ids": (0, -1)}, r"task_ids must be integers in 0..1048576, .*got \(0, -1\)"),
        ({"task_id": "one_hot", "task_ids": (True,)}, r"task_ids must be integers in 0..1048576, .*got \(True,\)"),
        ({"task_id": "one_hot", "task_ids": 3}, "task_ids must be integers in 0..1048576, one for each task, got 3"),
        ({"task_id": "one_hot", "task_ids": (1, 0, 1)}, r"task_ids must differ from each other, got \(1, 0, 1\)"),
        ({"task_ids": (0, 1)}, "num_task_ids and task_ids say nothing where task_id is hidden: leave them out"),
        ({"num_task_ids": 4}, "num_task_ids and task_ids say nothing where task_id is hidden: leave them out"),
        (
            {"task_id": "at_boundaries", "boundaries": "hidden"},
            "task_id cannot be given at_boundaries that are hidden; use one_hot, or announced ones",
        ),
    ],
)
def test_a_protocol_that_cannot_be_followed_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Protocol(**arguments)


@pytest.mark.parametrize(
    ("protocol", "message"),
    [
        (Protocol("one_hot", task_ids=(0,)), "task_ids must be one for each of 2 tasks, got 1"),
        (Protocol("one_hot", task_ids=(0, 1, 2)), "task_ids must be one for each of 2 tasks, got 3"),
        (Protocol("one_hot", num_task_ids=1), "num_task_ids=1 is too few for task id 1: needs at least 2"),
        (
            Protocol("at_boundaries", num_task_ids=5, task_ids=(5, 0)),
            "num_task_ids=5 is too few for task id 5: needs at least 6",
        ),
    ],
)
def test_a_protocol_must_fit_the_tasks_of_its_curriculum(protocol, message):
    with pytest.raises(ValueError, match=message):
        sequence(protocol=protocol)


def test_ids_given_at_boundaries_need_blocks_of_one_task():
    told = Protocol("at_boundaries")

    assert sequence(Block((ONE, ONE), 8), Block(TWO, 8), protocol=told).task_ids == {ONE: 0, TWO: 1}
    for block in (Block((ONE, TWO), 8), Block((ONE, TWO), 8, ByEpisode())):
        with pytest.raises(ValueError, match="task ids given at_boundaries need blocks of one task each"):
            sequence(Block(ONE, 8), block, protocol=told)


def test_ids_are_positions_unless_they_are_given():
    assert sequence(protocol=Protocol("one_hot")).task_ids == {ONE: 0, TWO: 1}
    assert sequence(protocol=Protocol("one_hot", task_ids=[3, 1])).task_ids == {ONE: 3, TWO: 1}
    lengths = [Protocol("one_hot", num_task_ids=n, task_ids=ids).length(2) for n, ids in ((None, None), (7, (1, 4)))]
    assert lengths == [2, 7]
    assert Protocol("one_hot", task_ids=(1, 4)).length(2) == 5


@pytest.mark.parametrize(
    ("switch", "tasks", "message"),
    [
        (Drift, (ONE, TWO), "switch must be a frozen dataclass such as Drift.100., or None, got <class"),
        ("drift", (ONE, TWO), "switch must be a frozen dataclass such as Drift.100., or None, got 'drift'"),
        (Drift(3), ONE, "a block with a switch needs at least two tasks, got one; leave the switch out"),
    ],
)
def test_a_block_with_a_wrong_switch_is_refused(switch, tasks, message):
    with pytest.raises(ValueError, match=message):
        Block(tasks, 8, switch)


def test_rows_of_a_block_with_a_switch_all_begin_with_the_first_task():
    assert Block((ONE, TWO, THREE), 8, Drift(3)).rows(4) == [ONE] * 4


@pytest.mark.parametrize("parts", [{"protocol": "hidden"}, {"protocol": Protocol}, {"evaluation": Protocol()}])
def test_a_curriculum_of_wrong_parts_is_refused(parts):
    with pytest.raises(ValueError, match=r"(protocol must be a Protocol|evaluation must be an Evaluation), got"):
        sequence(**parts)


def test_boundaries_cut_a_curriculum_into_segments_only_where_they_are_announced():
    blocks = (Block(ONE, 8), Block(TWO, 8), Block(ONE, 4))

    announced, hidden = (sequence(*blocks, protocol=Protocol(boundaries=how)) for how in ("announced", "hidden"))

    cut = [segment.blocks for segment in segments(announced, 0)]
    assert cut == [(blocks[0],), (blocks[1],), (blocks[2],)]
    assert [segment.blocks for segment in segments(hidden, 0)] == [blocks]
