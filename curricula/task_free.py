"""A task-free protocol: what can change without notice, in three curricula of the same four tasks.

Task-free continual learning (Zeno et al. 2018, arXiv 1803.10123; Aljundi et al. 2019, arXiv 1812.03596) gives a learner
neither ids nor boundaries. The change points are known to those who measure a detector's delays and false alarms. The
graph is that of CT-FO-B1, so no task needs memory.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

from ctgraph_rl.checks import at_least_one, by_name, one_of, require
from ctgraph_rl.tasks.configurations import ct_fo_b1
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Block, Protocol
from ctgraph_rl.tasks.switch import Drift
from ctgraph_rl.tasks.task import Task
from curricula.axes import all_goals, image_seeds, sequence

TASK_FREE = "ctgraph_rl, after Zeno et al. 2018, arXiv 1803.10123, and Aljundi et al. 2019, arXiv 1812.03596"

HIDDEN = Protocol(boundaries="hidden")

DIFFER = ("goals", "inputs", "both")

ROUNDS = ((0, 1, 2, 3), (1, 3, 0, 2), (3, 1, 2, 0))
"""Each task once per round, none twice in a row."""

LONGEST_EPISODE = 7


def task_free_abrupt(num_frames: int = 102_400, differ: str = "goals", image_seed: int = 1) -> Curriculum:
    """Four tasks, one after the other, without notice: changes are abrupt, at known frames.

    They differ in ``goals``, on the same images; in ``inputs``, four image sets with one goal; or in ``both``.

    Args:
        num_frames: frames per task.
        differ: what changes: ``goals``, ``inputs`` (images) or ``both``.
        image_seed: seed of the first image set; further ones have the next seeds.
    """
    return _curriculum("task_free_abrupt", _tasks(differ, image_seed), num_frames)


def task_free_gradual(
    num_frames: int = 102_400, differ: str = "goals", image_seed: int = 1, num_rows: int = 256
) -> Curriculum:
    """Four tasks, with a gradual change from each to the next, as long as a stay: there is no point of change.

    Within a change each episode has the next task with a probability that rises from 0 to 1 by the time that the
    longest episodes take.

    Args:
        num_frames: frames of each stay, and of each change.
        differ: what changes: ``goals``, ``inputs`` (images) or ``both``.
        image_seed: seed of the first image set; further ones have the next seeds.
        num_rows: environments of the agent, for the number of episodes of a change.
    """
    require(*at_least_one(num_frames=num_frames, num_rows=num_rows))
    tasks = _tasks(differ, image_seed)
    drift = Drift(max(num_frames // (num_rows * LONGEST_EPISODE), 1))
    blocks = [Block((tasks[0],), num_frames)]
    for pair in pairwise(tasks):
        blocks += [Block(pair, num_frames, drift), Block(pair[1:], num_frames)]
    return Curriculum("task_free_gradual", 1, TASK_FREE, tuple(blocks), protocol=HIDDEN)


def task_free_recurring(num_frames: int = 102_400, differ: str = "goals", image_seed: int = 1) -> Curriculum:
    """Four tasks, three times each in different orders, without notice: is a task that returns recognised?

    Args:
        num_frames: frames per stay.
        differ: what changes: ``goals``, ``inputs`` (images) or ``both``.
        image_seed: seed of the first image set; further ones have the next seeds.
    """
    tasks = _tasks(differ, image_seed)
    return _curriculum("task_free_recurring", [tasks[place] for order in ROUNDS for place in order], num_frames)


def _curriculum(name: str, tasks: list[Task], num_frames: int) -> Curriculum:
    return sequence(name, tasks, num_frames, version=1, source=TASK_FREE, protocol=HIDDEN)


def _tasks(differ: str, image_seed: int) -> list[Task]:
    require(*one_of(DIFFER, differ=differ))
    task = ct_fo_b1(image_seed=image_seed)
    seeds = [image_seed + number for number in range(4)]
    goals = list(all_goals(task))
    if differ == "goals":
        return goals
    shown = list(image_seeds(task, seeds))
    return shown if differ == "inputs" else [replace(s, goal=g.goal) for s, g in zip(shown, goals, strict=True)]


NAMED = by_name(task_free_abrupt, task_free_gradual, task_free_recurring)
