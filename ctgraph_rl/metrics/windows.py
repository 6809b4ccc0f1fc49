"""Metrics of a life of many tasks: means over ten windows of successive blocks, a task each.

Each has a term for each window, in order, so that they stay readable whatever the number of tasks. Within a block a
task is *adapted to* from 0.9 of the way from its failure's return to its optimum on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import (
    between,
    from_failure_to_best,
    not_negative,
    of_changes,
    of_kept_shares,
    of_losses,
    of_performance,
)
from ctgraph_rl.metrics.record import HERE, MASTERED, METRICS, Undefined, defined, ratio

NUM_WINDOWS = 10

JUMP_START = "Taylor & Stone 2009, JMLR 10: jumpstart"

of_windows = partial(defined, source=HERE, partial=True, missing="no task of a window has a value")
of_retention = partial(of_windows, aggregate=torch.sum, bounds=of_kept_shares)


@dataclass(frozen=True)
class LifeCurves:
    """A life by blocks. N blocks have M evaluations each, after one at their start.

    Args:
        frames: of each block.
        moments: of evaluations, float64 [M + 1], frames since the block's start.
        returns: of the block's task at these moments, float64 [N, M + 1]; NaN where not evaluated.
        success: share of episodes at the goal at the block's end, float64 [N].
        best: the task's optimal mean return, float64 [N].
        zero: its return of a failure, float64 [N].
        untrained: return of the untrained agent on it, float64 [N]; NaN for the first task, and for one that returns.
        lagged: by lag, the return at the block's end of the task trained so many blocks before, float64 [N].
        reward: sum of the block's rewards, float64 [N].
        gain: largest reward per frame of any policy, float64 [N].
        alike: whether all tasks are equally difficult.
    """

    frames: int
    moments: Tensor
    returns: Tensor
    success: Tensor
    best: Tensor
    zero: Tensor
    untrained: Tensor
    lagged: Mapping[int, Tensor]
    reward: Tensor
    gain: Tensor
    alike: bool

    @property
    def progress(self) -> Tensor:
        """Returns on a scale from failure, 0, to optimum, 1; [N, M + 1]."""
        return ratio(self.returns - self.zero.unsqueeze(1), (self.best - self.zero).unsqueeze(1))

    @property
    def solved(self) -> Tensor:
        """1 where the task is adapted to, else 0; NaN where not evaluated; float64 [N, M + 1]."""
        progress = self.progress
        return torch.where(progress.isnan(), torch.nan, (progress >= MASTERED - 1e-9).double())

    @property
    def adapted(self) -> Tensor:
        """The frames of each block until its task is adapted to, at most all of them; float64 [N], NaN if unknown."""
        most, first = self.solved.max(1)
        frames = torch.where(most == 1, self.moments[first], float(self.frames))
        return torch.where(most.isnan(), torch.nan, frames)


def window_means(values: Tensor) -> Tensor:
    """Return the mean of each window of blocks, without NaN, float64 [windows]; values are [N]."""
    return torch.stack([part.nanmean() for part in _windows(values)])


def _windows(values: Tensor) -> tuple[Tensor, ...]:
    return values.tensor_split(min(NUM_WINDOWS, len(values)))


def _last(windows: Tensor) -> Tensor:
    return windows[-1]


@of_windows(
    "ctgraph_rl/window-return",
    "mean over the last w tasks i of R_i(end of i's block)",
    aggregate=_last,
    bounds=of_performance,
)
def window_return(life: LifeCurves) -> Tensor:
    """Mean return at the end of their blocks of the last window's tasks."""
    return window_means(life.returns[:, -1])


@of_windows(
    "ctgraph_rl/window-success",
    "as window-return, of the share of episodes at the goal",
    aggregate=_last,
    bounds=between(0, 1),
)
def window_success(life: LifeCurves) -> Tensor:
    """Mean success rate at the end of their blocks of the last window's tasks."""
    return window_means(life.success)


@of_windows(
    "ctgraph_rl/window-regret",
    "mean over the last w tasks i of V*_i - R_i(end of i's block)",
    aggregate=_last,
    bounds=of_losses,
)
def window_regret(life: LifeCurves) -> Tensor:
    """Mean distance to the optimum at the end of their blocks of the last window's tasks."""
    return window_means(life.best - life.returns[:, -1])


@of_windows(
    "ctgraph_rl/solved",
    "share of the last w tasks i with adapted R_i(end of i's block)",
    aggregate=_last,
    bounds=between(0, 1),
)
def window_solved(life: LifeCurves) -> Tensor:
    """Share of the last window's tasks that are adapted to at the end of their blocks."""
    return window_means(life.solved[:, -1])


@defined(
    "taylor2009/jumpstart",
    "mean over windows, and over their new tasks i > 1, of R_i(start of i's block) - R_i(untrained)",
    JUMP_START,
    partial=True,
    missing="no new task of a window has both evaluations",
    bounds=of_changes,
)
def jump_start(life: LifeCurves) -> Tensor:
    """Return at a task's first evaluation, less that of an untrained copy of the agent."""
    return window_means(life.returns[:, 0] - life.untrained)


@of_windows(
    "ctgraph_rl/adaptation-frames",
    "mean over windows, and over their tasks, of the frames to 0.9, at most a block's",
    bounds=not_negative,
)
def adaptation_frames(life: LifeCurves) -> Tensor:
    """Frames of a block until its task is adapted to; a task that never is counts the whole block."""
    return window_means(life.adapted)


@of_windows(
    "ctgraph_rl/never-adapted",
    "mean over windows of the share of tasks below 0.9 throughout their block",
    bounds=between(0, 1),
)
def never_adapted(life: LifeCurves) -> Tensor:
    """Share of tasks that are not adapted to at any evaluation in their block."""
    return window_means(1 - life.solved.amax(1))


@of_windows(
    "ctgraph_rl/adaptation-area",
    "mean over windows, tasks i and evaluations t > 0 of i's block of (R_i(t) - zero_i) / (V*_i - zero_i)",
    bounds=from_failure_to_best(0, 1),
)
def adaptation_area(life: LifeCurves) -> Tensor:
    """Area under a task's curve over its block, on a scale from failure to optimum."""
    return window_means(life.progress[:, 1:].mean(1))


def _retention(life: LifeCurves, lag: int) -> Tensor:
    if len(life.success) <= lag:
        raise Undefined(f"the life has {len(life.success)} blocks, and none is {lag} blocks after another")
    before = life.progress[:, -1].roll(lag)
    kept = ratio(life.lagged[lag] - life.zero.roll(lag), (life.best - life.zero).roll(lag))
    own = torch.where(kept.isnan(), torch.nan, before)
    sums = torch.stack([part.nanmean() * part.isfinite().sum() for part in _windows(kept)])
    return ratio(sums, own.nansum())


@of_retention("ctgraph_rl/retention-1", "sum_i R_i(1 block later) / sum_i R_i(end of i's block)")
def retention_1(life: LifeCurves) -> Tensor:
    """Share of a task's return, from failure to optimum, that is left one block later."""
    return _retention(life, 1)


@of_retention("ctgraph_rl/retention-10", "as retention-1, 10 blocks later")
def retention_10(life: LifeCurves) -> Tensor:
    """Share that is left ten blocks later."""
    return _retention(life, 10)


@of_retention("ctgraph_rl/retention-100", "as retention-1, 100 blocks later")
def retention_100(life: LifeCurves) -> Tensor:
    """Share that is left a hundred blocks later."""
    return _retention(life, 100)


@of_windows(
    "ctgraph_rl/learnability",
    "mean over the last w tasks of the frames to 0.9, at most a block's, over those of task 1",
    aggregate=_last,
    bounds=not_negative,
)
def learnability(life: LifeCurves) -> Tensor:
    """How much longer the last window's tasks take than the first task; tasks are equally difficult.

    1: as long; more: learning got slower. Undefined if task 1 was never adapted to, or at once.
    """
    if not life.alike:
        raise Undefined("tasks differ in graph, rewards or what is observed, so frames do not compare")
    first = life.adapted[0].item()
    if not 0 < first < life.frames:
        raise Undefined("task 1 was adapted to at once, or never in its block")
    return window_means(life.adapted) / first


@of_windows(
    "ctgraph_rl/frame-regret",
    "sum over frames t of g*_t - reward_t; g* = max over policies of E[return] / E[length]",
    aggregate=torch.sum,
)
def frame_regret(life: LifeCurves) -> Tensor:
    """Reward lost in all frames of the life, against the policy with the most reward per frame.

    `regret` counts finished episodes in its place, whatever their length.
    """
    lost = life.gain * life.frames - life.reward
    return torch.stack([part.sum() for part in _windows(lost)])


OF_LIFE = tuple(name for name, entry in METRICS.items() if entry.required == ("life",))
