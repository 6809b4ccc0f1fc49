"""The lifelong metrics of the DARPA L2M programme, as the program l2metrics 3.1.0 computes them.

New et al. 2022 and Baker et al. 2023 define them on regimes: stays on one task, either training or evaluation, each
with the performance of its experiences in order, here training intervals. l2metrics first smooths training and scales
each task to 1..101: `prepare`. Without given ranges the scale depends on the run, and its offset of 1 makes ratios:
from 0 to half of the range is a "forward transfer" of 51. Give ranges, or take contrasts of unscaled performance.

Means leave out tasks and pairs without a value, which are counted. Deliberate deviations from l2metrics:

- Where other tasks are trained between the two evaluations of a transfer, there is no value; l2metrics keeps the last.
- Ratios and contrasts of negative performance have no value, as they may read improvement as loss; nor has a relative
  performance whose expert has the sum 0.
- Values that differ by rounding are equal: a plateau is reached at its start.
- One of a task's experts without a value makes the task's undefined; l2metrics leaves that expert out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import between, from_failure_to_best, not_negative, of_changes_on_scale
from ctgraph_rl.metrics.record import defined, float64
from ctgraph_rl.metrics.regimes import Regime, RegimeTable

NEW = "New et al. 2022, Lifelong learning metrics (arXiv 2201.08278), as in l2metrics 3.1.0"
BAKER = f"{NEW}; Baker et al. 2023 (arXiv 2301.07799)"
SCALE = 100.0
OFFSET = 1.0
LONGEST_WINDOW = 100
UNSATURATED_SHARE = 0.2
"""Share of an expert's saturation below which sample efficiency is 0."""

ROUNDING = 1e-12


Regimes = Sequence[Regime]
Experts = Mapping[str, Sequence[Tensor]]
Ranges = Mapping[str, tuple[float, float]]
Measure = Callable[[Any, Any], Any]


def smooth(values: Tensor) -> Tensor:
    """Moving average over a fifth of the values, at most 100, mirrored at both ends; unchanged below 15 values."""
    window = min(int(len(values) * 0.2), LONGEST_WINDOW)
    if window < 3:
        return values
    head = values[1:window].flip(0)
    tail = values[-window:-1].flip(0)
    weights = torch.full((window,), 1 / window, dtype=values.dtype, device="cpu")
    means = (torch.cat([head, values, tail]).unfold(0, window, 1) * weights).sum(1)
    return means[math.floor(window / 2 - 1) : len(means) - math.ceil(window / 2)]


def prepare(regimes: Regimes, experts: Experts | None = None, ranges: Ranges | None = None) -> tuple[Regimes, Experts]:
    """Smooth training and scale each task to 1..101, as l2metrics does before it measures.

    Args:
        experts: each task's experts' training curves.
        ranges: lowest and highest performance of each task; by default of the smoothed run and its experts. An empty
            range gives 1 throughout.
    """
    table = RegimeTable.of(regimes)
    values = table.values.clone()
    for i in np.flatnonzero(table.training).tolist():
        values[table.starts[i] : table.starts[i + 1]] = smooth(table.values_of(i))
    smoothed = table.replaced(values)
    expert_curves = {task: [smooth(curve) for curve in curves] for task, curves in (experts or {}).items()}
    scales = _ranges(smoothed, expert_curves) if ranges is None else ranges
    missing = sorted(set(table.names) - set(scales))
    if missing:
        raise ValueError(f"ranges must have each task, there is none of {missing}")
    limits = float64([scales[task] for task in table.names]).view(-1, 2)
    low, high = limits.unbind(1)
    of_task = torch.from_numpy(table.task.repeat(table.length))
    scaled = smoothed.replaced(_scaled(smoothed.values, low[of_task], high[of_task]))
    scaled_experts = {}
    for task, curves in expert_curves.items():
        if task in scales:
            ends = float64(scales[task])
            scaled_experts[task] = [_scaled(curve, *ends) for curve in curves]
    return scaled, scaled_experts


ON_THE_SCALE = from_failure_to_best(OFFSET, OFFSET + SCALE)

of_tasks = partial(defined, source=NEW, partial=True, missing="a task has none")


@of_tasks(
    "new2022/train-performance",
    "mean over tasks and regimes of mean training performance",
    bounds=ON_THE_SCALE,
)
def mean_training_performance(regimes: Regimes) -> Tensor:
    """Mean over tasks of the mean over training regimes of their mean performance."""
    table = RegimeTable.of(regimes)
    return float64([_mean([table.values_of(i).mean().item() for i in own]) for own in table.places(training=True)])


@of_tasks(
    "new2022/eval-performance",
    "mean over tasks and regimes of mean evaluation performance",
    bounds=ON_THE_SCALE,
)
def mean_evaluation_performance(regimes: Regimes) -> Tensor:
    """Mean over tasks of the mean over evaluations of their mean performance."""
    table = RegimeTable.of(regimes)
    return float64([_mean(table.terminal[own].tolist()) for own in table.places(training=False)])


@of_tasks(
    "new2022/perf-recovery",
    "mean over tasks of -slope of recovery times",
    missing="a task has fewer than two recovery times",
)
def performance_recovery(regimes: Regimes) -> Tensor:
    """PR: whether a task is recovered faster each time that it comes back; positive when it is.

    A training regime's recovery time is the number of experiences before the first one as good as the terminal
    performance of the task's regime before; without one, one more than all. The slope is Theil-Sen's. A task needs
    three training regimes.
    """
    table = RegimeTable.of(regimes)
    return float64([-theil_sen(recovery_times([table[i] for i in own])) for own in table.places(training=True)])


@of_tasks(
    "new2022/perf-maintenance-mrlep",
    "mean over tasks and later evaluations e of tp(e) - tp(first evaluation after the last training)",
    missing="a task has no later evaluation",
    bounds=of_changes_on_scale(SCALE),
)
def maintenance_of_evaluation(regimes: Regimes) -> Tensor:
    """PM (mrlep): change of a task's evaluations against the last one right after its training.

    Not negative when nothing is forgotten. A task that is trained last has no later evaluation.
    """
    return _maintenance(RegimeTable.of(regimes), to_evaluation=True)


@of_tasks(
    "new2022/perf-maintenance-mrtlp",
    "mean over tasks and later evaluations e of tp(e) - tp(last training)",
    missing="a task has no later evaluation",
    bounds=of_changes_on_scale(SCALE),
)
def maintenance_of_training(regimes: Regimes) -> Tensor:
    """PM (mrtlp): as `maintenance_of_evaluation`, against the last training's terminal performance."""
    return _maintenance(RegimeTable.of(regimes), to_evaluation=False)


def _quotient(before: float, after: float) -> float:
    return after / before if before > 0 and after >= 0 else math.nan


def _quotients(before: Any, after: Any) -> Any:
    return np.divide(after, before, out=np.full_like(before, math.nan), where=(before > 0) & (after >= 0))


def _contrasts(before: Any, after: Any) -> Any:
    has_value = (np.minimum(before, after) >= 0) & (before + after > 0)
    return np.divide(after - before, before + after, out=np.full_like(before, math.nan), where=has_value)


of_pairs = partial(
    defined,
    source=BAKER,
    partial=True,
    missing="a pair of tasks has no evaluations around a training of one task alone, or none that are positive",
)


@of_pairs(
    "new2022/ft-ratio",
    "mean over pairs (a, b) of b's evaluation right after / before training on a, scaled to 1..101",
    bounds=not_negative,
)
def forward_transfer_ratio(regimes: Regimes) -> Tensor:
    """FT: what training a task a, before b's first training, does to the evaluations of b right before and after.

    Only the first value of a pair counts. 1 is neutral. Pairs without evaluations around the training have no value:
    without an evaluation before any training, all of the first task. Nor have those with tp(e1) = 0, however large the
    gain: sparse rewards want `forward_transfer_contrast`.
    """
    return _transfer(regimes, _quotients, forward=True)


@of_pairs("new2022/ft-contrast", "as new2022/ft-ratio, of (tp(e2) - tp(e1)) / (tp(e1) + tp(e2))", bounds=between(-1, 1))
def forward_transfer_contrast(regimes: Regimes) -> Tensor:
    """FT as a contrast: in [-1, 1], 0 is neutral; no value only where both are 0. Else as `forward_transfer_ratio`."""
    return _transfer(regimes, _contrasts, forward=True)


@of_pairs("new2022/bt-ratio", "as new2022/ft-ratio, for trainings of a after b's first training", bounds=not_negative)
def backward_transfer_ratio(regimes: Regimes) -> Tensor:
    """BT: what training a task a, after b's first training, does to b. Else as `forward_transfer_ratio`."""
    return _transfer(regimes, _quotients, forward=False)


@of_pairs("new2022/bt-contrast", "as new2022/bt-ratio, of (tp(e2) - tp(e1)) / (tp(e1) + tp(e2))", bounds=between(-1, 1))
def backward_transfer_contrast(regimes: Regimes) -> Tensor:
    """BT as a contrast. Else as `backward_transfer_ratio`."""
    return _transfer(regimes, _contrasts, forward=False)


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
        experts: each task's experts' training curves; their mean counts.
    """

    table = RegimeTable.of(regimes)

    def of_task(curves: Sequence[Tensor], trainings: list[int]) -> float:
        own = _joined(table, trainings)
        ratios = []
        for curve in curves:
            expert = curve[: len(own)].sum().item()
            ratios.append(_quotient(expert, own[: len(curve)].sum().item()))
        return _mean(ratios)

    return _against(table, experts, of_task)


@of_tasks(
    "new2022/sample-efficiency",
    "mean over tasks of (saturation / expert's) * (expert's experiences to saturation / own)",
    missing="a task has no expert, or a curve is best at its start or not positive",
    bounds=not_negative,
)
def sample_efficiency(regimes: Regimes, experts: Experts) -> Tensor:
    """SE: how high and how soon training saturates against experts; 1 is neutral.

    Saturation is the highest value of the smoothed curve over a task's training. The term is 0 where it is below a
    fifth of the expert's, or where the line fitted through the training falls. A curve that is best at its start has no
    value.

    Args:
        experts: each task's experts' training curves; their mean counts.
    """

    table = RegimeTable.of(regimes)

    def of_task(curves: Sequence[Tensor], trainings: list[int]) -> float:
        level, time = _saturation(_joined(table, trainings))
        falls = _falls(table, trainings)
        terms = []
        for curve in curves:
            expert_level, expert_time = _saturation(curve)
            if time == 0 or expert_time == 0:
                terms.append(math.nan)
            elif falls or level < UNSATURATED_SHARE * expert_level:
                terms.append(0.0)
            else:
                terms.append(_quotient(expert_level, level) * expert_time / time)
        return _mean(terms)

    return _against(table, experts, of_task)


def recovery_times(training: Regimes) -> list[int]:
    """For each regime but the first, experiences until the terminal performance before it is reached again."""
    return [_first_at_least(after.values, before.terminal) for before, after in pairwise(training)]


def theil_sen(values: Sequence[float]) -> float:
    """Median slope over all pairs of values at 0, 1, ...; NaN for fewer than two."""
    given = np.asarray(values, dtype=np.float64)
    slopes = [(given[lag:] - given[:-lag]) / lag for lag in range(1, len(given))]
    return float(np.median(np.concatenate(slopes))) if slopes else math.nan


def _first_at_least(values: Tensor, level: float) -> int:
    reached = (values >= level - ROUNDING * abs(level)).nonzero()
    return int(reached[0]) if len(reached) else len(values) + 1


def _maintenance(table: RegimeTable, to_evaluation: bool) -> Tensor:
    training = table.training.tolist()
    terminal = table.terminal.tolist()
    last: list[float | None] = [None] * len(table.names)
    reference: list[float | None] = [None] * len(table.names)
    changes: list[list[float]] = [[] for _ in table.names]
    for i, task in enumerate(table.task.tolist()):
        trained = last[task]
        evaluated = reference[task]
        if training[i]:
            last[task] = terminal[i]
            reference[task] = None
        elif trained is not None and evaluated is None:
            reference[task] = terminal[i]
        elif trained is not None and evaluated is not None:
            changes[task].append(terminal[i] - (evaluated if to_evaluation else trained))
    return float64(list(map(_mean, changes)))


def _transfer(regimes: Regimes, measure: Measure, forward: bool) -> Tensor:
    """First value of each ordered pair (a, b) with a trained before, or after, b's first training."""
    table = RegimeTable.of(regimes)
    count = len(table.names)
    trainings = list(table.places(training=True))
    first = np.array([own[0] if own else len(table) for own in trainings])
    last = np.array([own[-1] if own else -1 for own in trainings])
    has_term = first[:, None] < first if forward else last[:, None] > first
    np.fill_diagonal(has_term, False)
    values = np.full((count, count), math.nan)
    by, of, value = _values_around_training(table, measure)
    chosen = ((by < first[of]) == forward) & ~np.isnan(value)
    pairs, places = np.unique(table.task[by[chosen]] * count + of[chosen], return_index=True)
    values.flat[pairs] = value[chosen][places]
    return torch.from_numpy(values[has_term])


def _values_around_training(table: RegimeTable, measure: Measure) -> tuple[Any, Any, Any]:
    """Each two evaluations of a task in a row with only blocks of one task between them, by task.

    Returns:
        The last training's position between, the evaluated task and the value, [pairs] each.
    """
    evaluated = np.flatnonzero(~table.training)
    trained = np.flatnonzero(table.training)
    ordered = evaluated[np.argsort(table.task[evaluated], kind="stable")]
    before = ordered[:-1]
    after = ordered[1:]
    changes = np.flatnonzero(np.diff(table.task[trained], prepend=-1))  # where other trainings begin
    start = np.searchsorted(trained, before)
    end = np.searchsorted(trained, after)
    of_end = np.searchsorted(changes, end, "left") - 1
    alone = (table.task[before] == table.task[after]) & (end > start)
    alone[alone] &= changes[of_end[alone]] <= start[alone]
    values = measure(table.terminal[before[alone]], table.terminal[after[alone]])
    return trained[end[alone] - 1], table.task[after[alone]], values


def _saturation(values: Tensor) -> tuple[float, int]:
    smoothed = smooth(values)
    level = smoothed.max().item()
    return level, _first_at_least(smoothed, level)


def _falls(table: RegimeTable, trainings: Sequence[int]) -> bool:
    times = torch.cat([torch.arange(table.starts[i], table.starts[i + 1], device="cpu") for i in trainings]).double()
    values = _joined(table, trainings)
    return bool(((times - times.mean()) * (values - values.mean())).sum() < 0)


def _joined(table: RegimeTable, places: Sequence[int]) -> Tensor:
    return torch.cat([table.values_of(i) for i in places])


def _against(table: RegimeTable, experts: Experts, value: Callable[[Sequence[Tensor], list[int]], float]) -> Tensor:
    values = []
    for task, own in zip(table.names, table.places(training=True), strict=True):
        if own:
            values.append(value(experts[task], own) if experts.get(task) else math.nan)
    return float64(values)


def _ranges(table: RegimeTable, experts: Experts) -> Ranges:
    both = zip(table.names, table.places(training=True), table.places(training=False), strict=True)
    ranges = {}
    for task, own, tests in both:
        values = torch.cat([_joined(table, [*own, *tests]), *experts.get(task, [])])
        ranges[task] = values.min().item(), values.max().item()
    return ranges


def _scaled(values: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.where(low == high, OFFSET, (values - low) / (high - low) * SCALE + OFFSET)


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan
