"""CT28 and its relatives: nested goals of growing depth on graphs with up to four image seeds.

MaskSC and AMSC ("Lifelong Context-Aware Retrieval and Composition for Scalable Knowledge Reuse", 2026), LRL-Baselines
(2026), MOSAIC (Nath et al. 2025, arXiv 2506.05577) and its predecessor; repositories under github.com/DMIU-ShELL. One
image for all wait states. A task id is the number of the task among all goals of depth 2 to 11 of four image seeds.

A family is one image seed and one path; its task at depth d has the first d decisions of the path. The fourth family
exists twice: consistent, or skipping depth 5, so that its tasks have the depths 2, 3, 4, 6, 7, 8 and 9 in the groups of
depth 2 to 8. Curricula with the latter are named ``..._skips_d5``.

Single agents had 51,200 frames a task in the launchers, where the scripts' default is 102,400, and were evaluated as in
`curricula.masks`. The launcher of AMSC hides the task ids.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain, product

from ctgraph_rl.checks import by_name, require
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Evaluation
from curricula.published import MASK_EVALUATION, GoalPool, chosen, labelled, one_wait_image, pool_ids, words

MASKSC = "github.com/DMIU-ShELL/MaskSC (2026)"
AMSC = "github.com/DMIU-ShELL/AMSC (2026)"
LRL = "github.com/DMIU-ShELL/LRL-Baselines (2026)"
MOSAIC = "Nath et al. 2025, arXiv 2506.05577; github.com/DMIU-ShELL/MOSAIC"
L2D2C = "github.com/DMIU-ShELL/L2D2-C"

PATHS = {1: "01011010010101", 2: "11010101101110", 3: "00100110", 4: "10011100"}
"""The consistent families; the first two go down to depth 14."""

FOURTH_SKIPS_D5 = ["11", "110", "1101", "110111", "1101110", "11011100", "110111001"]

SEED_SETS = {1: (1, 2, 3, 4), 2: (3, 4, 5, 6), 3: (5, 6, 7, 8), 4: (7, 8, 9, 10), 5: (9, 10, 11, 12)}
"""The image seeds of the four families in each set of files."""

NamedTasks = list[tuple[int, str]]
"""Tasks, each as (family, path)."""


def ct28(num_frames: int = 51_200) -> Curriculum:
    """CT28 interleaved: four families with nested goals, depth 2 to 8; at each depth one task of every family.

    Args:
        num_frames: frames per task.
    """
    return _curriculum("ct28", MASKSC, _turns(_families(1, 2, 3, 4)), num_frames)


def ct28_interleaved_skips_d5(num_frames: int = 51_200) -> Curriculum:
    """CT28 interleaved as in an older file: its fourth family skips depth 5, an inconsistency.

    Args:
        num_frames: frames per task.
    """
    return _curriculum("ct28_interleaved_skips_d5", MASKSC, _turns(_inconsistent()), num_frames)


def ct28_blocked_skips_d5(num_frames: int = 51_200, seed_set: int = 1) -> Curriculum:
    """CT28 family after family; its fourth family skips depth 5, an inconsistency.

    Args:
        num_frames: frames per task.
        seed_set: which of the five published sets of image seeds, 1..5.
    """
    return _curriculum("ct28_blocked_skips_d5", LRL, _one_by_one(_inconsistent()), num_frames, seed_set)


def ct28_random_skips_d5(num_frames: int = 51_200) -> Curriculum:
    """CT28 in one fixed random order; its fourth family skips depth 5, an inconsistency.

    Args:
        num_frames: frames per task.
    """
    listing = """3:001001 3:0010011 2:11010101 3:00100 1:01011 1:010 3:001 2:1101010 1:01 4:110111 4:11 2:110101
        4:110111001 3:00 1:0101 2:110 4:1101 4:11011100 1:0101101 2:11 2:11010 3:00100110 2:1101 1:010110 4:110 3:0010
        4:1101110 1:01011010"""
    return _curriculum("ct28_random_skips_d5", LRL, words(listing), num_frames)


def ct28_mosaic_skips_d5(num_frames: int = 102_400, seed_set: int = 1, agent: int | None = None) -> Curriculum:
    """CT28 of MOSAIC; its fourth family skips depth 5, an inconsistency.

    There 28 agents that exchange what they know had one task each. It is unknown whether they saw task ids. Fifty
    episodes evaluated a task; when is not known, and greedy actions are our choice.

    Args:
        num_frames: frames per task.
        seed_set: which of the five sets of image seeds, 1..5.
        agent: the task of a single agent, 0..27; None: all tasks one after the other, which is ours.
    """
    tasks = _of_agent(_one_by_one(_inconsistent()), agent)
    evaluation = Evaluation(num_episodes=50)
    return _curriculum("ct28_mosaic_skips_d5", MOSAIC, tasks, num_frames, seed_set=seed_set, evaluation=evaluation)


def ct28_one_branch(num_frames: int = 51_200) -> Curriculum:
    """The first family of CT28 by itself with image seed 9, depth 2 to 8; the published file is not valid JSON.

    Args:
        num_frames: frames per task.
    """
    return _curriculum("ct28_one_branch", LRL, _family(1), num_frames, seed_set=5)


def ct10(num_frames: int = 51_200) -> Curriculum:
    """CT10: one family with nested goals, depth 2 to 11.

    Args:
        num_frames: frames per task.
    """
    return _curriculum("ct10", LRL, _family(1, deepest=11), num_frames)


def ct14_half_1(num_frames: int = 51_200) -> Curriculum:
    """CT14, first half: the first family, depth 2 to 8.

    Args:
        num_frames: frames per task.
    """
    return _curriculum("ct14_half_1", LRL, _family(1), num_frames)


def ct14_half_2(num_frames: int = 51_200) -> Curriculum:
    """CT14, second half: the second family, depth 2 to 8.

    Args:
        num_frames: frames per task.
    """
    return _curriculum("ct14_half_2", LRL, _family(2), num_frames)


def ct14_md(num_frames: int = 51_200) -> Curriculum:
    """CT14 multi-depth: the first and the second family in turns, depth 2 to 8.

    Args:
        num_frames: frames per task.
    """
    return _curriculum("ct14_md", LRL, _turns(_families(1, 2)), num_frames)


def ct8_interleaved(num_frames: int = 51_200) -> Curriculum:
    """CT8 interleaved: the first and the second family in turns, depth 2 to 5.

    Args:
        num_frames: frames per task.
    """
    return _curriculum("ct8_interleaved", MASKSC, _turns(_families(1, 2, deepest=5)), num_frames)


def ct29_recovery(num_frames: int = 51_200) -> Curriculum:
    """CT29 recovery: three families in turns, then depth 8 of the fourth unprepared, its ladder, and depth 8 again.

    Args:
        num_frames: frames per task.
    """
    ladder = _family(4)
    tasks = [*_turns(_families(1, 2, 3)), ladder[-1], *ladder]
    return _curriculum("ct29_recovery", AMSC, tasks, num_frames)


def ct20(num_frames: int = 102_400, agent: int | None = None) -> Curriculum:
    """CT20: two families with nested goals, depth 2 to 11, one after the other.

    Twenty agents that exchange what they know had one task each. Which of several files the published results used is
    not known; this is the one with 20 tasks. Nor is known when and how long tasks were evaluated: our defaults.

    Args:
        num_frames: frames per task.
        agent: the task of a single agent, 0..19; None: all tasks one after the other, which is ours.
    """
    return _two_families("ct20", L2D2C, deepest=11, num_frames=num_frames, agent=agent)


def mosaic_ladder(num_frames: int = 102_400, agent: int | None = None) -> Curriculum:
    """The ladders of MOSAIC: two families with nested goals, depth 2 to 14, one after the other.

    Two files, ct14_md_seed1 and ct14_md_seed2, hold the 13 tasks of a family each. The frames are those of MOSAIC's 28
    tasks; when and how long tasks were evaluated is not known: our defaults.

    Args:
        num_frames: frames per task.
        agent: the task of a single agent, 0..25; None: all tasks one after the other, which is ours.
    """
    return _two_families("mosaic_ladder", MOSAIC, deepest=14, num_frames=num_frames, agent=agent)


def _two_families(name: str, source: str, deepest: int, num_frames: int, agent: int | None) -> Curriculum:
    """The first two families with the ids that all goals of their graphs have."""
    named = _of_agent(_one_by_one(_families(1, 2, deepest=deepest)), agent)
    tasks = tuple(one_wait_image(path, family) for family, path in named)
    pool = _pool((1, 2), deepest)
    num_ids = sum(2**depth for _, depth in pool)
    ids = pool_ids(named, pool)
    return labelled(name, source, tasks, ids, num_ids, num_frames=num_frames, evaluation=Evaluation())


def _family(number: int, deepest: int = 8) -> NamedTasks:
    return [(number, PATHS[number][:depth]) for depth in range(2, deepest + 1)]


def _families(*numbers: int, deepest: int = 8) -> list[NamedTasks]:
    return [_family(number, deepest) for number in numbers]


def _inconsistent() -> list[NamedTasks]:
    fourth = [(4, path) for path in FOURTH_SKIPS_D5]
    return [*_families(1, 2, 3), fourth]


def _one_by_one(families: list[NamedTasks]) -> NamedTasks:
    return list(chain.from_iterable(families))


def _turns(families: list[NamedTasks]) -> NamedTasks:
    return list(chain.from_iterable(zip(*families, strict=True)))


def _of_agent(tasks: NamedTasks, agent: int | None) -> NamedTasks:
    return tasks if agent is None else [chosen("agent", agent, tasks)]


def _pool(families: Iterable[int], deepest: int) -> GoalPool:
    return list(product(families, range(2, deepest + 1)))


def _curriculum(
    name: str,
    source: str,
    named: NamedTasks,
    num_frames: int,
    seed_set: int = 1,
    evaluation: Evaluation = MASK_EVALUATION,
) -> Curriculum:
    """Tasks with the ids, and the length of ids, that the files of a set of image seeds have."""
    require((seed_set in SEED_SETS, f"seed_set must be one of {', '.join(map(str, SEED_SETS))}, got {seed_set!r}"))
    seeds = SEED_SETS[seed_set]
    tasks = tuple(one_wait_image(path, seeds[family - 1]) for family, path in named)
    ids = pool_ids(named, _pool(PATHS, deepest=11))
    num_ids = 16_368 if seed_set == 1 else 16_370
    return labelled(name, source, tasks, ids, num_ids, num_frames=num_frames, evaluation=evaluation)


NAMED = by_name(
    ct28_blocked_skips_d5,
    ct28_interleaved_skips_d5,
    ct28_mosaic_skips_d5,
    ct28_random_skips_d5,
    ct8_interleaved,
    ct10,
    ct14_half_1,
    ct14_half_2,
    ct14_md,
    ct28,
    ct28_one_branch,
    ct29_recovery,
    ct20,
    mosaic_ladder,
)
"""The curricula of this module by name."""
