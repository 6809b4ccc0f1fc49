"""Lifelong-learning metrics: pure functions of a run's performance matrix, evaluation curves and training curves.

A metric is a function with ``@defined`` in a module of this folder. It is computed wherever a run has the inputs that
its arguments name, and gives a value with its meaning or the reason why there is none; nothing is imputed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from torch import Tensor

from ctgraph_rl.metrics.curves import Curves
from ctgraph_rl.metrics.lifetime import prepare
from ctgraph_rl.metrics.matrix import Trained, average_performance, backward_transfer, forgetting, forward_transfer
from ctgraph_rl.metrics.optimum import STAGES
from ctgraph_rl.metrics.record import MASTERED, METRICS, Definition, Entry, Metric, Undefined, undefined
from ctgraph_rl.metrics.regimes import Regime, RegimeTable
from ctgraph_rl.metrics.transfer import check_experts, mean_area, stage_areas, trapezoid_area

SUMMARY = (average_performance, forward_transfer, backward_transfer, forgetting)
"""The metrics that every run shows."""

ORDER = ("matrix", "curves", "optimum", "ceilings", "lifetime", "transfer")
"""Modules as listed; other modules follow."""

for _found in iter_modules(__path__):
    import_module(f"{__name__}.{_found.name}")

NamedMetrics = dict[str, Metric]
"""Metrics by name."""


def of_inputs(given: Mapping[str, Any]) -> NamedMetrics:
    """Compute every metric whose inputs are given.

    Args:
        given: inputs by the names of `ctgraph_rl.metrics.inputs.INPUTS`; an `Undefined` gives the reason for a missing
            one.
    """

    def place(entry: Entry) -> int:
        module = entry.metric.__module__.rpartition(".")[2]
        return ORDER.index(module) if module in ORDER else len(ORDER)

    listed = sorted(METRICS.values(), key=place)  # as a user's own script may define others
    return {entry.metric.__name__: entry.of(given) for entry in listed if given.keys() >= {*entry.required}}


def summary(performance: Tensor, trained: Trained) -> NamedMetrics:
    """Compute the metrics that every run shows, undefined with the reason where a definition does not apply.

    Args:
        performance: float64 [blocks + 1, tasks].
        trained: for each block, the tasks that it trained, counted from 0.

    Returns:
        Average performance, forward transfer, backward transfer, forgetting.
    """
    return {metric.__name__: metric(performance, trained) for metric in SUMMARY}


def of_matrix(performance: Tensor, trained: Trained) -> NamedMetrics:
    """Compute all metrics that need only the performance matrix; arguments as `summary`."""
    return of_inputs({"performance": performance, "trained": trained})


def of_curves(curves: Curves) -> NamedMetrics:
    """Compute all metrics of evaluation curves of returns without noise that need no expert."""
    return of_inputs({"curves": curves, "mastery_curves": curves})


def of_regimes(regimes: Sequence[Regime], experts: Mapping[str, Sequence[Tensor]] | None = None) -> NamedMetrics:
    """Compute the lifelong metrics of regimes; `prepare` them first for the numbers of l2metrics' defaults.

    Args:
        experts: for each task, its experts' training curves.
    """
    return of_inputs({"regimes": regimes, "experts": experts or {}})


def definitions() -> dict[str, Definition]:
    """Return every definition by its function's name, ordered by id."""
    found = {name: entry.meaning for name, entry in METRICS.items()}
    return dict(sorted(found.items(), key=lambda item: item[1].id))


AGAINST_EXPERTS = tuple(entry.metric for entry in METRICS.values() if "experts" in entry.required)


def __getattr__(name: str) -> Callable[..., Metric]:
    if name not in METRICS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return METRICS[name].metric


def __dir__() -> list[str]:
    return sorted([*__all__, *METRICS])


__all__ = [
    "AGAINST_EXPERTS",
    "MASTERED",
    "METRICS",
    "STAGES",
    "SUMMARY",
    "Curves",
    "Definition",
    "Metric",
    "Regime",
    "RegimeTable",
    "Trained",
    "Undefined",
    "check_experts",
    "definitions",
    "mean_area",
    "of_curves",
    "of_inputs",
    "of_matrix",
    "of_regimes",
    "prepare",
    "stage_areas",
    "summary",
    "trapezoid_area",
    "undefined",
]
