"""Single-task experts: each task of a curriculum learned alone, by the same agent with the same budget and protocol.

Forward transfer and relative performance compare with them. An expert is a run like any other; it is kept in a folder
under the hash of all that its numbers depend on, so that no run trains it twice.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ctgraph_rl.checks import require
from ctgraph_rl.disk import made_folder
from ctgraph_rl.log.damage import damaged
from ctgraph_rl.log.files import CHECKPOINTS, LOG, METRICS, locked
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Block, Curriculum, Protocol
from ctgraph_rl.tasks.task import Task

Learn = Callable[[Curriculum, Path], None]
"""Learns a curriculum into a directory, or resumes what was begun there."""


EXPERT = "single-task expert"
"""The name of their curricula."""


class Expert(NamedTuple):
    """An agent that learned one task alone."""

    task: int  # position in the curriculum's tasks, from 1
    fingerprint: str  # of the single-task curriculum
    run_dir: Path

    @property
    def about(self) -> dict[str, Any]:
        """Plain values for the log."""
        return {"task": self.task, "fingerprint": self.fingerprint, "run": str(self.run_dir)}

    @property
    def log(self) -> RunLog:
        """Its measurements.

        Raises:
            ValueError: if its files are not what was written.
        """
        lost = damaged(self.run_dir)
        said = f"the expert of task {self.task}, {self.run_dir}, has lost {', '.join(lost)}"
        require((not lost, f"{said}: the same command trains it again"))
        return RunLog.read(self.run_dir / LOG)


def expert_curriculum(curriculum: Curriculum, task: Task) -> Curriculum:
    """A task of a curriculum alone: the frames of the block that trains it first, the same evaluation and task id.

    Raises:
        ValueError: if that block trains other tasks, too.
    """
    block = next(block for block in curriculum.blocks if task in block.tasks)
    alone = set(block.tasks) == {task}
    require(
        (alone, "experts need blocks of one task each: the frames of one task cannot be separated from the others'")
    )
    how = curriculum.protocol
    if how.task_id != "hidden":
        length = how.length(len(curriculum.tasks)) if how.task_id == "one_hot" else None
        ids = (curriculum.task_ids[task],)
        how = Protocol(how.task_id, num_task_ids=length, task_ids=ids, guide_frames=how.guide_frames)
    else:
        how = Protocol(guide_frames=how.guide_frames)
    evaluation = replace(curriculum.evaluation, tasks="all", held_out=())
    blocks = (Block((task,), block.num_frames),)
    return Curriculum(EXPERT, 1, "-", blocks, evaluation=evaluation, protocol=how)


def find_or_train(
    curriculum: Curriculum,
    learn: Learn,
    folder: Path,
    settings: Mapping[str, Any],
    tell: Callable[[str], object],
    waiting: Callable[[], object] = lambda: None,
) -> list[Expert]:
    """Return the experts of all tasks of a curriculum; those that the folder lacks are trained first.

    Args:
        curriculum: has the tasks.
        learn: trains one, or resumes its training.
        folder: where experts are kept, each under a hash of its curriculum's fingerprint and the settings.
        settings: all else that an expert's numbers depend on: agent, seed, versions.
        tell: is given a line about each expert.
        waiting: called every half second while another process trains one that is needed here.

    Raises:
        ValueError: before any training, for a block with several tasks.
    """
    alone = [expert_curriculum(curriculum, task) for task in curriculum.tasks]
    names = [directory_name(each, settings) for each in alone]
    experts = [
        Expert(i, each.fingerprint, folder / name) for i, (each, name) in enumerate(zip(alone, names, strict=True), 1)
    ]
    for expert, each, label in zip(experts, alone, curriculum.labels, strict=True):
        found = _is_trained(expert.run_dir)
        state = "found in" if found else "learns into"
        tell(f"expert {expert.task} of {len(experts)}, {label}: {state} {expert.run_dir}")
        if found:
            shutil.rmtree(expert.run_dir / CHECKPOINTS, ignore_errors=True)  # if it was stopped at its very end
        else:
            _train(each, learn, expert.run_dir, waiting)
    return experts


def _train(curriculum: Curriculum, learn: Learn, run_dir: Path, waiting: Callable[[], object]) -> None:
    """Train into the directory, or resume what was begun there; wait while another process trains into it."""
    made_folder(run_dir)
    with locked(run_dir, waiting):
        if not _is_trained(run_dir):
            learn(curriculum, run_dir)


def _is_trained(run_dir: Path) -> bool:
    return (run_dir / METRICS).exists() and not damaged(run_dir)


def directory_name(curriculum: Curriculum, settings: Mapping[str, Any]) -> str:
    """Return the hash of all that an expert's numbers depend on: 16 hexadecimal digits."""
    text = json.dumps([curriculum.fingerprint, settings], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
