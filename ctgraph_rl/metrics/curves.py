"""Metrics of evaluation curves: performance on every task while the curriculum is learned."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import (
    NOISE,
    not_negative,
    of_changes_but_one,
    of_counts,
    of_lost_shares,
    of_performance,
    of_sums,
    of_sums_over_time,
)
from ctgraph_rl.metrics.record import HERE, MASTERED, Undefined, defined, float64, ratio

CONTINUAL_WORLD = "Wolczyk et al. 2021, Continual World (arXiv 2105.10919)"
LABS = "Ben-Iwhiwhu et al. 2022, Lifelong RL with modulating masks (arXiv 2212.11110)"
EBBINGHAUS = "ctgraph_rl, after the savings of relearning in Ebbinghaus 1885, Ueber das Gedaechtnis"
LABS_CODE = "evaluation code of the CT-graph labs"

OF_MASTERY = {"curves": "mastery_curves", "threshold": "mastery_thresholds"}


@dataclass(frozen=True)
class Curves:
    """Evaluations of a run in time order.

    Args:
        performance: float64 [evaluations, tasks]; NaN where not evaluated.
        blocks: each evaluation's block; 0 before any training.
        trained: each block's tasks, counted from 0.

    Raises:
        ValueError: if these do not fit.
    """

    performance: Tensor
    blocks: tuple[int, ...]
    frames: tuple[int, ...]
    trained: tuple[tuple[int, ...], ...]

    def __post_init__(self) -> None:
        rows = len(self.performance)
        if self.performance.ndim != 2 or (len(self.blocks), len(self.frames)) != (rows, rows) or rows == 0:
            got = f"{self.performance.shape}, {len(self.blocks)} blocks and {len(self.frames)} frames"
            raise ValueError(f"performance must be [evaluations, tasks] with a block and frames each, got {got}")
        if list(self.blocks) != sorted(self.blocks) or self.blocks[-1] > len(self.trained):
            raise ValueError(f"blocks must rise from 0 to at most {len(self.trained)}, got {self.blocks}")

    def of_block(self, block: int) -> list[int]:
        """Positions of the evaluations of a block."""
        return list(range(bisect_left(self.blocks, block), bisect_right(self.blocks, block)))

    def check_whole(self) -> None:
        """Raise `Undefined` without an evaluation in the last block."""
        if self.blocks[-1] < len(self.trained):
            raise Undefined(f"the last evaluation is in block {self.blocks[-1]} of {len(self.trained)}")

    @property
    def ends(self) -> Tensor:
        """The performance matrix: the last evaluation of each block, [blocks + 1, tasks]; NaN for a block without."""
        rows = [self.of_block(block) for block in range(len(self.trained) + 1)]
        nothing = torch.full_like(self.performance[0], torch.nan)
        return torch.stack([self.performance[row[-1]] if row else nothing for row in rows])

    def own_block(self, task: int) -> int:
        """The one block, from 1, that trains a task."""
        own = self._own_blocks.get(task, [])
        if len(own) != 1:
            raise Undefined(f"the definition needs each task trained once, task {task + 1} is in {len(own)} blocks")
        if len(set(self.trained[own[0] - 1])) > 1:
            raise Undefined(f"the definition needs tasks trained alone, block {own[0]} trains several")
        return own[0]

    @cached_property
    def _own_blocks(self) -> dict[int, list[int]]:
        found: dict[int, list[int]] = {}
        for block, tasks in enumerate(self.trained, 1):
            for task in dict.fromkeys(tasks):
                found.setdefault(task, []).append(block)
        return found

    def own_stage(self, task: int) -> Tensor:
        """A task's evaluations in and after its block, at equal distances."""
        rows = self.of_block(self.own_block(task))
        steps = {after - before for before, after in pairwise(self.frames[i] for i in rows)}
        if not rows or len(steps) > 1:
            raise Undefined(f"the definition needs evaluations at equal distances in block {self.own_block(task)}")
        return self.performance[rows, task]

    def at_end_of(self, block: int, task: int, last: int) -> Tensor:
        """Mean of a task's last evaluations in a block."""
        if last < 1:
            raise ValueError(f"last must be an integer >= 1, got {last!r}")
        rows = self.of_block(block)
        if len(rows) < last:
            raise Undefined(f"the definition needs {last} evaluations in block {block}, it has {len(rows)}")
        return self.performance[rows[-last:], task].mean()


@defined("wolczyk2021/performance", "1/T sum_j p_j(end)", CONTINUAL_WORLD, bounds=of_performance)
def continual_world_performance(curves: Curves, last: int = 1) -> Tensor:
    """P: mean performance on all tasks at the end.

    Args:
        last: evaluations to average "at the end": 1 as in the paper, 5 as in its code.
    """
    return _final(curves, last)


@defined(
    "wolczyk2021/forgetting",
    "1/T sum_j (p_j(end of j's block) - p_j(end))",
    CONTINUAL_WORLD,
    bounds=of_changes_but_one,
)
def continual_world_forgetting(curves: Curves, last: int = 1) -> Tensor:
    """F: the drop on each task from the end of its block to the end.

    The mean is over all T tasks, so the last one adds a 0: smaller than -BWT of `backward_transfer` by (T-1)/T.
    Undefined unless each task is trained once, in a block without others.

    Args:
        last: as in `continual_world_performance`.
    """
    tasks = range(curves.performance.shape[1])
    own = torch.stack([curves.at_end_of(curves.own_block(task), task, last) for task in tasks])
    return own - _final(curves, last)


def _final(curves: Curves, last: int) -> Tensor:
    tasks = range(curves.performance.shape[1])
    return torch.stack([curves.at_end_of(len(curves.trained), task, last) for task in tasks])


@defined("ben-iwhiwhu2022/icr", "sum_j p_j(end)", LABS, aggregate=lambda returns: returns[-1], bounds=of_sums)
def instant_cumulative_return(curves: Curves) -> Tensor:
    """ICR(t) = sum_j p_j(t): the return over all tasks at evaluation t; the value is the last."""
    curves.check_whole()
    return curves.performance.sum(1)


@defined("ben-iwhiwhu2022/tpot", "sum_{t>0} sum_j p_j(t)", LABS, aggregate=torch.sum, bounds=of_sums_over_time)
def total_performance_over_time(curves: Curves) -> Tensor:
    """TPOT = sum_{t>0} ICR(t) over all evaluations but those before training, which the published protocol lacks.

    It grows with the evaluations: compare equal protocols only.
    """
    curves.check_whole()
    return curves.performance[[block > 0 for block in curves.blocks]].sum(1)


@defined(
    "ct-graph-labs/relative-forgetting",
    "mean_j (max_t p_j(t) - p_j(end)) / max_t p_j(t), of tasks j with max_t p_j(t) > 4 noise_j",
    LABS_CODE,
    partial=True,
    missing="a task never got above 0, and the noise of its rewards",
    inputs={"noise": "evaluation_noise"},
    bounds=of_lost_shares,
)
def relative_forgetting(curves: Curves, noise: Tensor | float = 0.0) -> Tensor:
    """The lost share of each task's best performance ever, over all tasks.

    The best is over the evaluations that there are; the last one must be there. Tasks whose best is not above 0, or
    within the noise of rewards, are left out and counted. In [0, 1] for such performance.

    Args:
        noise: standard deviation of an evaluation's return by noise: a number, or one per task.
    """
    curves.check_whole()
    if curves.performance[-1].isnan().any():
        raise Undefined("the last evaluation of a task is missing")
    best = curves.performance.nan_to_num(nan=-torch.inf).amax(0)
    above_noise = best > NOISE * torch.as_tensor(noise, dtype=torch.float64, device="cpu")
    return ratio(best - curves.performance[-1], torch.where(above_noise, best, 0.0))


@defined(
    "ctgraph_rl/tasks-learned",
    "number of j with p_j(end of j's block) >= threshold_j; p_j is the share at the goal where rewards have noise",
    HERE,
    missing="an evaluation is missing, or what counts as mastered is not known",
    aggregate=torch.sum,
    inputs=OF_MASTERY,
    bounds=of_counts,
)
def tasks_learned(curves: Curves, threshold: Tensor | float = MASTERED) -> Tensor:
    """Number of tasks that are mastered right after the last block that trains them, forgotten later or not.

    Ben-Iwhiwhu et al. report such a number without a formula; a later code of the labs (AMSC, 2026) counts tasks at 0.9
    at the very end.

    Args:
        curves: for tasks with noisy rewards a run gives shares of episodes at the goal.
        threshold: what counts as mastered: a number, or one per task. A run takes 0.9 of such a share, else 0.9 times
            the optimal value; if that is not positive, 0.9 of the way to it from the worst mean return.
    """
    ends = curves.ends
    last = {task: block for block, tasks in enumerate(curves.trained, 1) for task in tasks}
    reached = torch.stack([ends[last[task], task] for task in sorted(last)])
    needed = torch.as_tensor(threshold, dtype=ends.dtype, device="cpu").expand(ends.shape[1])[sorted(last)]
    unknown = reached.isnan() | needed.isnan()
    return torch.where(unknown, torch.nan, (reached >= needed).double())


@defined(
    "ctgraph_rl/frames-to-mastery",
    "mean over tasks j, each with its block, of the frames from the start of j's first block to p_j >= threshold_j, "
    "p_j as in ctgraph_rl/tasks-learned",
    HERE,
    missing="a task was not mastered in its block",
    inputs=OF_MASTERY,
    bounds=not_negative,
    is_time=True,
)
def frames_to_mastery(curves: Curves, threshold: Tensor | float = MASTERED) -> Tensor:
    """Frames of a task's first block until the first evaluation that finds the task mastered.

    Tasks that are only trained with others are left out. Undefined if a task was not mastered in its block. Evaluations
    are the resolution.

    Args:
        curves: as in `tasks_learned`.
        threshold: as there.
    """
    num_tasks = curves.performance.shape[1]
    needed = torch.as_tensor(threshold, dtype=curves.performance.dtype, device="cpu").expand(num_tasks)
    found = []
    for task, (block, *_) in curves._own_blocks.items():
        if set(curves.trained[block - 1]) == {task}:
            found.append(_frames_to(needed[task], curves, block, task))
    if not found:
        raise Undefined("the definition needs a block that trains one task")
    return float64(found)


@defined(
    "ctgraph_rl/regain",
    "mean over returns of tasks j, mastered in their first block, of (frames from the start of the block of the return "
    "to p_j >= threshold_j) / (the same of j's first block), p_j as in ctgraph_rl/tasks-learned",
    EBBINGHAUS,
    missing="a task was not mastered again when it returned",
    inputs=OF_MASTERY,
    bounds=not_negative,
    is_time=True,
)
def regain(curves: Curves, threshold: Tensor | float = MASTERED) -> Tensor:
    """Frames until a task that returns is mastered again, as a share of the frames that it took the first time.

    0: the last evaluation before the return finds it mastered. 1: it takes as long as at first. The source's savings of
    relearning are 1 less this. A task returns where a block trains only it, after other tasks. Tasks that were not
    mastered in their first block are left out; undefined if one was not mastered again.

    Args:
        curves: as in `tasks_learned`.
        threshold: as there.
    """
    returns = find_returns(curves.trained)
    if not returns:
        raise Undefined("the definition needs a block of one task that was trained before, with other tasks between")
    num_tasks = curves.performance.shape[1]
    needed = torch.as_tensor(threshold, dtype=curves.performance.dtype, device="cpu").expand(num_tasks)
    found = []
    for task, first, again in returns:
        frames = _frames_to(needed[task], curves, first, task)
        if not math.isnan(frames):
            before = curves.ends[again - 1, task]
            found.append(0.0 if before >= needed[task] else _frames_to(needed[task], curves, again, task) / frames)
    if not found:
        raise Undefined("no task that returns was mastered in its first block")
    return float64(found)


def find_returns(trained: Sequence[Sequence[int]]) -> list[tuple[int, int, int]]:
    """Return the task, first block and later block of each return, after other tasks; the blocks train only it.

    Args:
        trained: each block's tasks; blocks count from 1.
    """
    first: dict[int, int] = {}
    shared = set()
    found = []
    before: set[int] = set()
    for block, tasks in enumerate(trained, 1):
        own = {*tasks}
        for task in own:
            if len(own) > 1 and task not in first:
                shared.add(task)
            first.setdefault(task, block)
            if len(own) == 1 and first[task] < block and task not in before and task not in shared:
                found.append((task, first[task], block))
        before = own
    return found


def _frames_to(needed: Tensor, curves: Curves, block: int, task: int) -> float:
    rows = curves.of_block(block)
    before = curves.of_block(block - 1)
    if block > 1 and not before:
        raise Undefined(f"the definition needs an evaluation at the end of block {block - 1}")
    start = curves.frames[before[-1]] if block > 1 else 0
    for row in rows:
        reached = curves.performance[row, task]
        if reached.isnan() or needed.isnan():
            raise Undefined(f"an evaluation of task {task + 1}, or what counts as mastered, is not known")
        if reached >= needed:
            return curves.frames[row] - start
    return math.nan
