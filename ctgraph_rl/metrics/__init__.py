"""Lifelong-learning metrics: pure functions of the performance matrix, of evaluation curves and of training curves.

Every metric gives a `Metric`: its value, definition, formula and source, or the reason why it is undefined. A missing
evaluation, a division by zero or a curriculum that a definition does not speak of is said and never imputed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from ctgraph_rl.metrics.curves import (
    Curves,
    check_experts,
    continual_world_forgetting,
    continual_world_forward_transfer,
    continual_world_performance,
    forward_transfer_from_experts,
    instant_cumulative_return,
    mean_area,
    relative_forgetting,
    stage_areas,
    tasks_learned,
    total_performance_over_time,
    trapezoid_area,
)
from ctgraph_rl.metrics.lifetime import (
    Regime,
    backward_transfer_contrast,
    backward_transfer_ratio,
    forward_transfer_contrast,
    forward_transfer_ratio,
    maintenance_of_evaluation,
    maintenance_of_training,
    mean_evaluation_performance,
    mean_training_performance,
    performance_recovery,
    prepare,
    relative_performance,
    sample_efficiency,
)
from ctgraph_rl.metrics.matrix import (
    Trained,
    accuracy_over_time,
    average_performance,
    backward_transfer,
    backward_transfer_over_time,
    forgetting,
    forward_transfer,
    isolated_forgetting,
    positive_backward_transfer,
    remembering,
    zero_shot_performance,
    zero_shot_transfer,
)
from ctgraph_rl.metrics.optimum import (
    STAGES,
    frames_to_first_reward,
    normalised_performance,
    regret,
    search_efficiency,
    stage_reached,
)
from ctgraph_rl.metrics.record import MASTERED, Definition, Metric, undefined

SUMMARY = (average_performance, forward_transfer, backward_transfer, forgetting)
"""The metrics that every run shows."""

OF_MATRIX = (
    *SUMMARY,
    accuracy_over_time,
    backward_transfer_over_time,
    remembering,
    positive_backward_transfer,
    zero_shot_performance,
    isolated_forgetting,
    zero_shot_transfer,
)
"""All metrics of the performance matrix alone."""

OF_CURVES = (
    continual_world_performance,
    continual_world_forgetting,
    instant_cumulative_return,
    total_performance_over_time,
    relative_forgetting,
    tasks_learned,
)
"""Metrics of evaluation curves that need no expert."""

OF_REGIMES = (
    mean_training_performance,
    mean_evaluation_performance,
    performance_recovery,
    maintenance_of_evaluation,
    maintenance_of_training,
    forward_transfer_ratio,
    forward_transfer_contrast,
    backward_transfer_ratio,
    backward_transfer_contrast,
)
"""Lifelong metrics that need no expert."""

AGAINST_EXPERTS = (relative_performance, sample_efficiency)
"""Lifelong metrics that compare training with experts'."""


def summary(performance: Tensor, trained: Trained) -> dict[str, Metric]:
    """The metrics that every run shows, by name; what a definition does not cover is undefined with the reason.

    Args:
        performance: float64 [blocks + 1, tasks].
        trained: for each block, the tasks that it trained, counted from 0.

    Returns:
        Metrics in the order average performance, forward transfer, backward transfer, forgetting.
    """
    return {metric.__name__: metric(performance, trained) for metric in SUMMARY}


def of_matrix(performance: Tensor, trained: Trained) -> dict[str, Metric]:
    """All metrics of the performance matrix, by name, those of `summary` first; arguments as there."""
    return {metric.__name__: metric(performance, trained) for metric in OF_MATRIX}


def of_curves(curves: Curves) -> dict[str, Metric]:
    """Metrics of evaluation curves that need no expert, by name."""
    return {metric.__name__: metric(curves) for metric in OF_CURVES}


def of_regimes(regimes: Sequence[Regime], experts: Mapping[str, Sequence[Tensor]] | None = None) -> dict[str, Metric]:
    """Lifelong metrics of regimes, by name; `prepare` them first to get the numbers of l2metrics' defaults.

    Args:
        regimes: a run.
        experts: for each task, the training curves of its experts.
    """
    alone = {metric.__name__: metric(regimes) for metric in OF_REGIMES}
    return alone | {metric.__name__: metric(regimes, experts or {}) for metric in AGAINST_EXPERTS}


def definitions() -> dict[str, Definition]:
    """Every definition, by the name of its function, in the order of the ids."""
    found = {name: globals()[name].definition for name in __all__ if hasattr(globals()[name], "definition")}
    return dict(sorted(found.items(), key=lambda item: item[1].id))


__all__ = [
    "AGAINST_EXPERTS",
    "MASTERED",
    "OF_CURVES",
    "OF_MATRIX",
    "OF_REGIMES",
    "STAGES",
    "SUMMARY",
    "Curves",
    "Definition",
    "Metric",
    "Regime",
    "Trained",
    "accuracy_over_time",
    "average_performance",
    "backward_transfer",
    "backward_transfer_contrast",
    "backward_transfer_over_time",
    "backward_transfer_ratio",
    "check_experts",
    "continual_world_forgetting",
    "continual_world_forward_transfer",
    "continual_world_performance",
    "definitions",
    "forgetting",
    "forward_transfer",
    "forward_transfer_contrast",
    "forward_transfer_from_experts",
    "forward_transfer_ratio",
    "frames_to_first_reward",
    "instant_cumulative_return",
    "isolated_forgetting",
    "maintenance_of_evaluation",
    "maintenance_of_training",
    "mean_area",
    "mean_evaluation_performance",
    "mean_training_performance",
    "normalised_performance",
    "of_curves",
    "of_matrix",
    "of_regimes",
    "performance_recovery",
    "positive_backward_transfer",
    "prepare",
    "regret",
    "relative_forgetting",
    "relative_performance",
    "remembering",
    "sample_efficiency",
    "search_efficiency",
    "stage_areas",
    "stage_reached",
    "summary",
    "tasks_learned",
    "total_performance_over_time",
    "trapezoid_area",
    "undefined",
    "zero_shot_performance",
    "zero_shot_transfer",
]
