"""A run's value of a property, the floor of an agent without the property, and the optimum."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from torch import Tensor

from ctgraph_rl.checks import by_name
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.metrics import Undefined
from ctgraph_rl.profile.floors import all_found_share, best_without_memory, found_share
from ctgraph_rl.profile.prediction import known_bits
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import Task, ct_graphs
from ctgraph_rl.tasks.values import open_loop_ceiling


class Measured(NamedTuple):
    """The result of a seed; a score is the mean of value - floor over the mean of optimum - floor."""

    value: float
    floors: tuple[float, ...]  # one that is exact, or those of the controls, in the order of the property's
    optimum: float
    highest: float = 1.0  # that a value can be; the lowest is 0
    exact: bool = True  # whether floor and optimum are known and not measured


class Evidence(NamedTuple):
    """A finished run."""

    log: RunLog
    curriculum: Curriculum
    folder: Path
    agent_class: Any = None  # None where it is not known

    @property
    def tasks(self) -> Sequence[Task]:
        """The tasks that are trained."""
        return ct_graphs(self.curriculum.tasks, "a profile")

    @property
    def own_returns(self) -> list[float]:
        """The return on each task at the end of the last block that trains it."""
        performance = self.log.performance(len(self.tasks))
        last = {task: block for block, trained in enumerate(self.curriculum.trained, 1) for task in trained}
        return [performance[last[task], task].item() for task in range(len(self.tasks))]

    def curve(self, block: int) -> Tensor:
        """The lowest return over the tasks of a block, from 1, at each evaluation in it, float64 [evaluations].

        A difficulty is reached where all of its goals are.
        """
        curves = self.log.curves(self.curriculum.trained)
        return curves.performance[curves.of_block(block)][:, list(self.curriculum.trained[block - 1])].amin(1)


def above_ceilings(run: Evidence, controls: Sequence[Evidence], sizes: Sequence[int]) -> Measured:
    """The mean over graphs of the lowest return over their goals, above that of policies that only count steps.

    Args:
        sizes: the number of goals of each kind of graph, in the order of tasks.
    """
    returns = _parts(run.own_returns, sizes)
    floors = _parts([best_without_memory(task) for task in run.tasks], sizes)
    return Measured(fmean(map(min, returns)), (fmean(map(min, floors)),), 1.0)


def above_random_search(run: Evidence, controls: Sequence[Evidence], sizes: Sequence[int]) -> Measured:
    """The mean over depths of the lowest return over their goals, above that of a random search.

    The search acts at random until it finds the goal of a block, and keeps it.

    Args:
        sizes: the number of goals of each depth, in the order of tasks.
    """
    returns = _parts(run.own_returns, sizes)
    tasks = _parts(run.tasks, sizes)
    frames = _parts([block.num_frames for block in run.curriculum.blocks], sizes)
    floors = [all_found_share(goals, budgets) for goals, budgets in zip(tasks, frames, strict=True)]
    return Measured(fmean(map(min, returns)), (fmean(floors),), 1.0)


def faster_than_random_search(run: Evidence, controls: Sequence[Evidence]) -> Measured:
    """The mean area of all goals but the first, above that of a random search for each goal.

    An area is the mean of the evaluations in a block.
    """
    areas = []
    floors = []
    start = run.curriculum.ends[0]
    for block, end in list(enumerate(run.curriculum.ends, 1))[1:]:
        areas.append(run.curve(block).mean().item())
        moments = [frames - start for frames in run.curriculum.moments if start < frames <= end]
        floors.append(fmean(found_share(run.tasks[run.curriculum.trained[block - 1][0]], n) for n in moments))
        start = end
    return Measured(fmean(areas), (fmean(floors),), 1.0)


def gains(run: Evidence, controls: Sequence[Evidence]) -> Measured:
    """The area of the last block, above that of the same block in other lives of the same seed.

    Raises:
        Undefined: where the last blocks differ, or their evaluations.
    """
    last = run.curriculum.blocks[-1]
    for control in controls:
        same = control.curriculum.blocks[-1] == last and control.curriculum.evaluation == run.curriculum.evaluation
        if not same:
            raise Undefined(f"{control.folder} ends with another block than {run.folder}: give both the same settings")
    areas = [each.curve(len(each.curriculum.blocks)).mean().item() for each in (run, *controls)]
    return Measured(areas[0], tuple(areas[1:]), 1.0, exact=False)


def held_out(run: Evidence, controls: Sequence[Evidence]) -> Measured:
    """The lowest return over goals with held-out wait images, above that of a fixed action sequence.

    A policy that is right, but acts at random at new images, waits there with probability a = 1 / (b + 1). It leaves a
    wait state with probability w = a (1 - p) / (1 - a p), and reaches the goal of d decisions with w^(d + 1), if that
    is more.
    """
    tasks = ct_graphs(run.curriculum.evaluation.held_out, "a profile")
    last = {m["task"]: m["return_mean"] for m in run.log.of_kind("evaluation") if m.get("held_out")}
    floors = []
    for task in tasks:
        waits = 1 / task.num_actions
        p = task.graph.wait_prob
        leaves = waits * (1 - p) / (1 - waits * p)
        floors.append(max(open_loop_ceiling(task), leaves ** (task.graph.depth + 1)))
    return Measured(min(last.values()), (min(floors),), 1.0)


def searches(run: Evidence, controls: Sequence[Evidence]) -> Measured:
    """The success rate over the first n episodes of a row with one of n goals, above that of one fixed path.

    The floor is 1 / n, the optimum the mean of min(1, i / n) over episodes i, by the best search of
    `ctgraph_rl.metrics.adaptation`.
    """
    found = run.log.adaptation()
    if found is None:
        raise Undefined("the log has no evaluation with adaptation")
    return Measured(found.success.mean().item(), (found.exact[:, 0].mean().item(),), found.exact.mean().item())


def predicts(run: Evidence, controls: Sequence[Evidence]) -> Measured:
    """The bits that `ctgraph_rl.profile.prediction.known_bits` finds, above those of the best memoryless predictor.

    Raises:
        Undefined: for an agent without ``predict_next``, and a log without its agent.
    """
    [task] = run.tasks
    known = known_bits(run.folder, run.agent_class, task)
    return Measured(known.value, (known.memoryless,), known.exact, highest=known.highest)


def _parts(values: Sequence[Any], sizes: Sequence[int]) -> list[Sequence[Any]]:
    if sum(sizes) != len(values):
        raise Undefined(f"the property has {sum(sizes)} tasks, this curriculum has {len(values)}")
    parts = []
    start = 0
    for size in sizes:
        parts.append(values[start : start + size])
        start += size
    return parts


MEASURES: Mapping[str, Callable[..., Measured]] = by_name(
    above_ceilings, above_random_search, faster_than_random_search, gains, held_out, searches, predicts
)


def measure(run: Evidence, controls: Sequence[Evidence], prop: Any) -> Measured:
    """Return what a run says about a property.

    Args:
        controls: the runs of the property's controls, of the same agent and seed.

    Raises:
        Undefined: where the run has no value.
    """
    return MEASURES[prop.measure](run, controls, **prop.arguments)
