"""All metrics of a run, from its curriculum, its log and its experts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from ctgraph_rl import metrics
from ctgraph_rl.checks import NamedValues, require
from ctgraph_rl.log.escape import listed
from ctgraph_rl.log.life_curves import life_inputs
from ctgraph_rl.log.run_log import RunLog, tuning_share
from ctgraph_rl.metrics import Curves, Metric, Undefined
from ctgraph_rl.metrics.adaptation import Adaptation
from ctgraph_rl.metrics.inputs import INPUTS, OF_A_PART
from ctgraph_rl.metrics.labels import SEVERAL, Labelling
from ctgraph_rl.metrics.record import float64
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.kinds.task_like import TaskLike
from ctgraph_rl.tasks.observability import POLICIES, state_entropy
from ctgraph_rl.tasks.protocol import Evaluation
from ctgraph_rl.tasks.task import Task, are_graphs
from ctgraph_rl.tasks.values import (
    memoryless_ceiling,
    open_loop_ceiling,
    optimal_value,
    random_frames_to_goal,
    worst_value,
)

GOAL_CHANGES = Undefined("ceilings are exact only for goals that stay, and a task has a goal_change")
NO_STREAM = Undefined("windows are those of a stream, as curriculum=stream makes")
NO_EXPERTS = "no experts were given"
AT_MOMENTS = "evaluate exactly where Curriculum.moments says"
MOST_MOMENTS = 5


def scores(log: RunLog, curriculum: Curriculum, experts: Sequence[RunLog] | None = None) -> dict[str, Metric]:
    """Every metric by name, those of `metrics.summary` first; undefined with the reason where it has no value.

    The lifelong metrics are on the scale of l2metrics: 1 is a task's ``fail_reward``, or the lowest return if it is no
    CT-graph, and 101 its optimal value.

    Args:
        experts: for each of ``curriculum.tasks``, the log of its single-task expert.

    Raises:
        ValueError: for the log of another curriculum, or another number of experts.

    Example:
        >>> import curricula
        >>> from ctgraph_rl import learn_curriculum, make_agent
        >>> curriculum = curricula.load("ct2_interfering", num_frames=4096)
        >>> log = learn_curriculum(curriculum, make_agent("ppo", curriculum))
        >>> scores(log, curriculum)["backward_transfer"].formula
        '1/(T-1) sum_{j=1..T-1} (R[T,j] - R[j,j])'
    """
    _check_same(log, curriculum)
    if isinstance(curriculum, Stream):
        return metrics.of_inputs(life_inputs(log, curriculum))
    count = len(curriculum.tasks)
    given = experts is None or len(experts) == count
    require((given, f"experts must be one log for each of {count} tasks, got {len(experts or ())}"))
    return metrics.of_inputs(inputs_of(log, curriculum, experts))


def inputs_of(log: RunLog, curriculum: Curriculum, experts: Sequence[RunLog] | None) -> NamedValues:
    """Return all of `ctgraph_rl.metrics.inputs.INPUTS`, `Undefined` if this run lacks one.

    An unfinished run has measured nothing, a tuning run only `OF_A_PART`.
    """
    facts = _facts(curriculum)
    share = tuning_share(log.about)
    if share is not None and share < 1:
        ended = f"a tuning run, which ended after {log.reached('training'):,} of {curriculum.num_frames:,} frames"
        reason = Undefined(f"{ended}, has only metrics of training")
        found = _training(log, curriculum, facts["best"], curriculum.frames_of(share))
        known = {name: found[name] for name in OF_A_PART if name in found}
        return {name: facts.get(name, known.get(name, reason)) for name in INPUTS}
    try:
        check_finished(log, curriculum)
    except Undefined as reason:
        return {name: facts.get(name, reason) for name in INPUTS}
    return {**_measured(log, curriculum, facts["best"], experts), **facts}


def check_finished(log: RunLog, curriculum: Curriculum) -> None:
    """Refuse a log without the protocol's last evaluation.

    Raises:
        ctgraph_rl.metrics.Undefined: says how far it came.
    """
    reached = log.reached("evaluation")
    last = curriculum.moments[-1]
    if reached < last:
        raise Undefined(f"the run is not finished: its last evaluation is after {reached:,} of {last:,} frames")


def protocol_curves(log: RunLog, curriculum: Curriculum) -> Curves:
    """Return the curves of a finished run that was evaluated exactly where the protocol says.

    Only then areas, sums and maxima of two runs compare.

    Raises:
        ctgraph_rl.metrics.Undefined: names missing and extra moments.
    """
    check_finished(log, curriculum)
    found = {m["frames"] for m in log.of_kind("evaluation") if not m.get("held_out")}
    missing = sorted({*curriculum.moments} - found)
    more = sorted(found - {*curriculum.moments})
    if missing:
        raise Undefined(f"evaluations are missing after {listed(missing, MOST_MOMENTS)} frames: {AT_MOMENTS}")
    if more:
        raise Undefined(f"the protocol has no evaluations after {listed(more, MOST_MOMENTS)} frames: {AT_MOMENTS}")
    return log.curves(curriculum.trained)


@lru_cache(maxsize=1)  # seeds of a group have one curriculum
def _facts(curriculum: Curriculum) -> NamedValues:
    tasks = curriculum.tasks
    known = {
        "trained": curriculum.trained,
        "mastery_thresholds": mastery_thresholds(tasks),
        "evaluation_noise": float64([evaluation_noise(task, curriculum.evaluation) for task in tasks]),
        "best": optimal_values(tasks),
        "zero": lowest_returns(tasks),
        "life": NO_STREAM,
    }
    if not are_graphs(tasks):
        reason = Undefined(f"it is known of CT-graphs alone, and tasks are of {_kind(tasks)}")
        return {**dict.fromkeys(OF_GRAPHS, reason), **known}
    return {
        **known,
        **ceilings(tasks),
        "random_frames": list(map(random_frames_to_goal, tasks)),
        "search_episodes": [task.graph.expected_search_episodes for task in tasks],
    }


OF_GRAPHS = (
    *("open_loop_ceilings", "memoryless_ceilings", "end_rates", "success_rates", "first_success_rates"),
    *(f"{policy}_entropies" for policy in POLICIES),
    *("random_frames", "search_episodes"),
)


def _measured(
    log: RunLog, curriculum: Curriculum, best: Tensor | Undefined, experts: Sequence[RunLog] | None
) -> NamedValues:
    count = len(curriculum.tasks)
    curves: Curves | Undefined
    mastery: Curves | Undefined
    try:
        curves = protocol_curves(log, curriculum)
        shares = log.curves(curriculum.trained, "success_rate").performance
        values = torch.where(_have_noise(curriculum.tasks), shares, curves.performance)
        mastery = replace(curves, performance=values)
    except Undefined as reason:
        curves = reason
        mastery = reason
    return {
        "performance": log.performance(count),
        "curves": curves,
        "mastery_curves": mastery,
        "end_rates": log.last("end_rate", count),
        "success_rates": log.last("success_rate", count),
        "adaptation": _adaptation(log, held_out=False),
        "held_out_adaptation": _adaptation(log, held_out=True),
        **_training(log, curriculum, best, curriculum.num_frames),
        **_regimes(log, curriculum, best, experts),
        **_areas(curves, best, experts, trapezoids=False),
        **_areas(curves, best, experts, trapezoids=True),
    }


OF_TRAINING = (
    *("episodes", "returns", "labelling", "interval_best"),
    *("first_frames", "first_episodes", "first_success_rates"),
)


def _training(log: RunLog, curriculum: Curriculum, best: Tensor | Undefined, last: int) -> NamedValues:
    reached = log.reached("training")
    if 0 < reached < last:
        reason = Undefined(f"training is logged up to {reached:,} of {last:,} frames: log it to the end")
        return dict.fromkeys(OF_TRAINING, reason)
    interval_best = best
    if isinstance(best, Tensor):
        alone = []
        for block in curriculum.trained:
            values = set(best[list(block)].tolist())
            alone.append(values.pop() if len(values) == 1 else math.nan)
        interval_best = float64(alone)[log.training("block").long() - 1]
    return {
        "episodes": log.training("episodes"),
        "returns": log.training("return_mean"),
        "labelling": _labelling(log, curriculum),
        "interval_best": interval_best,
        **_first_blocks(log, curriculum),
    }


def _adaptation(log: RunLog, held_out: bool) -> Adaptation | Undefined:
    found = log.adaptation(held_out)
    which = "held-out" if held_out else "trained"
    return found or Undefined(f"no {which} task was evaluated with evaluation.adapt_episodes > 0")


def _kind(tasks: Sequence[TaskLike]) -> str:
    return type(tasks[0]).__name__


def _check_same(log: RunLog, curriculum: Curriculum) -> None:
    given = curriculum.fingerprint
    learned = log.about.get("fingerprint", given)
    other = f"the log is of {log.about.get('curriculum')} (fingerprint {learned}), not of {curriculum.name} ({given})"
    require((learned == given, f"{other}: give the curriculum that the run learned, with all its changes"))
    tasks = max((m["task"] for m in log.of_kind("evaluation") if not m.get("held_out")), default=0)
    block = len(log.ends()) - 1
    most = len(curriculum.tasks), len(curriculum.blocks)
    more = f"the log has task {tasks} and block {block}, {curriculum.name} has {most[0]} tasks and {most[1]} blocks"
    require((tasks <= most[0] and block <= most[1], f"{more}: give the curriculum that the run learned"))


def optimal_values(tasks: Sequence[TaskLike]) -> Tensor | Undefined:
    """Each task's best mean return, float64 [tasks]; NaN where a graph is too large.

    The reason, where a task that is no CT-graph does not know it.
    """
    if not are_graphs(tasks):
        return _said_by(tasks, "optimal_value", lambda task: task.optimal_value(1.0))
    return _of_each(partial(_known, optimal_value), tasks)


def ceilings(tasks: Sequence[Task]) -> dict[str, Tensor | Undefined]:
    """Return each task's exact ceilings and what observations tell, float64 [tasks], or why one is not known."""
    known: dict[str, Tensor | Undefined] = {
        "open_loop_ceilings": _of_each(open_loop_ceiling, tasks),
        "memoryless_ceilings": _of_each(memoryless_ceiling, tasks),
    }
    if any(task.goal_change is not None for task in tasks):
        known = dict.fromkeys(known, GOAL_CHANGES)
    for policy in POLICIES:
        known[f"{policy}_entropies"] = _of_each(partial(state_entropy, policy=policy), tasks)
    return known


def lowest_returns(tasks: Sequence[TaskLike]) -> Tensor | Undefined:
    """Each task's return of a failure, or lowest return if no CT-graph, float64 [tasks]."""
    if not are_graphs(tasks):
        return _said_by(tasks, "return_bounds", lambda task: task.return_bounds[0])
    return float64([task.fail_reward for task in tasks])


def _said_by(tasks: Sequence[TaskLike], member: str, value: Callable[[Any], float]) -> Tensor | Undefined:
    if not hasattr(type(tasks[0]), member):
        return Undefined(f"{_kind(tasks)} has no {member}, so it is not known")
    return _of_each(value, tasks)


def _of_each(value: Callable[[Any], float], tasks: Sequence[Any]) -> Tensor | Undefined:
    try:
        return float64(list(map(value, tasks)))
    except ValueError as error:
        return Undefined(str(error))


def mastery_thresholds(tasks: Sequence[TaskLike]) -> Tensor | Undefined:
    """From which value on each task is mastered, float64 [tasks]; NaN as for `optimal_values`.

    Without noise of rewards it is a mean return: `metrics.MASTERED` times a positive optimal value, or that share of
    the way from the worst mean return to another. With noise it is `metrics.MASTERED` of the episodes at the goal, NaN
    where the goal does not pay most.
    """
    best = optimal_values(tasks)
    if isinstance(best, Undefined):
        return best
    share = metrics.MASTERED
    positive = (best > 0) | best.isnan()
    returns = share * best
    if not positive.all():
        worst = _of_each(partial(_known, worst_value), tasks) if are_graphs(tasks) else lowest_returns(tasks)
        if isinstance(worst, Undefined):
            return worst
        returns = torch.where(positive, returns, best - (1 - share) * (best - worst))
    if not are_graphs(tasks):
        return returns
    pays = torch.tensor([task.goal_reward > max(task.fail_reward, 0) for task in tasks], dtype=torch.bool, device="cpu")
    shares = torch.where(pays, share, torch.nan).double()
    return torch.where(_have_noise(tasks), shares, returns)


def evaluation_noise(task: TaskLike, evaluation: Evaluation) -> float:
    """Return the largest standard deviation of a task's mean return by the noise of rewards.

    Where agents adapt, the mean is of one place in each row. Exact means have none.
    """
    if evaluation.exact or not isinstance(task, Task):
        return 0.0
    episodes = evaluation.num_episodes
    if evaluation.adapt_episodes > 0:
        episodes //= evaluation.episodes_per_row
    return task.return_noise / math.sqrt(episodes)


def _have_noise(tasks: Sequence[TaskLike]) -> Tensor:
    return torch.tensor(
        [isinstance(task, Task) and task.reward_std > 0 for task in tasks], dtype=torch.bool, device="cpu"
    )


def _known(value: Callable[[Task, float], float], task: Task) -> float:
    try:
        return value(task, 1.0)
    except ValueError:
        return math.nan


def _labelling(log: RunLog, curriculum: Curriculum) -> Labelling | Undefined:
    acted = log.training("acted_label")
    ends = log.training("frames")
    if not len(acted) or acted.isnan().any():
        return Undefined("the learner gives tasks no labels of its own: it has no detector")
    trained = [block[0] if len(block) == 1 else SEVERAL for block in curriculum.trained]
    return Labelling(
        acted.long() - 1,
        acted.new_tensor(trained).long()[log.training("block").long() - 1],
        ends.diff(prepend=ends.new_zeros(1)).long(),
        learned=log.training("learned") > 0,
        alarm=log.training("alarm") > 0,
        rolled_back=log.training("rolled_back").nan_to_num().long(),
        announced=curriculum.protocol.announces,
        oracle=bool((log.training("oracle") > 0).any()),
    )


def _first_blocks(log: RunLog, curriculum: Curriculum) -> NamedValues:
    blocks = curriculum.trained
    firsts: dict[int, int] = {}
    for number, block in enumerate(blocks):
        for task in block:
            firsts.setdefault(task, number)
    first = [firsts[task] for task in range(len(curriculum.tasks))]
    reason = None
    if any(len(blocks[number]) > 1 for number in first):
        reason = "needs first blocks that train one task each"
    elif not curriculum.protocol.announces:
        reason = "needs announced boundaries: an episode of one task may end in the block of the next"
    if reason is not None:
        return dict.fromkeys(("first_frames", "first_episodes", "first_success_rates"), Undefined(reason))

    def of_first(name: str) -> list[Tensor]:
        by_block = log.training_by_block(name)
        return [by_block.get(number + 1, float64([])) for number in first]

    starts = (0, *curriculum.ends)
    return {
        "first_frames": [frames - starts[number] for frames, number in zip(of_first("frames"), first, strict=True)],
        "first_episodes": of_first("episodes"),
        "first_success_rates": of_first("success_rate"),
    }


def require_known(value: Any) -> Any:
    """Return an input of metrics.

    Raises:
        ctgraph_rl.metrics.Undefined: for one that is not known, with the reason.
    """
    if isinstance(value, Undefined):
        raise value
    return value


def _regimes(
    log: RunLog, curriculum: Curriculum, best: Tensor | Undefined, experts: Sequence[RunLog] | None
) -> NamedValues:
    try:
        optimal = require_known(best)
        lowest = require_known(lowest_returns(curriculum.tasks))
        regimes = log.regimes(curriculum.trained, curriculum.labels)
        require((not optimal.isnan().any(), "a task's optimal value is not known: its graph is too large"))
    except (ValueError, Undefined) as error:
        return dict.fromkeys(("regimes", "experts"), Undefined(str(error)))
    ranges = dict(zip(curriculum.labels, zip(lowest.tolist(), optimal.tolist(), strict=True), strict=True))
    curves = {}
    for label, expert in zip(curriculum.labels, experts or (), strict=False):
        returns = expert.training("return_mean")
        known = returns[~returns.isnan()]
        if len(known):
            curves[label] = [known]
    prepared, of_experts = metrics.prepare(regimes, curves, ranges)
    return {"regimes": prepared, "experts": Undefined(NO_EXPERTS) if experts is None else of_experts}


def _areas(
    curves: Curves | Undefined, best: Tensor | Undefined, experts: Sequence[RunLog] | None, trapezoids: bool
) -> NamedValues:
    """Return areas for forward transfer, whose definitions have 1 as the best performance."""
    kind = "trapezoid_areas" if trapezoids else "areas"
    try:
        require((experts is not None, NO_EXPERTS))
        optimal = require_known(best)
        known = require_known(curves)
        best_is_1 = torch.allclose(optimal, torch.ones_like(optimal), rtol=0, atol=1e-9)
        require((best_is_1, "the definition needs tasks whose optimal value is 1"))
        alone = [expert.curves([(0,)]) for expert in experts or ()]
        metrics.check_experts(known, [curve.own_stage(0) for curve in alone])
        least = 2 if trapezoids else 1
        for task in range(known.performance.shape[1]):
            count = len(known.own_stage(task))
            needs = f"areas by trapezoids need {least} evaluations, task {task + 1} has {count} in its block"
            require((count >= least, needs))
    except (ValueError, Undefined) as error:
        return dict.fromkeys((kind, f"expert_{kind}"), Undefined(str(error)))
    expert_areas = torch.cat([metrics.stage_areas(each, trapezoids) for each in alone])
    return {kind: metrics.stage_areas(known, trapezoids), f"expert_{kind}": expert_areas}
