"""Lifelong-learning metrics: pure functions of the performance matrix.

``performance[i, j]`` is the performance on task j after block i, float64 [blocks + 1, tasks]; row 0 is before any
training. T tasks, and where a definition needs it, block i trains task i - 1 and each task is trained once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Metric:
    """A metric's value with what it means.

    Args:
        value: the value, in units of performance; None when undefined.
        definition: id of the definition.
        formula: the formula, with R for the performance matrix and tasks counted from 1.
        source: where it is defined.
        undefined: why there is no value.
    """

    value: float | None
    definition: str
    formula: str
    source: str
    undefined: str | None = None


def average_performance(performance: Tensor) -> float:
    """ACC = 1/T sum_j R[last, j]: mean performance on all tasks after the last block (Lopez-Paz & Ranzato 2017)."""
    return performance[-1].mean().item()


def backward_transfer(performance: Tensor) -> float:
    """BWT = 1/(T-1) sum_{j<T} (R[T, j] - R[j, j]) (Lopez-Paz & Ranzato 2017).

    The change on each earlier task from right after its own block to the end; negative when tasks are forgotten.
    NaN for a single task.
    """
    _require_a_block_per_task(performance)
    own = performance[1:].diagonal()
    return (performance[-1] - own)[:-1].mean().item()


def forward_transfer(performance: Tensor) -> float:
    """FWT = 1/(T-1) sum_{j>1} (R[j-1, j] - R[0, j]) (Lopez-Paz & Ranzato 2017).

    What training on the tasks before it gave a task before its own block, against the untrained agent.
    NaN for a single task.
    """
    _require_a_block_per_task(performance)
    before_own = performance[:-1].diagonal()
    return (before_own - performance[0])[1:].mean().item()


def forgetting(performance: Tensor) -> float:
    """F = 1/(T-1) sum_{j<T} (max_{1<=l<T} R[l, j] - R[T, j]) (Chaudhry et al. 2018).

    The drop on each earlier task from its best after any earlier block to the end; the untrained agent (row 0) is no
    candidate for the best. NaN for a single task.
    """
    _require_a_block_per_task(performance)
    if performance.shape[1] == 1:
        return math.nan
    best = performance[1:-1].amax(dim=0)
    return (best - performance[-1])[:-1].mean().item()


def _require_a_block_per_task(performance: Tensor) -> None:
    """Refuse a matrix that is not [T + 1, T]; `summary` says why such a metric is undefined."""
    blocks, tasks = performance.shape[0] - 1, performance.shape[1]
    if blocks != tasks:
        raise ValueError(f"the definition needs one block per task, got {blocks} blocks and {tasks} tasks")


_LOPEZ_PAZ = "Lopez-Paz & Ranzato 2017, Gradient Episodic Memory (arXiv 1706.08840)"
_CHAUDHRY = "Chaudhry et al. 2018, Riemannian Walk (arXiv 1801.10112)"

_DEFINITIONS: dict[str, tuple[Callable[[Tensor], float], str, str, str]] = {
    "average_performance": (average_performance, "lopez-paz2017/acc", "1/T sum_j R[T,j]", _LOPEZ_PAZ),
    "forward_transfer": (
        forward_transfer,
        "lopez-paz2017/fwt",
        "1/(T-1) sum_{j=2..T} (R[j-1,j] - R[0,j])",
        _LOPEZ_PAZ,
    ),
    "backward_transfer": (
        backward_transfer,
        "lopez-paz2017/bwt",
        "1/(T-1) sum_{j=1..T-1} (R[T,j] - R[j,j])",
        _LOPEZ_PAZ,
    ),
    "forgetting": (forgetting, "chaudhry2018/f", "1/(T-1) sum_{j=1..T-1} (max_{l=1..T-1} R[l,j] - R[T,j])", _CHAUDHRY),
}


def summary(performance: Tensor, trained: Sequence[Sequence[int]]) -> dict[str, Metric]:
    """All metrics by name; what a definition does not cover is undefined with the reason, never imputed.

    Args:
        performance: float64 [blocks + 1, tasks].
        trained: for each block, the tasks that it trained, counted from 0.

    Returns:
        Metrics in the order average performance, forward transfer, backward transfer, forgetting.
    """
    in_order = [list(block) for block in trained] == [[task] for task in range(performance.shape[1])]
    reason = None
    if not in_order:
        reason = "the definition needs each task trained once, alone, in the order of the columns"
    elif len(trained) == 1:
        reason = "the definition needs at least two tasks"
    return {name: _metric(name, performance, reason) for name in _DEFINITIONS}


def _metric(name: str, performance: Tensor, reason: str | None) -> Metric:
    function, definition, formula, source = _DEFINITIONS[name]
    if name != "average_performance" and reason is not None:
        return Metric(None, definition, formula, source, reason)
    return Metric(function(performance), definition, formula, source)
