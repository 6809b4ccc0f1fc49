"""Single-task experts: each learned one task of a curriculum, by the same agent with the same budget and protocol.

Forward transfer and relative performance compare with them. An expert is a run in a folder under the hash of all that
its numbers depend on, so that it is trained once.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, require
from ctgraph_rl.disk import require_no_link
from ctgraph_rl.log.files import CHECKPOINTS, LOG, METRICS
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.sums import damaged
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.session import Failures, Session
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.kinds.task_like import TaskLike
from ctgraph_rl.tasks.protocol import Block, Protocol

RunDirs = Mapping[int, Path]

Learn = Callable[[Curriculum, RunDirs, Session], Failures]
"""Lets seeds learn a curriculum as one batch, or resume, each into its locked directory."""

EXPERT = "single-task expert"


class Expert(NamedTuple):
    """An agent that learned a single task."""

    task: int  # position in the curriculum's tasks, from 1
    fingerprint: str  # of the single-task curriculum
    run_dir: Path

    @property
    def about(self) -> NamedValues:
        """Plain values for the log; ``together`` if it was trained in a group of seeds."""
        together = begun_with(self.run_dir)
        group = {"together": together} if together else {}
        return {"task": self.task, "fingerprint": self.fingerprint, "run": str(self.run_dir), **group}

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


def expert_curriculum(curriculum: Curriculum, task: TaskLike) -> Curriculum:
    """A curriculum of one task: the frames of its first block, the same evaluation and task id.

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
        how = Protocol(
            how.task_id, num_task_ids=length, task_ids=ids, guide_frames=how.guide_frames, episodes=how.episodes
        )
    else:
        how = Protocol(guide_frames=how.guide_frames, episodes=how.episodes)
    evaluation = replace(curriculum.evaluation, tasks="all", held_out=())
    blocks = (Block((task,), block.num_frames),)
    return Curriculum(EXPERT, 1, "-", blocks, evaluation=evaluation, protocol=how)


def find_or_train(
    curriculum: Curriculum,
    learn: Learn,
    folder: Path,
    settings: Mapping[int, ReadOnlyValues],
    tell: Callable[[str], object],
    *,
    waiting: Callable[[], object] = lambda: None,
    console: Console | None = None,
) -> tuple[dict[int, list[Expert]], Failures]:
    """Return each seed's experts of all tasks, training those that the folder lacks.

    Experts of one task that have not begun are trained as one batch.

    Args:
        folder: of experts, each under a hash of its curriculum's fingerprint and settings.
        settings: by seed, all else that experts' numbers depend on: agent, seed, versions.
        tell: takes a line about each expert.
        waiting: called every half second while another process trains one.

    Returns:
        Experts by seed, and the error of each seed with a failed expert, which has none.

    Raises:
        ValueError: before any training, for a block with several tasks.
    """
    alone = {i: expert_curriculum(curriculum, task) for i, task in enumerate(curriculum.tasks, 1)}
    found: dict[int, list[Expert]] = {seed: [] for seed in settings}
    failed: Failures = {}
    for i in alone:
        what = f"expert {i} of {len(alone)}, {curriculum.labels[i - 1]}"
        run_dirs = {}
        for seed, experts in found.items():
            run_dirs[seed] = folder / directory_name(alone[i], settings[seed])
            experts.append(Expert(i, alone[i].fingerprint, run_dirs[seed]))
        left = _left(run_dirs, what, tell)
        for seed, error in _train(alone[i], learn, left, waiting, console).items():
            failed[seed] = FloatingPointError(f"{what}: {error}")
            del found[seed]
    return found, failed


def _left(run_dirs: RunDirs, what: str, tell: Callable[[str], object]) -> dict[int, Path]:
    left = _untrained(run_dirs)
    for seed, run_dir in run_dirs.items():
        of_seed = f" of seed {seed}" if len(run_dirs) > 1 else ""
        tell(f"{what}{of_seed}: {'learns into' if seed in left else 'found in'} {run_dir}")
        if seed not in left:
            shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)  # if it was stopped at its very end
    return left


def _train(
    curriculum: Curriculum, learn: Learn, run_dirs: RunDirs, waiting: Callable[[], object], console: Console | None
) -> Failures:
    failed: Failures = {}
    with Session(console) as session:
        for run_dir in sorted(run_dirs.values()):  # one order, so that no two processes wait for each other
            require_no_link(run_dir)
            session.lock(run_dir, waiting)
        for group in _groups(curriculum, _untrained(run_dirs)):
            failed |= learn(curriculum, group, session)
    return failed


def _groups(curriculum: Curriculum, run_dirs: RunDirs) -> list[RunDirs]:
    """Divide seeds into batches: those begun so, and all that begin.

    If some of a begun group are not here, the others begin again, unless they have learned all.
    """
    begun: dict[tuple[int, ...], dict[int, int]] = {}
    for seed, run_dir in run_dirs.items():
        newest = Checkpoints(run_dir / CHECKPOINTS).newest_frames
        if newest is not None:
            begun.setdefault(tuple(begun_with(run_dir)) or (seed,), {})[seed] = newest
    resumed: list[RunDirs] = []
    new = dict(run_dirs)
    for group, frames in begun.items():
        if {*frames} == {*group} or {*frames.values()} == {curriculum.num_frames}:
            resumed.append({seed: new.pop(seed) for seed in group if seed in frames})
    for run_dir in new.values():
        shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)
    return [*resumed, new] if new else resumed


def is_of_group(run_dir: Path) -> bool:
    """Return whether a run was stopped that can only be resumed with its group of seeds."""
    return bool(begun_with(run_dir)) and Checkpoints(run_dir / CHECKPOINTS).newest_frames is not None


def begun_with(run_dir: Path) -> list[int]:
    """Return the seeds with which a run was begun as one batch, if any."""
    return list((RunLog.begun(run_dir / LOG) or {}).get("together", ()))


def _untrained(run_dirs: RunDirs) -> dict[int, Path]:
    left = {}
    for seed, run_dir in run_dirs.items():
        if not (run_dir / METRICS).exists() or damaged(run_dir):
            left[seed] = run_dir
    return left


def directory_name(curriculum: Curriculum, settings: ReadOnlyValues) -> str:
    """Return the hash of all that an expert's numbers depend on: 16 hexadecimal digits."""
    text = json.dumps([curriculum.fingerprint, settings], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
