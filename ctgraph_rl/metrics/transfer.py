"""Forward transfer against experts, by areas under evaluation curves.

Areas under a curve are means of its evaluations or trapezoids; both need evaluations at equal distances. An expert
learned a single task, with the frames and evaluations that the task has in the curriculum.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import at_most_1
from ctgraph_rl.metrics.curves import CONTINUAL_WORLD, LABS_CODE, Curves
from ctgraph_rl.metrics.record import Undefined, defined, ratio

SMALLEST_HEADROOM = 1e-3
"""1 - an expert's area below which the labs' code gives no forward transfer."""


def mean_area(curve: Tensor) -> Tensor:
    """Area under a curve over its length, as the mean of its evaluations (Continual World's code).

    Args:
        curve: evaluations along the first dimension.
    """
    return curve.mean(0)


def trapezoid_area(curve: Tensor) -> Tensor:
    """Area under a curve over its length by trapezoids, per interval (the labs' code); NaN for fewer than two
    evaluations.
    """
    return (curve[1:] + curve[:-1]).mean(0) / 2


def stage_areas(curves: Curves, trapezoids: bool = False) -> Tensor:
    """Each task's area under its curve over its own block, [tasks]; NaN where a definition has none."""
    area = trapezoid_area if trapezoids else mean_area
    areas = []
    for task in range(curves.performance.shape[1]):
        try:
            areas.append(area(curves.own_stage(task)))
        except Undefined:
            areas.append(curves.performance.new_tensor(torch.nan))
    return torch.stack(areas)


def _no_transfer(areas: Tensor, expert_areas: Tensor, smallest_headroom: float = 0.0) -> str:
    """Return each cause of terms without a value, with its tasks."""
    own, expert = _over_seeds(areas, expert_areas)
    causes = {
        "an evaluation is missing": own.isnan() | expert.isnan(),
        "the expert leaves nothing to gain": ~own.isnan() & _is_full(expert, smallest_headroom),
    }
    tasks = {cause: (each.nonzero().flatten() + 1).tolist() for cause, each in causes.items()}
    return "; ".join(f"{cause} (task {', '.join(map(str, of))})" for cause, of in tasks.items() if of)


def _over_seeds(*areas: Tensor) -> list[Tensor]:
    return [each.mean(0) if each.ndim == 2 else each for each in areas]


def _is_full(expert_areas: Tensor, smallest_headroom: float) -> Tensor:
    """bool [tasks]: whether an expert leaves less to gain than the smallest headroom, or nothing."""
    headroom = 1 - expert_areas
    return (headroom == 0) | (headroom < smallest_headroom)


@defined(
    "wolczyk2021/ft",
    "1/T sum_j (AUC_j - AUCb_j) / (1 - AUCb_j)",
    CONTINUAL_WORLD,
    missing=_no_transfer,
    bounds=at_most_1,
)
def continual_world_forward_transfer(areas: Tensor, expert_areas: Tensor) -> Tensor:
    """FT: the gain of a task's own block by what came before, as a share of the possible gain; at most 1.

    AUC of `stage_areas`, for performance whose best is 1, such as success rates. The source takes a ratio of means over
    seeds, not a mean of ratios. Undefined for an expert with an area of 1, where the source's code divides by zero.

    Args:
        areas: float64 [tasks], or [seeds, tasks] to be averaged.
        expert_areas: the same of the experts, of any seeds.
    """
    own, expert = _over_seeds(areas, expert_areas)
    return ratio(own - expert, 1 - expert)


@defined(
    "ct-graph-labs/ft",
    "1/T sum_j (AUC_j - AUCb_j) / (1 - AUCb_j), AUC by trapezoids",
    LABS_CODE,
    missing=partial(_no_transfer, smallest_headroom=SMALLEST_HEADROOM),
    inputs={"areas": "trapezoid_areas", "expert_areas": "expert_trapezoid_areas"},
    bounds=at_most_1,
)
def forward_transfer_from_experts(areas: Tensor, expert_areas: Tensor) -> Tensor:
    """FT of the labs that made the CT-graph: as Continual World's, with areas by trapezoids and per seed.

    Undefined where 1 - AUCb < 0.001, as there; their 1e-8 in the denominator is left out.

    Args:
        areas: float64 [tasks] of ``stage_areas(curves, trapezoids=True)``.
        expert_areas: the same of the experts.
    """
    full = _is_full(expert_areas, SMALLEST_HEADROOM)
    return ratio(areas - expert_areas, torch.where(full, 0.0, 1 - expert_areas))


def check_experts(curves: Curves, experts: Sequence[Tensor]) -> None:
    """Refuse expert curves with another number of evaluations than the block that trains the task first.

    Raises:
        ValueError: names the task and both numbers.
    """
    first = {task: block for block, tasks in reversed([*enumerate(curves.trained, 1)]) for task in tasks}
    for task, expert in enumerate(experts):
        count = len(curves.of_block(first[task]))
        if len(expert) != count:
            raise ValueError(f"the expert of task {task + 1} needs {count} evaluations as its block, got {len(expert)}")
