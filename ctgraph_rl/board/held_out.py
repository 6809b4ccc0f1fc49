"""Level *held out* of a verification: the submitted configuration learns what it could not be tuned for.

Seeds, images and goals follow from the submission and the verifier's number. A test asks whether the scores are lower
than the submitted ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ctgraph_rl.board.rerun import Rerun, RerunCell, check_of_scores, job_of, score_name
from ctgraph_rl.board.rescore import Check, of_the_protocol
from ctgraph_rl.board.submission import Submission
from ctgraph_rl.board.tracks import HELD_OUT_SEEDS, drawn, held_out_seeds
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.scores import scores
from ctgraph_rl.parsers import LEVELS
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.kinds.task_like import TaskLike
from ctgraph_rl.tasks.task import Task

HELD_OUT = LEVELS[2]


def seeds_of(submission: Submission, number: int, count: int) -> tuple[int, ...]:
    """Return different seeds that a verifier's number draws.

    Neither side can pick them: the submitter does not know the number, the verifier does not choose the digest.
    """
    of_track = "" if submission.track is None else f"{submission.track.id} "
    return held_out_seeds(f"{of_track}{submission.digest} {number}", count)


def held_out_cells(submission: Submission, number: int, count: int, folder: Path) -> list[RerunCell]:
    """Return what is learned: one seed each, with other images and goals, and the submitted configuration.

    Each has a folder within ``folder``.
    """
    cells = []
    first = submission.finished[0]
    for seed in seeds_of(submission, number, count):
        curriculum = other_curriculum(submission.curriculum, f"{submission.digest} {number} {seed}")
        job = job_of(submission, (seed,), first)
        cells.append(RerunCell(folder / f"seed{seed}", job, (), curriculum, seconds=first.seconds))
    return cells


def held_out_checks(submission: Submission, results: Sequence[tuple[RerunCell, Rerun]]) -> Iterator[Check]:
    """Yield a check of each failed run, of the other runs' protocol, and of their scores."""
    name = score_name(submission)
    found = []
    for cell, result in results:
        seed = cell.job.seeds[0]
        failure = result.failure
        try:
            if result.log is not None:
                found.append(scores(result.log, cell.curriculum)[name].value)
                for check in of_the_protocol(cell.curriculum, seed, result.log, f"seed {seed}"):
                    yield check._replace(level=HELD_OUT)
        except ValueError as error:
            failure = str(error)
        if failure is not None:
            yield Check(f"run of seed {seed}", "it finishes", terminal_text(failure), None, level=HELD_OUT)
    what = f"{name} of {len(found)} runs with other seeds, images and goals"
    yield check_of_scores(submission, found, what, HELD_OUT)


def other_curriculum(curriculum: Curriculum, key: str) -> Curriculum:
    """Return a curriculum with other images and goals; what its tasks shared, they still share.

    Every generated image set gets another seed, equal ones the same; image sets without a seed stay. The branches of
    every decision state are renamed, in all tasks alike, so goals still share their first decisions. Tasks that are no
    CT-graphs stay; only the seeds change.
    """

    def other(task: TaskLike) -> TaskLike:
        if not isinstance(task, Task):
            return task
        changed: dict[str, Any] = {"goal": renamed(task.goal, task.graph.branching_factor, key)}
        if task.image_seed is not None:
            seed = HELD_OUT_SEEDS[drawn(f"{key} images {task.image_seed}", len(HELD_OUT_SEEDS))]
            changed["images"] = replace(task.images, seed=seed)  # type: ignore[type-var]
        if task.swapped_branches is not None:
            path, pair = task.swapped_branches
            both = (renamed((*path, branch), task.graph.branching_factor, key) for branch in pair)
            first, second = sorted(both)
            changed["swapped_branches"] = (first[:-1], (first[-1], second[-1]))
        return replace(task, **changed)

    blocks = []
    for block in curriculum.blocks:
        blocks.append(replace(block, tasks=tuple(map(other, block.tasks))))
    evaluation = replace(curriculum.evaluation, held_out=tuple(map(other, curriculum.evaluation.held_out)))
    name = f"{curriculum.name} (held out)"
    source = f"{curriculum.source}; images and goals drawn by {key}"
    return replace(curriculum, name=name, source=source, blocks=tuple(blocks), evaluation=evaluation)


def renamed(path: tuple[int, ...], branching_factor: int, key: str) -> tuple[int, ...]:
    """Return a path through a tree whose branches are renamed at every node.

    Args:
        path: decisions from the home state, in 1..b.
    """
    branches = range(1, branching_factor + 1)
    new = []
    for place, decision in enumerate(path):
        text = f"{key} branches {'.'.join(map(str, path[:place]))}"
        digests = {branch: hashlib.sha256(f"{text} {branch}".encode()).digest() for branch in branches}
        order = sorted(branches, key=digests.__getitem__)
        new.append(order[decision - 1])
    return tuple(new)
