"""Metrics of labels that a learner gives to tasks itself, against the true tasks.

Training is intervals in time order, each of one batch, or a block's part of it. An *alarm* is where the learner leaves
its label, because a detector suspects a change or says another label. A *change* is where the intervals' task changes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from torch import Tensor

from ctgraph_rl.metrics.bounds import between, not_negative, of_performance
from ctgraph_rl.metrics.record import HERE, Undefined, defined, float64

HUBERT = "Hubert & Arabie 1985, Comparing partitions (Journal of Classification 2)"

SEVERAL = -1

PER = 100_000
"""Frames per which alarms are counted."""


class Labelling(NamedTuple):
    """The labels of a run; a value per training interval, [intervals]."""

    acted: Tensor  # int64: the label that acted
    task: Tensor  # int64: the true task, or SEVERAL
    frames: Tensor  # int64: frames of the interval
    learned: Tensor  # bool: whether they were learned from
    alarm: Tensor  # bool: whether there is an alarm at the end of the interval
    rolled_back: Tensor  # int64: earlier frames whose learning was undone there
    announced: bool = False  # whether changes were announced
    oracle: bool = False  # whether the detector knows the true tasks

    def check_one_task_each(self) -> None:
        """Raise `Undefined` where an interval has several tasks."""
        if (self.task == SEVERAL).any():
            raise Undefined("needs blocks of one task each: others have no true label")

    def check_hidden(self) -> None:
        """Raise `Undefined` where changes are announced."""
        if self.announced:
            raise Undefined("task changes are announced, there is nothing to detect")


@defined(
    "ctgraph_rl/detection-delay",
    "mean over detected changes c of (frames at the first alarm after c, up to the next change) - (frames at c)",
    HERE,
    partial=True,
    missing="no alarm before the next change",
    bounds=not_negative,
    is_time=True,
)
def detection_delay(labelling: Labelling) -> Tensor:
    """Return the frames from each change of task to its first alarm; NaN for a missed one.

    Missed changes are left out of the mean, and counted. Alarms are at ends of batches; those count whose batch has
    frames of the new task, up to the next change. An alarm right at the change has only seen the old task: it counts,
    with delay 0, for the oracle.
    """
    return _delays(labelling)


@defined(
    "ctgraph_rl/false-alarms",
    "100,000 (alarms - detected changes) / frames",
    HERE,
    bounds=not_negative,
)
def false_alarms(labelling: Labelling) -> Tensor:
    """Return the alarms per 100,000 frames that are not the first ones after a change of task."""
    detected = int((~_delays(labelling).isnan()).sum())
    rate = PER * (int(labelling.alarm.sum()) - detected) / int(labelling.frames.sum())
    return float64([rate])


@defined("ctgraph_rl/labels-per-task", "labels learned with / tasks trained", HERE, bounds=not_negative)
def labels_per_task(labelling: Labelling) -> Tensor:
    """Return the number of labels that were learned with, over that of tasks; 1 is right."""
    labelling.check_one_task_each()
    labels = labelling.acted[labelling.learned].unique()
    tasks = labelling.task.unique()
    return float64([len(labels) / len(tasks)])


@defined(
    "hubert1985/adjusted-rand-index",
    "2 (a d - b c) / ((a + b)(b + d) + (a + c)(c + d)), over pairs of frames: a same task and label, b same task only, "
    "c same label only, d neither; 1 where b = c = 0",
    HUBERT,
    bounds=between(-0.5, 1),
)
def label_agreement(labelling: Labelling) -> Tensor:
    """Return the adjusted Rand index of the true tasks and the labels that acted, over all frames of training.

    1: each task has its own label. 0 is expected of unrelated labels.
    """
    labelling.check_one_task_each()
    return float64([adjusted_rand_index(*labelling[:3])])


@defined("ctgraph_rl/frames-not-learned", "frames of batches that were not learned from", HERE, bounds=not_negative)
def frames_not_learned(labelling: Labelling) -> Tensor:
    """Return the number of frames that were not learned from, while labels were tried."""
    return labelling.frames[~labelling.learned].sum().double().view(1)


@defined("ctgraph_rl/frames-rolled-back", "frames whose learning was undone", HERE, bounds=not_negative)
def frames_rolled_back(labelling: Labelling) -> Tensor:
    """Return the number of frames whose learning an alarm undid."""
    return labelling.rolled_back.sum().double().view(1)


@defined(
    "ctgraph_rl/online-return",
    "sum_k episodes_k return_k / sum_k episodes_k, over training intervals k",
    HERE,
    bounds=of_performance,
)
def online_return(episodes: Tensor, returns: Tensor) -> Tensor:
    """Return the mean return of all episodes that finished in training.

    Args:
        episodes: finished episodes of each interval, [intervals].
        returns: their mean return; NaN without episodes.
    """
    if not (episodes > 0).any():
        raise Undefined("no episode finished in training")
    played = episodes > 0
    return ((episodes * returns)[played].sum() / episodes[played].sum()).view(1)


def adjusted_rand_index(labels: Tensor, tasks: Tensor, frames: Tensor) -> float:
    """Return the adjusted Rand index of two partitions of frames, given as intervals, [intervals] each; exact integers
    inside.
    """
    table = counts(tasks, labels, frames)
    rows: Counter[int] = Counter()
    columns: Counter[int] = Counter()
    for (task, label), number in table.items():
        rows[task] += number
        columns[label] += number
    pairs = _pairs(sum(table.values()))
    both = sum(map(_pairs, table.values()))
    task_only = sum(map(_pairs, rows.values())) - both
    label_only = sum(map(_pairs, columns.values())) - both
    neither = pairs - both - task_only - label_only
    if task_only == label_only == 0:
        return 1.0
    above = 2 * (both * neither - task_only * label_only)
    below = (both + task_only) * (task_only + neither) + (both + label_only) * (label_only + neither)
    return above / below


def counts(tasks: Tensor, labels: Tensor, frames: Tensor) -> Counter[tuple[int, int]]:
    """Return the frames of each task with each label."""
    found: Counter[tuple[int, int]] = Counter()
    for task, label, number in zip(tasks.tolist(), labels.tolist(), frames.tolist(), strict=True):
        found[task, label] += number
    return found


def most_frequent(tasks: Sequence[int], labels: Sequence[int], frames: Sequence[float]) -> dict[int, int]:
    """Return each task's label with most frames; of equal ones the lowest."""
    found: dict[int, dict[int, float]] = {}
    for task, label, number in zip(tasks, labels, frames, strict=True):
        of_task = found.setdefault(task, {})
        of_task[label] = of_task.get(label, 0) + number
    return {task: min(of_task, key=lambda label: (-of_task[label], label)) for task, of_task in found.items()}


def _pairs(number: int) -> int:
    return number * (number - 1) // 2


def _delays(labelling: Labelling) -> Tensor:
    labelling.check_hidden()
    labelling.check_one_task_each()
    ends = labelling.frames.cumsum(0)
    changes = ends[:-1][labelling.task[1:] != labelling.task[:-1]].tolist()
    alarms = ends[labelling.alarm].tolist()
    delays = []
    for start, stop in pairwise([*changes, math.inf]):
        if labelling.oracle:
            own = [alarm for alarm in alarms if start <= alarm < stop]
        else:
            own = [alarm for alarm in alarms if start < alarm <= stop]
        delays.append(own[0] - start if own else math.nan)
    return float64(delays)
