"""All metrics of a run: what its curriculum, its log and, where there are any, its experts say."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ctgraph_rl import metrics
from ctgraph_rl.checks import require
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.metrics import Curves, Metric
from ctgraph_rl.metrics.record import Undefined
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import Task
from ctgraph_rl.tasks.values import random_frames_to_goal

NO_EXPERTS = "no experts were given"


def scores(log: RunLog, curriculum: Curriculum, experts: Sequence[RunLog] | None = None) -> dict[str, Metric]:
    """Every metric by name, those of `metrics.summary` first; undefined with the reason where it has no value.

    The lifelong metrics are on the scale of l2metrics, 1..101, with each task's known range: 1 is its ``fail_reward``,
    101 its optimal value.

    Args:
        log: a whole run.
        curriculum: what was learned.
        experts: for each of ``curriculum.tasks``, the log of an agent that learned it alone.

    Raises:
        ValueError: for the log of another curriculum, by its fingerprint, and another number of experts.
    """
    _check_same(log, curriculum)
    count, trained = len(curriculum.tasks), curriculum.trained
    given = experts is None or len(experts) == count
    require((given, f"experts must be one log for each of {count} tasks, got {len(experts or ())}"))
    return {
        **metrics.of_matrix(log.performance(count), trained),
        **metrics.of_curves(_curves(log, curriculum)),
        **_against_the_optimum(log, curriculum),
        **_lifelong(log, curriculum, experts),
        **_transfer(log, curriculum, experts),
    }


def _check_same(log: RunLog, curriculum: Curriculum) -> None:
    """The curriculum must be what was learned, as far as the log's first line says."""
    given = curriculum.fingerprint
    for run in log.of_kind("run"):
        learned = run.get("fingerprint", given)
        other = f"the log is of {run.get('curriculum')} (fingerprint {learned}), not of {curriculum.name} ({given})"
        require((learned == given, f"{other}: give the curriculum that the run learned, with all its changes"))


def optimal_values(tasks: Sequence[Task]) -> Tensor:
    """Each task's best mean return, float64 [tasks]; NaN where a graph is too large to know."""
    return torch.tensor([_optimal_value(task) for task in tasks], dtype=torch.float64)


def _optimal_value(task: Task) -> float:
    try:
        return task.optimal_value(1.0)
    except ValueError:
        return math.nan


def _curves(log: RunLog, curriculum: Curriculum) -> Curves:
    """The evaluation curves; where nothing was evaluated, one evaluation without values."""
    if log.of_kind("evaluation"):
        return log.curves(curriculum.trained)
    return Curves(torch.full((1, len(curriculum.tasks)), math.nan, dtype=torch.float64), (0,), (0,), curriculum.trained)


def _against_the_optimum(log: RunLog, curriculum: Curriculum) -> dict[str, Metric]:
    best = optimal_values(curriculum.tasks)
    zero = torch.tensor([task.fail_reward for task in curriculum.tasks], dtype=torch.float64)
    count = len(curriculum.tasks)
    end_rates, success_rates = log.last("end_rate", count), log.last("success_rate", count)
    curves = _curves(log, curriculum)
    return {
        "tasks_learned": metrics.tasks_learned(curves, metrics.MASTERED * best),
        "normalised_performance": metrics.normalised_performance(log.performance(count), best, zero),
        "stage_reached": metrics.stage_reached(end_rates, success_rates),
        "regret": _regret(log, curriculum, best),
        **_first_rewards(log, curriculum),
    }


def _regret(log: RunLog, curriculum: Curriculum, best: Tensor) -> Metric:
    """Against the optimum of the block that an interval ends in; unknown where tasks of a block differ in it."""
    values = [{best[task].item() for task in block} for block in curriculum.trained]
    alone = torch.tensor([each.pop() if len(each) == 1 else math.nan for each in values], dtype=torch.float64)
    return metrics.regret(
        log.training("episodes"), log.training("return_mean"), alone[log.training("block").long() - 1]
    )


def _first_rewards(log: RunLog, curriculum: Curriculum) -> dict[str, Metric]:
    """Of each task in the block that trains it first, which must train it alone."""
    tasks = range(len(curriculum.tasks))
    first = [min(i for i, block in enumerate(curriculum.trained) if task in block) for task in tasks]
    reason = None
    if any(len(curriculum.trained[block]) > 1 for block in first):
        reason = "needs first blocks that train one task each"
    elif curriculum.protocol.boundaries == "hidden":
        reason = "needs announced boundaries: an episode of one task may end in the block of the next"
    if reason is not None:
        names = ("frames_to_first_reward", "search_efficiency")
        return {name: metrics.undefined(getattr(metrics, name), reason) for name in names}
    starts, graphs = (0, *curriculum.ends), [task.graph for task in curriculum.tasks]
    frames = [log.training("frames", block + 1) - starts[block] for block in first]
    episodes, rates = ([log.training(name, block + 1) for block in first] for name in ("episodes", "success_rate"))
    random = [random_frames_to_goal(task) for task in curriculum.tasks]
    return {
        "frames_to_first_reward": metrics.frames_to_first_reward(frames, episodes, rates, random),
        "search_efficiency": metrics.search_efficiency(episodes, rates, [g.expected_search_episodes for g in graphs]),
    }


def _lifelong(log: RunLog, curriculum: Curriculum, experts: Sequence[RunLog] | None) -> dict[str, Metric]:
    functions = (*metrics.OF_REGIMES, *metrics.AGAINST_EXPERTS)
    best = optimal_values(curriculum.tasks)
    try:
        regimes = log.regimes(curriculum.trained)
        require((not best.isnan().any(), "a task's optimal value is not known: its graph is too large"))
    except ValueError as reason:
        return {metric.__name__: metrics.undefined(metric, str(reason)) for metric in functions}
    lowest = [task.fail_reward for task in curriculum.tasks]
    ranges = dict(zip(curriculum.labels, zip(lowest, best.tolist(), strict=True), strict=True))
    returns = [_returns(expert) for expert in experts or ()]
    curves = {label: [curve] for label, curve in zip(curriculum.labels, returns, strict=False) if len(curve)}
    found = metrics.of_regimes(*metrics.prepare(regimes, curves, ranges))
    if experts is None:
        found |= {metric.__name__: metrics.undefined(metric, NO_EXPERTS) for metric in metrics.AGAINST_EXPERTS}
    return found


def _returns(expert: RunLog) -> Tensor:
    """The training curve of an expert."""
    returns = expert.training("return_mean")
    return returns[~returns.isnan()]


def _transfer(log: RunLog, curriculum: Curriculum, experts: Sequence[RunLog] | None) -> dict[str, Metric]:
    """Forward transfer against experts, by both areas; both definitions are of performance whose best is 1."""
    functions = {metrics.continual_world_forward_transfer: False, metrics.forward_transfer_from_experts: True}
    try:
        require((experts is not None, NO_EXPERTS))
        ones = torch.ones(len(curriculum.tasks), dtype=torch.float64)
        best_is_1 = torch.allclose(optimal_values(curriculum.tasks), ones, rtol=0, atol=1e-9)
        require((best_is_1, "the definition needs tasks whose optimal value is 1"))
        own, alone = _curves(log, curriculum), [expert.curves([(0,)]) for expert in experts or ()]
        metrics.check_experts(own, [curve.own_stage(0) for curve in alone])
    except (ValueError, Undefined) as reason:
        return {metric.__name__: metrics.undefined(metric, str(reason)) for metric in functions}
    return {
        metric.__name__: metric(
            metrics.stage_areas(own, trapezoids), torch.cat([metrics.stage_areas(each, trapezoids) for each in alone])
        )
        for metric, trapezoids in functions.items()
    }
