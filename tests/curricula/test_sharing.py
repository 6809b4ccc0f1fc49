"""The published sequences of agents that share: each agent's order, ids and budget."""

from __future__ import annotations

import pytest
from helpers.task_families import listing

import curricula
from ctgraph_rl.tasks.protocol import Protocol


@pytest.mark.parametrize(
    ("name", "agent", "ids", "num_ids", "num_frames"),
    [
        ("l2d2c_2x2", 2, (1, 0), 16, 12_800),
        ("l2d2c_4x4", 0, (0, 1, 2, 3), 4, 25_600),
        ("l2d2c_4x4", 2, (3, 0, 1, 2), 4, 25_600),
        ("l2d2c_4x4", 4, (1, 2, 3, 0), 4, 25_600),
        ("l2d2c_8x8", 1, (7, 0, 1, 2, 3, 4, 5, 6), 7400, 25_600),
        ("l2d2c_8x8", 2, (6, 7, 0, 1, 2, 3, 4, 5), 7400, 51_200),
        ("l2d2c_8x8", 9, (0, 1, 2, 3, 4, 5, 6, 7), 7400, 51_200),
        ("l2d2c_32x32", 38, tuple(range(32)), 32, 40_960),
        ("l2d2c_16x16", 16, (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0), 16, 12_800),
    ],
)
def test_agents_learn_rotated_orders(name, agent, ids, num_ids, num_frames):
    curriculum = curricula.load(name, agent=agent)

    assert curriculum.protocol == Protocol("one_hot", num_task_ids=num_ids, task_ids=ids)
    assert {block.num_frames for block in curriculum.blocks} == {num_frames}


@pytest.mark.parametrize(
    ("settings", "start", "end", "blocks", "num_frames"),
    [
        ({}, (0, 2, 5, 1), (12, 15, 13, 2, 3, 9), 64, 12_800),
        ({"agent": 12}, (13, 7, 8, 11), (6, 10, 5, 5, 2), 64, 12_800),
        ({"agent": 1, "in_order": True}, (*range(16), 0, 1), (*range(14, 16), *range(16)), 64, 12_800),
        ({"agent": 13}, (0, 1, 2), (14, 15), 16, 51_200),
        ({"agent": 5, "num_frames": 640}, (15, 3, 15, 9), (1, 3, 12, 12), 64, 640),
    ],
)
def test_agents_of_ct16_64_learn_the_tasks_of_ct16_in_their_published_orders(settings, start, end, blocks, num_frames):
    curriculum = curricula.load("ct16_64", **settings)

    ct16 = curricula.load("ct16")
    ids = [ct16.tasks.index(task) for block in curriculum.blocks for task in block.tasks]
    assert (tuple(ids[: len(start)]), tuple(ids[-len(end) :])) == (start, end)
    assert [block.num_frames for block in curriculum.blocks] == [num_frames] * blocks
    assert dict(zip(curriculum.tasks, curriculum.protocol.task_ids, strict=True)) == {
        task: number for number, task in enumerate(ct16.tasks)
    }


def test_all_agents_of_ct16_64_have_random_orders_of_64_tasks_but_the_first_and_the_last():
    orders = [[block.tasks for block in curricula.load("ct16_64", agent=agent).blocks] for agent in range(14)]

    assert [len(order) for order in orders] == [16, *[64] * 12, 16]
    assert len({tuple(order) for order in orders}) == 13


def test_the_ladders_of_mosaic_are_nested_goals_down_to_depth_14():
    ladder = curricula.load("mosaic_ladder")

    deepest = [goal for goal in listing(ladder) if len(goal) == 16]
    assert deepest == ["1:01011010010101", "2:11010101101110"]
    assert [goal[:4] for goal in listing(ladder)] == ["1:01"] * 13 + ["2:11"] * 13
    assert [len(goal) - 2 for goal in listing(ladder)] == [*range(2, 15)] * 2
    assert ladder.protocol.num_task_ids == 2 * (2**15 - 4) == 65_528
    assert listing(curricula.load("mosaic_ladder", agent=25)) == deepest[1:]
