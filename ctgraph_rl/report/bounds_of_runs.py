"""What bounds the numbers of a curriculum's runs: the rewards of its tasks say it of returns, each metric of itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache

from ctgraph_rl.log.files import CURRICULUM
from ctgraph_rl.metrics.bounds import Known, of_performance
from ctgraph_rl.metrics.record import METRICS
from ctgraph_rl.packages import curriculum_named
from ctgraph_rl.report.intervals import UNBOUNDED, Bounds
from ctgraph_rl.runs.read import Run, grouped, present
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import are_graphs

NOTHING_KNOWN = Known(UNBOUNDED.low, UNBOUNDED.high, tasks=1, evaluations=1, failure_is_lowest=False)


@dataclass(frozen=True)
class BoundsOfRuns:
    """The bounds of what the runs of a curriculum measure; infinite where nothing is known.

    Args:
        returns: of each task by its label.
        known: what the metrics' bounds follow from.
        noisy: whether rewards have noise, so that what is measured may be outside of what bounds its mean.
        one_episode: whether all episodes of an evaluation are one: greedy ones of tasks without chance.
    """

    returns: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    known: Known = NOTHING_KNOWN
    noisy: bool = False
    one_episode: bool = False

    @property
    def of_returns(self) -> Bounds:
        """Of the mean return on any task."""
        return Bounds(*of_performance(self.known), self.noisy)

    def of_task(self, label: str) -> Bounds:
        """Of the mean return on a task."""
        return Bounds(*self.returns[label], self.noisy) if label in self.returns else UNBOUNDED

    def of_change(self, label: str) -> Bounds:
        """Of the difference of two mean returns on a task."""
        low, high, noisy = self.of_task(label)
        return Bounds(low - high, high - low, noisy)

    def of_metric(self, name: str) -> Bounds:
        """Of a metric; one of another version has none."""
        return Bounds(*METRICS[name].bounds(self.known), self.noisy) if name in METRICS else UNBOUNDED


NO_BOUNDS = BoundsOfRuns()
"""Of runs of which nothing is known."""


def bounds_by_curriculum(runs: Sequence[Run]) -> dict[str, BoundsOfRuns]:
    """Return the bounds of what the runs of each curriculum measure, by the curriculum's name in tables."""
    of: dict[str, list[Run]] = {}
    for (name, _), by_seed in grouped(runs).items():
        of.setdefault(name, []).extend(present(by_seed))
    return {name: bounds_of(some) for name, some in of.items()}


def bounds_of(runs: Iterable[Run]) -> BoundsOfRuns:
    """Return the bounds of runs of one curriculum, from the first of them of which the curriculum is known."""
    for run in runs:
        curriculum = curriculum_of(run)
        if curriculum is not None and run.history is not None:
            curves = run.history.evaluations.values()
            evaluations = max((sum(frames > 0 for frames, _ in curve) for curve in curves), default=1)
            return bounds_of_curriculum(curriculum, evaluations)
    return NO_BOUNDS


def bounds_of_curriculum(curriculum: Curriculum, evaluations: int = 1) -> BoundsOfRuns:
    """Return the bounds of what runs of a curriculum measure.

    Args:
        curriculum: what they learn.
        evaluations: of each task, after those before training; only those of sums over time need it.
    """
    if not are_graphs(curriculum.tasks):
        return _bounds_of_others(curriculum, evaluations)
    returns = {label: task.return_bounds for label, task in zip(curriculum.labels, curriculum.tasks, strict=True)}
    lows, highs = zip(*returns.values(), strict=True)
    failure = all(task.fail_reward == task.return_bounds[0] for task in curriculum.tasks)
    known = Known(min(lows), max(highs), len(returns), evaluations=evaluations, failure_is_lowest=failure)
    noisy = any(task.reward_std > 0 for task in curriculum.tasks)
    alike = curriculum.evaluation.greedy and all(task.is_deterministic for task in curriculum.tasks)
    return BoundsOfRuns(returns, known, noisy=noisy, one_episode=alike)


def _bounds_of_others(curriculum: Curriculum, evaluations: int) -> BoundsOfRuns:
    """Return the bounds of tasks that are no CT-graphs; none where a task does not know its own.

    They bound means, so what a few episodes of a task with chance measure may be outside.
    """
    try:
        pairs = [task.return_bounds for task in curriculum.tasks]  # type: ignore[attr-defined]
    except (AttributeError, ValueError):
        return NO_BOUNDS
    lows, highs = zip(*pairs, strict=True)
    known = Known(min(lows), max(highs), len(pairs), evaluations=evaluations, failure_is_lowest=True)
    return BoundsOfRuns(dict(zip(curriculum.labels, pairs, strict=True)), known, noisy=True, one_episode=False)


def curriculum_of(run: Run) -> Curriculum | None:
    """Return what a run learned, from its directory or the published one; None where neither has its fingerprint."""
    found: Curriculum | None
    try:
        found = Curriculum.from_json(run.path / CURRICULUM)
    except (OSError, ValueError):
        found = published(run.group[0])
    return found if found is not None and found.fingerprint == run.about["fingerprint"] else None


@cache
def published(name: str) -> Curriculum | None:
    """Return the published curriculum of a name; None if there is none."""
    try:
        return curriculum_named(name)
    except ValueError:
        return None
