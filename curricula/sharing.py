"""The sequences of L2D2-C: agents that learn the same tasks in different orders and share knowledge.

Nath et al. 2023 (CoLLAs), repository DMIU-ShELL/L2D2-C. Fully observable graphs of depth 2; a task is an image seed and
one of four goals, and its id is 4 (seed - 1) + goal. A separate agent evaluated 25 episodes. It is unknown when,
whether greedily, and whether agents saw task ids: block ends and greedy actions are our choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

from ctgraph_rl.checks import require
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Evaluation
from curricula.published import chosen, full_mdp, labelled

SOURCE = "Nath et al. 2023, CoLLAs; github.com/DMIU-ShELL/L2D2-C"
GOALS = ("00", "01", "10", "11")

CT16_ORDERS = """
0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15
11 5 1 13 10 6 7 2 8 3 14 9 12 15 0 4
5 2 13 1 4 7 8 11 3 12 0 6 10 14 9 15
8 13 10 0 9 12 5 1 4 15 2 11 14 3 7 6
9 2 3 0 5 6 13 15 4 1 14 7 10 11 8 12
4 15 10 12 13 14 2 0 6 3 5 1 9 7 8 11
13 6 14 4 11 7 3 1 15 5 0 8 12 10 9 2
14 4 12 2 1 10 13 5 0 6 3 9 8 11 7 15
13 1 9 12 5 4 7 14 8 3 2 10 6 15 11 0
11 15 10 1 6 0 2 13 8 4 7 5 14 3 12 9
5 11 9 12 2 1 8 14 7 4 10 15 3 0 6 13
4 6 12 2 11 3 8 9 7 5 14 1 10 13 0 15
9 1 8 7 11 13 6 15 12 3 4 2 5 0 10 14
7 1 5 6 9 10 3 11 13 15 2 8 12 4 14 0
10 1 6 7 2 8 14 12 15 11 9 3 0 13 4 5
11 5 15 9 1 4 2 10 3 13 7 0 6 12 14 8
8 1 13 2 6 5 0 7 4 15 10 9 14 11 12 3
4 3 13 14 12 8 10 5 11 15 7 2 0 6 9 1
13 4 1 10 15 2 0 8 11 7 12 5 3 14 6 9
"""


def ct16(num_frames: int = 51_200, agent: int = 0) -> Curriculum:
    """CT16: four image seeds x four goals, each agent in its own order; agent 0 in the order of the ids.

    Args:
        num_frames: frames per task.
        agent: whose order, 0..18.
    """
    orders = [[int(number) for number in line.split()] for line in CT16_ORDERS.strip().splitlines()]
    return _curriculum("ct16", chosen("agent", agent, orders), 16, num_frames)


def ct134(num_frames: int = 51_200) -> Curriculum:
    """CT134: 34 image seeds x four goals without the last two; all 135 agents learn them in the order of the ids.

    Args:
        num_frames: frames per task.
    """
    return _curriculum("ct134", range(134), 136, num_frames)


CT16_64_ORDERS = """
0251057fade7bab8770ae1a7e177323df40f304873b92e7f269a1e54f9cfd239
3aeac4357e89a4eb6faac8390709acc5824ecf6ecd47c39d205b55e4f0cc1fb3
5a393de87dbad2b7fb36aa444ce98859956b1677e867cd6d0e5833c0b0685d7c
c7862d2108a9ac0e6a383833fb429ffbcda4185e63dec76783d5ff9284cef9fe
f3f95a142246ddf83c15d9d24b151143a25110ce108c637cbf53d6b04ee513cc
0a5882bf3622e83727e78d0aac99b0c25e5f93ba85ff7da182c7ed4e53d86608
a27dbb870254544e1702435c0818d06826fccfaa4119e430983e335bcbedd50a
8a9d09edab7b579d385b65e61e7bdda832a2d54edcf32aa07b68956c29d6cbb2
3d7d8340fc061bd2bc227b93229d0757aa49e0c49bbbd41054d5f858e89b1eb3
c5f44033053dd5d51aa3a047a338423f6353aa4c9fcb933d4e10f75f9bd80b44
e18b8a73314d81e388265fdfe8c330a6742dfbcb2cbb6506be2c383596d58c64
d78b1d05eb211c7f6bcb75973a618ca08c4d37231409210da53c44dc48b6a552
"""
"""The tasks of agents 1 to 12, a hexadecimal digit each."""


def ct16_64(num_frames: int | None = None, agent: int = 1, in_order: bool = False) -> Curriculum:
    """CT16_64: 64 short blocks of the 16 tasks of CT16, each agent in its published order.

    Agents 0 and 13 learn each task once, in the order of the ids, for four times the frames.

    Args:
        num_frames: frames per block; None: what the agent had, 12,800, or 51,200 for agents 0 and 13.
        agent: whose order, 0..13.
        in_order: agent 1 learns in the order of the ids, four times, as in the second published file.
    """
    once = "0123456789abcdef"
    orders = [once, *CT16_64_ORDERS.split(), once]
    if in_order:
        orders[1] = once * 4
    order = chosen("agent", agent, orders)
    frames = 51_200 * len(once) // len(order) if num_frames is None else num_frames
    return _curriculum("ct16_64", [int(digit, 16) for digit in order], 16, frames)


class Rotations(NamedTuple):
    """Agents that learn tasks 0, 1, ... in orders rotated to the right."""

    places: tuple[int, ...]  # by how many places for each agent
    num_frames: tuple[int, ...]  # of each agent
    num_task_ids: int


ROTATIONS = {
    2: Rotations((0, 0, 1), (12_800,) * 3, 16),
    4: Rotations((0, 0, 1, 2, 3), (25_600,) * 5, 4),
    8: Rotations((*range(8), 0, 0), (25_600, 25_600, *(51_200,) * 8), 7400),
    16: Rotations((0, *range(16)), (12_800,) * 17, 16),
    32: Rotations((0,) * 39, (40_960,) * 39, 32),
}
"""32 x 32: all 39 agents have one order, settings say 40,960 frames, logs 25,600; ids of length 32 are our choice."""


def rotated(num_tasks: int, num_frames: int | None = None, agent: int = 0) -> Curriculum:
    """The first image seeds' tasks in the order of the ids, rotated to the right by each agent's places.

    Other public versions of the files have other budgets.

    Args:
        num_tasks: 2, 4, 8, 16 or 32.
        num_frames: frames per task; None: what the agent had.
        agent: whose order, counted from 0; the first ones are in the order of the ids.
    """
    require((num_tasks in ROTATIONS, f"num_tasks must be one of {', '.join(map(str, ROTATIONS))}, got {num_tasks!r}"))
    published = ROTATIONS[num_tasks]
    start = -chosen("agent", agent, published.places) % num_tasks
    numbers = [(start + i) % num_tasks for i in range(num_tasks)]
    frames = published.num_frames[agent] if num_frames is None else num_frames
    return _curriculum(f"l2d2c_{num_tasks}x{num_tasks}", numbers, published.num_task_ids, frames)


def _curriculum(name: str, numbers: Sequence[int], num_task_ids: int, num_frames: int) -> Curriculum:
    tasks = tuple(full_mdp(GOALS[number % 4], 1 + number // 4) for number in numbers)
    evaluation = Evaluation(num_episodes=25)
    return labelled(name, SOURCE, tasks, numbers, num_task_ids, num_frames=num_frames, evaluation=evaluation)


NAMED = {
    "ct16": ct16,
    "ct16_64": ct16_64,
    "ct134": ct134,
    **{f"l2d2c_{num_tasks}x{num_tasks}": partial(rotated, num_tasks) for num_tasks in ROTATIONS},
}
