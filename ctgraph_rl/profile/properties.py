"""What a run says about a property: a value, the floor of an agent without the property, and the optimum."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from torch import Tensor, nn

from ctgraph_rl.checks import by_name
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.scores import mastery_thresholds, optimal_values
from ctgraph_rl.metrics import Undefined
from ctgraph_rl.metrics.transfer import stage_areas
from ctgraph_rl.packages import check_packages
from ctgraph_rl.runs.load import load
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import Task, ct_graphs
from ctgraph_rl.tasks.values import memoryless_ceiling, open_loop_ceiling, random_frames_to_goal


class Measured(NamedTuple):
    """The result of a run. Its score is (value - floor) / (optimum - floor)."""

    value: float
    floor: float
    optimum: float
    exact: bool = True  # whether floor and optimum are known and not measured


class Evidence(NamedTuple):
    """A finished run."""

    log: RunLog
    curriculum: Curriculum
    folder: Path

    @property
    def tasks(self) -> Sequence[Task]:
        """The tasks that are trained."""
        return ct_graphs(self.curriculum.tasks, "a profile")

    @property
    def own_returns(self) -> Tensor:
        """The return on each task at the end of the last block that trains it, float64 [tasks]."""
        performance = self.log.performance(len(self.tasks))
        last = {task: block for block, trained in enumerate(self.curriculum.trained, 1) for task in trained}
        return performance[[last[task] for task in range(len(self.tasks))], range(len(self.tasks))]


def above_ceiling(run: Evidence, ceiling: str) -> Measured:
    """The mean return at the end, between the best of policies that lack something and the best of all.

    Args:
        run: the run.
        ceiling: ``open_loop``, of fixed sequences of actions, or ``memoryless``.
    """
    of = {"open_loop": open_loop_ceiling, "memoryless": memoryless_ceiling}[ceiling]
    return Measured(fmean(run.own_returns.tolist()), fmean(map(of, run.tasks)), _optimum(run))


def above_random_search(run: Evidence) -> Measured:
    """The mean return at the end of each task's own block, above a search that acts at random until it is rewarded.

    With m mean frames to the first reward, it finds the goal in n frames with probability 1 - exp(-n / m), and keeps
    it. Goals are so rare that the number of episodes before the first is geometric with a small probability.
    """
    frames = (block.num_frames for block in run.curriculum.blocks)
    found = [1 - math.exp(-n / random_frames_to_goal(task)) for n, task in zip(frames, run.tasks, strict=True)]
    return Measured(fmean(run.own_returns.tolist()), fmean(found), _optimum(run))


def faster(run: Evidence, on: Sequence[int], than: Sequence[int], learned: bool = False) -> Measured:
    """The mean area under the evaluation curves of some tasks in their own blocks, above that of others of one shape.

    Args:
        run: the run.
        on: tasks on which an agent with the property is faster.
        than: those that it learns without what the property gives; their area is the floor, the mean of few tasks.
        learned: refuse a run that does not master these by the end of their blocks.

    Raises:
        Undefined: where the others were learned at once, or not at all though they must be.
    """
    mastered = mastery_thresholds(run.tasks)
    assert isinstance(mastered, Tensor)
    missed = [1 + task for task in than if not run.own_returns[task] >= mastered[task]]
    if learned and missed:
        raise Undefined(f"task {missed[0]} was not learned, so nothing can be faster than it")
    areas = stage_areas(run.log.curves(run.curriculum.trained)).tolist()
    floor = fmean(areas[task] for task in than)
    optimum = _optimum(run)
    if floor == optimum:
        raise Undefined("the tasks to compare with were solved at their first evaluation, which leaves nothing to gain")
    return Measured(fmean(areas[task] for task in on), floor, optimum, exact=False)


def held_out(run: Evidence) -> Measured:
    """The mean return with held-out wait images, above that of acting at random at new images.

    A policy that else is right waits with probability a = 1 / (b + 1) there. So it leaves a wait state with probability
    w = a (1 - p) / (1 - a p), and reaches the goal of d decisions with probability w^(d + 1).
    """
    returns = [m["return_mean"] for m in run.log.of_kind("evaluation") if m.get("held_out")]
    [task] = ct_graphs(run.curriculum.evaluation.held_out, "a profile")
    waits = 1 / task.num_actions
    p = task.graph.wait_prob
    floor = (waits * (1 - p) / (1 - waits * p)) ** (task.graph.depth + 1)
    return Measured(returns[-1] if returns else math.nan, floor, _optimum(run))


def searches(run: Evidence) -> Measured:
    """The success rate over the first n episodes of a row with one of n goals, above that of always the same path.

    The floor is 1 / n, the optimum the mean of min(1, i / n) over episodes i: the best search; see
    `ctgraph_rl.metrics.adaptation`.
    """
    found = run.log.adaptation()
    if found is None:
        raise Undefined("the log has no evaluation with adaptation")
    return Measured(found.success.mean().item(), found.exact[:, 0].mean().item(), found.exact.mean().item())


def teaches(run: Evidence) -> Measured:
    """How exact a table predicts what a navigating policy meets, learned from data of the trained agent.

    0 is a table of frequencies, 1 the exact model; see `baselines.models.model.learned_share`.
    """
    trained = load(run.folder, _imported_class(run))
    [task] = run.tasks
    check_packages()
    taught_share = import_module("baselines.models.table_model").taught_share
    share = taught_share(trained.policy_for(task), task, trained.agent.initial_state)
    return Measured(max(0.0, share), 0.0, 1.0)


def _imported_class(run: Evidence) -> Any:
    """Return the class of a run's agent; None if its module is not imported, as nothing of a file is."""
    config = run.log.of_kind("run")[0].get("config") or {}
    module, _, name = str(config.get("agent", {}).get("_target_")).rpartition(".")
    kind = getattr(sys.modules.get(module), name, None)
    is_agent = isinstance(kind, type) and kind.__module__ == module and issubclass(kind, nn.Module)
    return kind if is_agent else None


MEASURES: Mapping[str, Callable[..., Measured]] = by_name(
    above_ceiling, above_random_search, faster, held_out, searches, teaches
)
"""The measures by name, as a table of properties names them."""


def measure(run: Evidence, prop: Any) -> Measured:
    """Apply the measure of a `curricula.profile.Property`.

    Raises:
        Undefined: where the run has no value, with the reason.
    """
    try:
        found = MEASURES[prop.measure](run, **prop.arguments)
    except (ValueError, OSError) as error:
        raise Undefined(str(error)) from error
    if not all(map(math.isfinite, found)):
        raise Undefined("an evaluation is missing")
    return found


def _optimum(run: Evidence) -> float:
    best = optimal_values(run.tasks)
    assert isinstance(best, Tensor)
    return best.mean().item()
