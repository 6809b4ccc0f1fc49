"""Common parts of the published sequences: the labs' environments, task ids and evaluation.

The labs write a goal as a string of 0 and 1, and a task with its image seed before it: ``2:110`` is the goal 2.2.1
with the images of seed 2. Tasks are as `Task.from_json` reads their files.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from ctgraph_rl.checks import is_int, require
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.tasks.configurations import observations_of
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import ReferenceImages, ReferenceOneHot
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.protocol import Evaluation, Protocol
from ctgraph_rl.tasks.task import Task
from curricula.axes import Tasks, sequence

NamedTasks = list[tuple[int, str]]
"""Tasks as image seed and path."""

GoalPool = Sequence[tuple[int, int]]
"""(image seed, depth) of each environment, whose goals are numbered in turn."""

MASK_EVALUATION = Evaluation(num_episodes=10, greedy=True, every=5120)
"""Ten greedy episodes of all tasks every 5,120 frames (10 iterations of 4 workers x 128 steps).

The modulating-masks code and its successors have this protocol. The evaluation before training is ours.
"""


def goal_of(path: str) -> tuple[int, ...]:
    """The goal of a path: ``011`` as 1.2.2."""
    return tuple(int(branch) + 1 for branch in path)


def lab_task(
    path: str, shown: Observations, image_seed: int = 1, fail_reward: float = 0.0, one_hot: bool = False
) -> Task:
    """A task as the labs' files have them: b=2, p=0, one goal, reward 1, no noise.

    Args:
        shown: the ids.
    """
    count = shown.last_id + 1
    return Task(
        CTGraph(2, len(path)),
        goal_of(path),
        replace(shown, reward_cue=True, legacy_index=True, noise_before_rotation=True, cue_wraps=True),
        ReferenceOneHot(count) if one_hot else ReferenceImages(count, image_seed),
        fail_reward=fail_reward,
        reward_noise="multiplicative",
        extra_end_step=True,
    )


def one_wait_image(path: str, image_seed: int) -> Task:
    """A task of the ``pomdp_wait`` environments: one image for all wait states, one for each other state."""
    return lab_task(path, observations_of(CTGraph(2, len(path)), "decisions"), image_seed)


def full_mdp(path: str, image_seed: int, fail_reward: float = 0.0, one_hot: bool = False) -> Task:
    """A task of the fully observable environments: an image, or a vector, per state."""
    return lab_task(path, observations_of(CTGraph(2, len(path)), "full"), image_seed, fail_reward, one_hot=one_hot)


def words(listing: str) -> NamedTasks:
    """``1:01 2:11`` as image seeds and paths."""
    pairs = [word.split(":") for word in listing.split()]
    return [(int(seed), path) for seed, path in pairs]


def pool_ids(tasks: Iterable[tuple[int, str]], pool: GoalPool) -> list[int]:
    """The labs' number of each task: environments one after the other, goals in lexicographic order."""
    first: dict[tuple[int, int], int] = {}
    total = 0
    for entry in pool:
        first[entry] = total
        total += 2 ** entry[1]
    return [first[seed, len(path)] + int(path, 2) for seed, path in tasks]


def labelled(
    name: str,
    source: str,
    tasks: Tasks,
    ids: Sequence[int],
    num_task_ids: int,
    num_frames: int,
    evaluation: Evaluation = MASK_EVALUATION,
) -> Curriculum:
    """An announced block for each task, with one-hot task ids of length ``num_task_ids``; tasks may repeat."""
    protocol = Protocol("one_hot", num_task_ids=num_task_ids, task_ids=one_id_each(tasks, ids))
    return sequence(name, tasks, num_frames, source=source, protocol=protocol, evaluation=evaluation)


def one_id_each(tasks: Tasks, ids: Sequence[int]) -> tuple[int, ...]:
    """The id of each task, by first appearance.

    Raises:
        ValueError: for a task with two ids.
    """
    by_task: dict[Task, int] = {}
    for task, number in zip(tasks, ids, strict=True):
        known = by_task.setdefault(task, number)
        rule = f"a task has one id in a curriculum, but {task.label_parts['goal']} would have {known} and {number}"
        require((known == number, rule))
    return tuple(by_task.values())


def chosen(what: str, number: int, choices: Sequence[Any]) -> Any:
    """The choice of a number from 0.

    Raises:
        ValueError: for a number that does not exist.
    """
    require((is_int(number, 0, len(choices) - 1), f"{what} must be in 0..{len(choices) - 1}, got {number!r}"))
    return choices[number]
