"""The sequences of the modulating-masks paper and of the baselines that were compared with it.

Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110), repository dlpbc/mask-lrl, which has no results. Image seed 1 and one
image for all wait states throughout. A one-hot task id is part of the input of every method. PPO had 4 workers x 128
steps; 10 greedy episodes of all tasks were evaluated every 5,120 frames.
"""

from __future__ import annotations

from collections.abc import Sequence

from ctgraph_rl.checks import by_name, is_int, require
from ctgraph_rl.tasks.curriculum import Curriculum
from curricula.order import sequence
from curricula.published import labelled, one_wait_image, pool_ids, words

MASKS = "Ben-Iwhiwhu et al. 2023, arXiv 2212.11110; github.com/dlpbc/mask-lrl"
BASELINES = "github.com/DMIU-ShELL/LRL-Baselines (2026)"
MOST_DEPTH = 16
"""Beyond it the image set of `single_task` takes gigabytes."""


def ct8(num_frames: int = 102_400) -> Curriculum:
    """CT8: the eight goals of a depth-3 graph in lexicographic order.

    Args:
        num_frames: frames per task.
    """
    tasks = words("1:000 1:001 1:010 1:011 1:100 1:101 1:110 1:111")
    return _curriculum("ct8", MASKS, tasks, ids=range(8), num_ids=8, num_frames=num_frames)


def ct12(num_frames: int = 102_400) -> Curriculum:
    """CT12: the goals of a depth-2 and a depth-3 graph in turns, then the rest of the depth-3 graph.

    Args:
        num_frames: frames per task.
    """
    tasks = words("1:00 1:000 1:01 1:001 1:10 1:010 1:11 1:011 1:100 1:101 1:110 1:111")
    return _curriculum("ct12", MASKS, tasks, ids=range(12), num_ids=12, num_frames=num_frames)


def ct8_md(num_frames: int = 102_400) -> Curriculum:
    """CT8 multi-depth: the first two goals of depth 2, 3, 4 and 5; the ids are those of all 60 goals.

    Args:
        num_frames: frames per task.
    """
    tasks = words("1:00 1:01 1:000 1:001 1:0000 1:0001 1:00000 1:00001")
    ids = pool_ids(tasks, [(1, 2), (1, 3), (1, 4), (1, 5)])
    return _curriculum("ct8_md", MASKS, tasks, ids=ids, num_ids=60, num_frames=num_frames)


def single_task(depth: int = 2, num_frames: int = 102_400) -> Curriculum:
    """A single task, the second goal of CT8 multi-depth at a depth, without a task id: how far plain exploration goes.

    Args:
        depth: d; the goal is 1, ..., 1, 2.
        num_frames: frames, as the single-task experts had.
    """
    require((is_int(depth, 1, MOST_DEPTH), f"depth must be an integer in 1..{MOST_DEPTH}, got {depth!r}"))
    task = one_wait_image("0" * (depth - 1) + "1", image_seed=1)
    return sequence("single_task", (task,), num_frames, source=MASKS)


def ct2_interfering(num_frames: int = 51_200) -> Curriculum:
    """The interfering pair: the first and the last goal of a depth-3 graph, with no decision in common.

    The budget is that of the launcher for elastic weight consolidation and synaptic intelligence.

    Args:
        num_frames: frames per task.
    """
    tasks = words("1:000 1:111")
    return _curriculum("ct2_interfering", BASELINES, tasks, ids=(0, 7), num_ids=8, num_frames=num_frames)


def _curriculum(
    name: str, source: str, named: list[tuple[int, str]], ids: Sequence[int], num_ids: int, num_frames: int
) -> Curriculum:
    tasks = tuple(one_wait_image(path, seed) for seed, path in named)
    return labelled(name, source, tasks, ids, num_ids, num_frames=num_frames)


NAMED = by_name(ct2_interfering, ct8, ct8_md, ct12, single_task)
"""The curricula of this module by name."""
