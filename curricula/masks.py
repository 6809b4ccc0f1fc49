"""The sequences of CT8 to CT29: plain goals, and nested goals of growing depth; one image for all wait states.

Modulating masks (Ben-Iwhiwhu et al. 2023, TMLR, arXiv 2212.11110), repository dlpbc/mask-lrl, which has no results. PPO
had 4 workers x 128 steps; 10 greedy episodes of all tasks were evaluated every 5,120 frames. MaskSC and AMSC ("Lifelong
Context-Aware Retrieval and Composition for Scalable Knowledge Reuse", 2026), LRL-Baselines (2026), MOSAIC (Nath et al.
2025, arXiv 2506.05577) and its predecessor: repositories under github.com/DMIU-ShELL. The task id is the task's number
among all goals of some environments; the launcher of AMSC hides it.

A family is one image seed and one path; its task at depth d has the path's first d decisions. The fourth family exists
twice: consistent, or skipping depth 5, with depths 2, 3, 4, 6, 7, 8 and 9 in the groups of depth 2 to 8, named
``..._skips_d5``. Launchers of nested goals gave single agents 51,200 frames a task; the scripts' default is 102,400.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain, product
from typing import NamedTuple

from ctgraph_rl.checks import by_name, is_int, require
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Evaluation
from curricula.axes import sequence
from curricula.published import MASK_EVALUATION, GoalPool, NamedTasks, chosen, labelled, one_wait_image, pool_ids, words

MASKS = "Ben-Iwhiwhu et al. 2023, arXiv 2212.11110; github.com/dlpbc/mask-lrl"
MASKSC = "github.com/DMIU-ShELL/MaskSC (2026)"
AMSC = "github.com/DMIU-ShELL/AMSC (2026)"
LRL = "github.com/DMIU-ShELL/LRL-Baselines (2026)"
MOSAIC = "Nath et al. 2025, arXiv 2506.05577; github.com/DMIU-ShELL/MOSAIC"
L2D2C = "github.com/DMIU-ShELL/L2D2-C"

MOST_DEPTH = 16
"""Beyond it the images of `single_task` take gigabytes."""

PATHS = {1: "01011010010101", 2: "11010101101110", 3: "00100110", 4: "10011100"}

SEED_SETS = {1: (1, 2, 3, 4), 2: (3, 4, 5, 6), 3: (5, 6, 7, 8), 4: (7, 8, 9, 10), 5: (9, 10, 11, 12)}

FAMILIES = tuple(product(PATHS, range(2, 12)))

DEPTH_3 = ((1, 3),)


def ladder(family: int, deepest: int = 8) -> NamedTasks:
    """Return a family's tasks, from depth 2 on."""
    return [(family, PATHS[family][:depth]) for depth in range(2, deepest + 1)]


def in_turns(*families: NamedTasks) -> NamedTasks:
    """Return at each depth a task of every family."""
    return list(chain.from_iterable(zip(*families, strict=True)))


FOURTH_SKIPS_D5 = words("4:11 4:110 4:1101 4:110111 4:1101110 4:11011100 4:110111001")
BLOCKED_SKIPS_D5 = [*ladder(1), *ladder(2), *ladder(3), *FOURTH_SKIPS_D5]

RANDOM_SKIPS_D5 = """3:001001 3:0010011 2:11010101 3:00100 1:01011 1:010 3:001 2:1101010 1:01 4:110111 4:11 2:110101
    4:110111001 3:00 1:0101 2:110 4:1101 4:11011100 1:0101101 2:11 2:11010 3:00100110 2:1101 1:010110 4:110 3:0010
    4:1101110 1:01011010"""


class Listed(NamedTuple):
    """A sequence of which only the frames change."""

    about: str
    source: str
    tasks: NamedTasks  # each as family, or image seed, and path
    num_frames: int = 51_200
    pool: GoalPool | None = FAMILIES  # environments whose goals have the ids; None: the ids are the places
    seed_set: int = 1


LISTED = {
    "ct8": Listed(
        "CT8: the eight goals of a depth-3 graph in lexicographic order.",
        MASKS,
        words("1:000 1:001 1:010 1:011 1:100 1:101 1:110 1:111"),
        102_400,
        DEPTH_3,
    ),
    "ct12": Listed(
        "CT12: the goals of a depth-2 and a depth-3 graph in turns, then the rest of the depth-3 graph.",
        MASKS,
        words("1:00 1:000 1:01 1:001 1:10 1:010 1:11 1:011 1:100 1:101 1:110 1:111"),
        102_400,
        None,
    ),
    "ct8_md": Listed(
        "CT8 multi-depth: the first two goals of depth 2, 3, 4 and 5; the ids are those of all 60 goals.",
        MASKS,
        words("1:00 1:01 1:000 1:001 1:0000 1:0001 1:00000 1:00001"),
        102_400,
        ((1, 2), (1, 3), (1, 4), (1, 5)),
    ),
    "ct2_interfering": Listed(
        "The interfering pair: the first and the last goal of a depth-3 graph, with no decision in common.",
        LRL,  # the budget is that of the launcher for elastic weight consolidation and synaptic intelligence
        words("1:000 1:111"),
        pool=DEPTH_3,
    ),
    "ct28": Listed(
        "CT28 interleaved: four families with nested goals, depth 2 to 8; at each depth one task of every family.",
        MASKSC,
        in_turns(ladder(1), ladder(2), ladder(3), ladder(4)),
    ),
    "ct28_interleaved_skips_d5": Listed(
        "CT28 interleaved as in an older file: its fourth family skips depth 5, an inconsistency.",
        MASKSC,
        in_turns(ladder(1), ladder(2), ladder(3), FOURTH_SKIPS_D5),
    ),
    "ct28_random_skips_d5": Listed(
        "CT28 in one fixed random order; its fourth family skips depth 5, an inconsistency.",
        LRL,
        words(RANDOM_SKIPS_D5),
    ),
    "ct28_one_branch": Listed(
        "The first family of CT28 by itself with image seed 9, depth 2 to 8; the published file is not valid JSON.",
        LRL,
        ladder(1),
        seed_set=5,
    ),
    "ct10": Listed("CT10: one family with nested goals, depth 2 to 11.", LRL, ladder(1, 11)),
    "ct14_half_1": Listed("CT14, first half: the first family, depth 2 to 8.", LRL, ladder(1)),
    "ct14_half_2": Listed("CT14, second half: the second family, depth 2 to 8.", LRL, ladder(2)),
    "ct14_md": Listed(
        "CT14 multi-depth: the first and the second family in turns, depth 2 to 8.",
        LRL,
        in_turns(ladder(1), ladder(2)),
    ),
    "ct8_interleaved": Listed(
        "CT8 interleaved: the first and the second family in turns, depth 2 to 5.",
        MASKSC,
        in_turns(ladder(1, 5), ladder(2, 5)),
    ),
    "ct29_recovery": Listed(
        "CT29 recovery: three families in turns, then depth 8 of the fourth unprepared, its ladder, and depth 8 again.",
        AMSC,
        [*in_turns(ladder(1), ladder(2), ladder(3)), *ladder(4)[-1:], *ladder(4)],
    ),
}


def _listed(name: str, row: Listed) -> Callable[..., Curriculum]:
    def make(num_frames: int = row.num_frames) -> Curriculum:
        return _curriculum(name, row.source, row.tasks, num_frames, row.pool, seed_set=row.seed_set)

    make.__name__ = name
    make.__doc__ = f"{row.about}\n\nArgs:\n    num_frames: frames per task."
    return make


def single_task(depth: int = 2, num_frames: int = 102_400) -> Curriculum:
    """A single task, the second goal of CT8 multi-depth at a depth, without a task id: how far plain exploration goes.

    Args:
        depth: d; the goal is 1, ..., 1, 2.
        num_frames: frames, as the single-task experts had.
    """
    require((is_int(depth, 1, MOST_DEPTH), f"depth must be an integer in 1..{MOST_DEPTH}, got {depth!r}"))
    task = one_wait_image("0" * (depth - 1) + "1", image_seed=1)
    return sequence("single_task", (task,), num_frames, source=MASKS)


def ct28_blocked_skips_d5(num_frames: int = 51_200, seed_set: int = 1) -> Curriculum:
    """CT28 family after family; its fourth family skips depth 5, an inconsistency.

    Args:
        num_frames: frames per task.
        seed_set: which of the five published sets of image seeds, 1..5.
    """
    return _curriculum("ct28_blocked_skips_d5", LRL, BLOCKED_SKIPS_D5, num_frames, seed_set=seed_set)


def ct28_mosaic_skips_d5(num_frames: int = 102_400, seed_set: int = 1, agent: int | None = None) -> Curriculum:
    """CT28 of MOSAIC; its fourth family skips depth 5, an inconsistency.

    There 28 agents that share knowledge had one task each. It is unknown whether they saw task ids and when 50 episodes
    evaluated a task. Greedy actions are our choice.

    Args:
        num_frames: frames per task.
        seed_set: which of the five sets of image seeds, 1..5.
        agent: a single agent's task, 0..27; None: all tasks in turn, which is ours.
    """
    tasks = _of_agent(BLOCKED_SKIPS_D5, agent)
    evaluation = Evaluation(num_episodes=50)
    return _curriculum("ct28_mosaic_skips_d5", MOSAIC, tasks, num_frames, seed_set=seed_set, evaluation=evaluation)


def ct20(num_frames: int = 102_400, agent: int | None = None) -> Curriculum:
    """CT20: two families with nested goals, depth 2 to 11, one after the other.

    Twenty agents that share knowledge had one task each. Of several files this is the one with 20 tasks; which one the
    results used is unknown. The evaluation is our default.

    Args:
        num_frames: frames per task.
        agent: a single agent's task, 0..19; None: all tasks in turn, which is ours.
    """
    return _two_ladders("ct20", L2D2C, 11, num_frames, agent)


def mosaic_ladder(num_frames: int = 102_400, agent: int | None = None) -> Curriculum:
    """The ladders of MOSAIC: two families with nested goals, depth 2 to 14, one after the other.

    Two files, ct14_md_seed1 and ct14_md_seed2, hold the 13 tasks of a family each. The frames are those of MOSAIC's 28
    tasks; the evaluation is our default.

    Args:
        num_frames: frames per task.
        agent: a single agent's task, 0..25; None: all tasks in turn, which is ours.
    """
    return _two_ladders("mosaic_ladder", MOSAIC, 14, num_frames, agent)


def _two_ladders(name: str, source: str, deepest: int, num_frames: int, agent: int | None) -> Curriculum:
    tasks = _of_agent([*ladder(1, deepest), *ladder(2, deepest)], agent)
    pool = tuple(product((1, 2), range(2, deepest + 1)))
    return _curriculum(name, source, tasks, num_frames, pool, evaluation=Evaluation())


def _of_agent(tasks: NamedTasks, agent: int | None) -> NamedTasks:
    return tasks if agent is None else [chosen("agent", agent, tasks)]


def _curriculum(
    name: str,
    source: str,
    named: NamedTasks,
    num_frames: int,
    pool: GoalPool | None = FAMILIES,
    seed_set: int = 1,
    evaluation: Evaluation = MASK_EVALUATION,
) -> Curriculum:
    require((seed_set in SEED_SETS, f"seed_set must be one of {', '.join(map(str, SEED_SETS))}, got {seed_set!r}"))
    seeds = SEED_SETS[seed_set]
    tasks = tuple(one_wait_image(path, seeds[family - 1]) for family, path in named)
    ids = list(range(len(tasks)))
    num_ids = len(tasks)
    if pool is not None:
        ids = pool_ids(named, pool)
        num_ids = sum(2**depth for _, depth in pool) + (0 if seed_set == 1 else 2)  # as in the files
    return labelled(name, source, tasks, ids, num_ids, num_frames=num_frames, evaluation=evaluation)


NAMED = {name: _listed(name, row) for name, row in LISTED.items()} | by_name(
    single_task, ct28_blocked_skips_d5, ct28_mosaic_skips_d5, ct20, mosaic_ladder
)
