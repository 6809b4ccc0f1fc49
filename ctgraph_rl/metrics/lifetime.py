"""The lifelong metrics of the DARPA L2M programme, as the program l2metrics 3.1.0 computes them.

New et al. 2022 and Baker et al. 2023 define them on regimes: stays on one task, either training or evaluation, each
with the performance of its experiences in order. An experience is an episode there, a training interval of a run's log
here. l2metrics first smooths training and scales each task to 1..101: `prepare`. Its scale depends on the run unless
ranges are given, and its offset of 1 makes ratios: from 0 to half of the range is a "forward transfer" of 51. Give
ranges, and read ratios of sparse rewards with care, or take contrasts of unscaled performance.

Means leave out tasks and pairs without a value as l2metrics does; here they are counted. Deviations, on purpose:

- Where other tasks are trained between the two evaluations of a transfer, it cannot be told whose it is. l2metrics
  keeps the last of them, direct learning included; here there is no value.
- Ratios and contrasts of negative performance, in which an improvement may read as a loss, have no value here; nor has
  a relative performance whose expert has the sum 0, which is infinite there.
- Values that differ by rounding are equal: a plateau is reached at its start. There, the last bit decides.
- Of several experts of a task, one without a value makes the task's undefined; l2metrics leaves that expert out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, pairwise, permutations
from statistics import median

import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import between, from_failure_to_best, not_negative
from ctgraph_rl.metrics.record import defined

NEW = "New et al. 2022, Lifelong learning metrics (arXiv 2201.08278), as in l2metrics 3.1.0"
SCALE, OFFSET = 100.0, 1.0
LONGEST_WINDOW = 100
UNSATURATED_SHARE = 0.2
"""Share of an expert's saturation below which sample efficiency is 0."""

ROUNDING = 1e-12
"""Relative difference below which two values are equal."""


@dataclass(frozen=True)
class Regime:
    """A stay on one task.

    Args:
        task: name of the task.
        training: True for training, False for an evaluation.
        values: performance of each experience in order, float64 [experiences].

    Raises:
        ValueError: for no values, or one that is not finite.
    """

    task: str
    training: bool
    values: Tensor

    def __post_init__(self) -> None:
        if self.values.ndim != 1 or len(self.values) == 0 or not self.values.isfinite().all():
            raise ValueError(f"a regime of {self.task} needs finite values [experiences], got {self.values}")

    @property
    def terminal(self) -> float:
        """Terminal performance: mean of the last tenth of a training, of all of an evaluation."""
        start = int((1 - 0.1) * len(self.values)) if self.training else 0
        return self.values[start:].mean().item()


Regimes = Sequence[Regime]
Experts = Mapping[str, Sequence[Tensor]]
Ranges = Mapping[str, tuple[float, float]]


def smooth(values: Tensor) -> Tensor:
    """Moving average over a fifth of the values, at most 100, mirrored at both ends; untouched below 15 values."""
    window = min(int(len(values) * 0.2), LONGEST_WINDOW)
    if window < 3:
        return values
    head, tail = values[1:window].flip(0), values[-window:-1].flip(0)
    weights = torch.full((window,), 1 / window, dtype=values.dtype)
    means = (torch.cat([head, values, tail]).unfold(0, window, 1) * weights).sum(1)
    return means[math.floor(window / 2 - 1) : len(means) - math.ceil(window / 2)]


def prepare(regimes: Regimes, experts: Experts | None = None, ranges: Ranges | None = None) -> tuple[Regimes, Experts]:
    """Smooth training and scale each task to 1..101, as l2metrics does before it measures.

    Args:
        regimes: a run.
        experts: for each task, the training curves of its experts.
        ranges: lowest and highest performance of each task; by default those of the smoothed run and its experts. A
            task with an empty range is 1 throughout.
    """
    smoothed = [replace(each, values=smooth(each.values)) if each.training else each for each in regimes]
    expert_curves = {task: [smooth(curve) for curve in curves] for task, curves in (experts or {}).items()}
    found = {each.task: _range([*_of_task(smoothed, each.task), *expert_curves.get(each.task, [])]) for each in regimes}
    scales = found if ranges is None else ranges
    scaled = [replace(each, values=_scaled(each.values, *scales[each.task])) for each in smoothed]
    known = {task: curves for task, curves in expert_curves.items() if task in scales}
    return scaled, {task: [_scaled(curve, *scales[task]) for curve in curves] for task, curves in known.items()}


ON_THE_SCALE = from_failure_to_best(OFFSET, OFFSET + SCALE)

of_tasks = partial(defined, source=NEW, partial=True, missing="a task has none")


@of_tasks(
    "new2022/train-performance",
    "mean over tasks and regimes of mean training performance",
    bounds=ON_THE_SCALE,
)
def mean_training_performance(regimes: Regimes) -> Tensor:
    """Mean over tasks of the mean over training regimes of their mean performance."""
    return _per_task(regimes, lambda task: _mean([r.values.mean().item() for r in _training(regimes, task)]))


@of_tasks(
    "new2022/eval-performance",
    "mean over tasks and regimes of mean evaluation performance",
    bounds=ON_THE_SCALE,
)
def mean_evaluation_performance(regimes: Regimes) -> Tensor:
    """Mean over tasks of the mean over evaluations of their mean performance."""
    tests = [each for each in regimes if not each.training]
    return _per_task(regimes, lambda task: _mean([r.values.mean().item() for r in tests if r.task == task]))


@of_tasks(
    "new2022/perf-recovery",
    "mean over tasks of -slope of recovery times",
    missing="a task has fewer than two recovery times",
)
def performance_recovery(regimes: Regimes) -> Tensor:
    """PR: whether a task is recovered faster each time that it comes back; positive when it is.

    The recovery time of a training regime is the number of experiences before the first one that is as good as the
    terminal performance of the task's regime before, and one more than all of them if none is. The slope is
    Theil-Sen's. A task needs three training regimes.
    """
    return _per_task(regimes, lambda task: -theil_sen(recovery_times(_training(regimes, task))))


@of_tasks(
    "new2022/perf-maintenance-mrlep",
    "mean over tasks and later evaluations e of tp(e) - tp(first evaluation after the last training)",
    missing="a task has no later evaluation",
    bounds=between(-SCALE, SCALE),
)
def maintenance_of_evaluation(regimes: Regimes) -> Tensor:
    """PM (mrlep): change of a task's evaluations against the most recent one right after its training.

    Not negative when nothing is forgotten. A task that is trained last has no later evaluation.
    """
    return _per_task(regimes, lambda task: _mean(list(_maintenance(regimes, task, to_evaluation=True))))


@of_tasks(
    "new2022/perf-maintenance-mrtlp",
    "mean over tasks and later evaluations e of tp(e) - tp(last training)",
    missing="a task has no later evaluation",
    bounds=between(-SCALE, SCALE),
)
def maintenance_of_training(regimes: Regimes) -> Tensor:
    """PM (mrtlp): as `maintenance_of_evaluation`, against the terminal performance of the most recent training."""
    return _per_task(regimes, lambda task: _mean(list(_maintenance(regimes, task, to_evaluation=False))))


def _quotient(before: float, after: float) -> float:
    return after / before if before > 0 and after >= 0 else math.nan


def _contrast(before: float, after: float) -> float:
    return (after - before) / (before + after) if min(before, after) >= 0 < before + after else math.nan


of_pairs = partial(
    defined,
    source=NEW,
    partial=True,
    missing="a pair of tasks has no evaluations around a training of one task alone, or none that are positive",
)


@of_pairs(
    "new2022/ft-ratio", "mean over pairs (a, b) of tp(e2) / tp(e1) of b around a training of a", bounds=not_negative
)
def forward_transfer_ratio(regimes: Regimes) -> Tensor:
    """FT: what training a task a, before b's first training, does to the evaluations of b right before and after.

    Of each pair only the first value counts. 1 is neutral. Pairs without evaluations around the training have no
    value: without an evaluation before any training, all of the first task. Nor have those with tp(e1) = 0, however
    large the gain: sparse rewards want `forward_transfer_contrast`.
    """
    return _transfer(regimes, _quotient, forward=True)


@of_pairs("new2022/ft-contrast", "as ft-ratio, of (tp(e2) - tp(e1)) / (tp(e1) + tp(e2))", bounds=between(-1, 1))
def forward_transfer_contrast(regimes: Regimes) -> Tensor:
    """FT as a contrast: in [-1, 1], 0 is neutral; no value only where both are 0. Else as `forward_transfer_ratio`."""
    return _transfer(regimes, _contrast, forward=True)


@of_pairs("new2022/bt-ratio", "as ft-ratio, for trainings of a after b's first training", bounds=not_negative)
def backward_transfer_ratio(regimes: Regimes) -> Tensor:
    """BT: what training a task a, after b's first training, does to b. Else as `forward_transfer_ratio`."""
    return _transfer(regimes, _quotient, forward=False)


@of_pairs("new2022/bt-contrast", "as bt-ratio, of (tp(e2) - tp(e1)) / (tp(e1) + tp(e2))", bounds=between(-1, 1))
def backward_transfer_contrast(regimes: Regimes) -> Tensor:
    """BT as a contrast. Else as `backward_transfer_ratio`."""
    return _transfer(regimes, _contrast, forward=False)


@of_tasks(
    "new2022/relative-performance",
    "mean over tasks of sum of training performance / sum of the expert's, over equally many experiences",
    missing="a task has no expert, or a sum is not positive",
    bounds=not_negative,
)
def relative_performance(regimes: Regimes, experts: Experts) -> Tensor:
    """RP: training performance of a task against its experts'; 1 is neutral.

    Compares experiences with experiences, whatever their length.

    Args:
        regimes: a run.
        experts: for each task, the training curves of its experts; the mean over them counts.
    """

    def of_task(task: str) -> float:
        own = torch.cat([each.values for each in _training(regimes, task)])
        pairs = [(curve[: len(own)], own[: len(curve)]) for curve in experts[task]]
        return _mean([_quotient(expert.sum().item(), trained.sum().item()) for expert, trained in pairs])

    return _per_task(regimes, lambda task: of_task(task) if experts.get(task) else math.nan, only_trained=True)


@of_tasks(
    "new2022/sample-efficiency",
    "mean over tasks of (saturation / expert's) * (expert's experiences to saturation / own)",
    missing="a task has no expert, or a curve is best at its start or not positive",
    bounds=not_negative,
)
def sample_efficiency(regimes: Regimes, experts: Experts) -> Tensor:
    """SE: how high and how soon training saturates against experts; 1 is neutral.

    Saturation is the highest value of the smoothed curve over all training of a task. The term is 0 where it is below
    a fifth of the expert's, or where the line fitted through the training falls. A curve that is best at its start has
    no value, so a perfect jump-start has none.

    Args:
        regimes: a run.
        experts: for each task, the training curves of its experts; the mean over them counts.
    """

    def of_task(task: str) -> float:
        own = torch.cat([each.values for each in _training(regimes, task)])
        level, time = _saturation(own)
        falls = _falls(regimes, task)
        return _mean([_efficiency(level, time, *_saturation(curve), falls) for curve in experts[task]])

    return _per_task(regimes, lambda task: of_task(task) if experts.get(task) else math.nan, only_trained=True)


def recovery_times(training: Regimes) -> list[int]:
    """For each regime but the first, experiences until the terminal performance of the one before is reached again."""
    return [_first_at_least(after.values, before.terminal) for before, after in pairwise(training)]


def theil_sen(values: Sequence[float]) -> float:
    """Median slope over all pairs of values at the positions 0, 1, ...; NaN for fewer than two."""
    slopes = [(values[j] - values[i]) / (j - i) for i, j in combinations(range(len(values)), 2)]
    return median(slopes) if slopes else math.nan


def _first_at_least(values: Tensor, level: float) -> int:
    """Position of the first value that reaches a level, rounding apart; one more than all of them if none does."""
    reached = (values >= level - ROUNDING * abs(level)).nonzero()
    return int(reached[0]) if len(reached) else len(values) + 1


def _maintenance(regimes: Regimes, task: str, to_evaluation: bool) -> Iterator[float]:
    """Changes against the reference at every evaluation of a task that is no reference itself."""
    training: Regime | None = None
    reference: Regime | None = None
    for each in (each for each in regimes if each.task == task):
        if each.training:
            training, reference = each, None
        elif training is not None and reference is None:
            reference = each
        elif training is not None and reference is not None:
            yield each.terminal - (reference if to_evaluation else training).terminal


def _transfer(regimes: Regimes, measure: Callable[[float, float], float], forward: bool) -> Tensor:
    """The first value of every ordered pair (a, b) in which a is trained before, or after, b's first training."""
    terms = []
    for a, b in permutations(_tasks(regimes), 2):
        start = _first_training(regimes, b)
        trainings = [i for i, r in enumerate(regimes) if r.training and r.task == a and (i < start) == forward]
        if trainings:
            terms.append(_first_value(regimes, b, trainings, measure))
    return _tensor(terms)


def _first_training(regimes: Regimes, task: str) -> int:
    """Position of a task's first training, behind all regimes if there is none."""
    return next((i for i, each in enumerate(regimes) if each.training and each.task == task), len(regimes))


def _first_value(regimes: Regimes, task: str, trainings: list[int], measure: Callable[[float, float], float]) -> float:
    evaluations = [i for i, each in enumerate(regimes) if not each.training and each.task == task]
    for before, after in pairwise(evaluations):
        between = [i for i in range(before, after) if regimes[i].training]
        alone = len({regimes[i].task for i in between}) == 1
        value = measure(regimes[before].terminal, regimes[after].terminal)
        if alone and between[-1] in trainings and not math.isnan(value):
            return value
    return math.nan


def _saturation(values: Tensor) -> tuple[float, int]:
    """The highest value of the smoothed curve, and the experiences before it."""
    smoothed = smooth(values)
    level = smoothed.max().item()
    return level, _first_at_least(smoothed, level)


def _efficiency(level: float, time: int, expert_level: float, expert_time: int, falls: bool) -> float:
    if time == 0 or expert_time == 0:
        return math.nan
    if falls or level < UNSATURATED_SHARE * expert_level:
        return 0.0
    return _quotient(expert_level, level) * expert_time / time


def _falls(regimes: Regimes, task: str) -> bool:
    """Whether the least-squares line through a task's training falls, over the experiences of the whole run."""
    starts = torch.tensor([0] + [len(each.values) for each in regimes]).cumsum(0)
    own = [i for i, each in enumerate(regimes) if each.training and each.task == task]
    times = torch.cat([starts[i] + torch.arange(len(regimes[i].values)) for i in own]).double()
    values = torch.cat([regimes[i].values for i in own])
    return bool(((times - times.mean()) * (values - values.mean())).sum() < 0)


def _per_task(regimes: Regimes, value: Callable[[str], float], only_trained: bool = False) -> Tensor:
    """A value for each task, in the order of first appearance."""
    return _tensor([value(task) for task in _tasks(regimes) if not only_trained or _training(regimes, task)])


def _tasks(regimes: Regimes) -> list[str]:
    return list(dict.fromkeys(each.task for each in regimes))


def _training(regimes: Regimes, task: str) -> list[Regime]:
    return [each for each in regimes if each.training and each.task == task]


def _of_task(regimes: Regimes, task: str) -> list[Tensor]:
    return [each.values for each in regimes if each.task == task]


def _range(curves: Sequence[Tensor]) -> tuple[float, float]:
    values = torch.cat(list(curves))
    return values.min().item(), values.max().item()


def _scaled(values: Tensor, low: float, high: float) -> Tensor:
    return torch.full_like(values, OFFSET) if low == high else (values - low) / (high - low) * SCALE + OFFSET


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan


def _tensor(values: Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
