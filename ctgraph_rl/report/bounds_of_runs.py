"""Bounds of the numbers of a curriculum's runs, from the rewards of its tasks and from each metric."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache

from ctgraph_rl.log.files import CURRICULUM
from ctgraph_rl.log.named_curricula import curriculum_named
from ctgraph_rl.log.scores import evaluation_noise, lowest_returns, optimal_values
from ctgraph_rl.metrics import Undefined
from ctgraph_rl.metrics.adaptation import exact_search
from ctgraph_rl.metrics.bounds import Known, of_performance
from ctgraph_rl.metrics.record import METRICS
from ctgraph_rl.report.intervals import SCALED_DIGITS, UNBOUNDED, Bounds
from ctgraph_rl.report.statistics import Estimate, constant, mean
from ctgraph_rl.runs.read import Run, by_curriculum, histories
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.kinds.task_like import TaskLike
from ctgraph_rl.tasks.protocol import Evaluation
from ctgraph_rl.tasks.task import are_graphs

NOTHING_KNOWN = Known(UNBOUNDED.low, UNBOUNDED.high, tasks=1, evaluations=1)
ONE_EPISODE = Evaluation(num_episodes=1)


@dataclass(frozen=True)
class BoundsOfRuns:
    """Bounds of what a curriculum's runs measure, with the noise of rewards; infinite where unknown.

    Args:
        returns: of an evaluation of each task, by its label.
        of_training: of the mean return of any number of episodes.
        one_episode: whether all episodes of an evaluation are equal: greedy ones of tasks without chance.
    """

    returns: Mapping[str, Bounds] = field(default_factory=dict)
    known: Known = NOTHING_KNOWN
    of_training: Bounds = UNBOUNDED
    one_episode: bool = False

    @property
    def of_returns(self) -> Bounds:
        """Of an evaluation of any task, and of their mean."""
        return Bounds(*of_performance(self.known))

    def of_task(self, label: str) -> Bounds:
        """Of an evaluation of a task."""
        return self.returns.get(label, UNBOUNDED)

    def of_change(self, label: str) -> Bounds:
        """Of the difference of two evaluations of a task."""
        return self.of_task(label).of_differences()

    def of_metric(self, name: str) -> Bounds:
        """Of a metric; none for another version."""
        return Bounds(*METRICS[name].bounds(self.known)) if name in METRICS else UNBOUNDED

    def estimate(self, metric: str, values: Sequence[float | None]) -> Estimate:
        """Return a metric over seeds: its mean with an interval, or an exact value without one."""
        if metric in METRICS and METRICS[metric].is_exact:
            return constant(values)
        return mean(values, bounds=self.of_metric(metric))


NO_BOUNDS = BoundsOfRuns()


def bounds_by_curriculum(runs: Sequence[Run]) -> dict[str, BoundsOfRuns]:
    """Return the bounds of each curriculum's runs, by its name in tables."""
    return {name: bounds_of(some) for name, some in by_curriculum(runs).items()}


def bounds_of(runs: Iterable[Run]) -> BoundsOfRuns:
    """Return the bounds of runs of one curriculum, from the first whose curriculum is known.

    Sums over time use the run with the most evaluations, as others may be unfinished.
    """
    known = [run for run in runs if run.history is not None]
    curriculum = next(filter(None, map(curriculum_of, known)), None)
    if curriculum is None:
        return NO_BOUNDS
    evaluations = 1
    for history in histories(known):
        for curve in history.evaluations.values():
            evaluations = max(evaluations, sum(frames > 0 for frames, _ in curve))
    return bounds_of_curriculum(curriculum, evaluations)


def bounds_of_curriculum(curriculum: Curriculum, evaluations: int = 1) -> BoundsOfRuns:
    """Return the bounds of what runs of a curriculum measure.

    Each task bounds an episode's return and so means of episodes. Bounds of the mean over all seeds, such as the
    optimum, do not count.

    Args:
        evaluations: of each task, after those before training; needed for sums over time.
    """
    evaluation = curriculum.evaluation
    tasks = (*curriculum.examples, *evaluation.held_out)
    of_evaluation = []
    of_episode = []
    try:
        for task in tasks:
            bounds = Bounds(*task.return_bounds)  # type: ignore[attr-defined]
            of_evaluation.append(bounds.widened(evaluation_noise(task, evaluation)))
            of_episode.append(bounds.widened(evaluation_noise(task, ONE_EPISODE)))
    except (AttributeError, ValueError):
        return NO_BOUNDS
    whole = _around(of_evaluation)
    of_tasks = of_evaluation[: len(curriculum.examples)]
    shares = _shares(curriculum.examples, of_tasks)
    regrets = UNBOUNDED
    if are_graphs(tasks):
        episodes = evaluation.row_episodes
        exact = [exact_search(task.graph.num_end_states, episodes).sum().item() for task in tasks]
        regrets = Bounds(min(exact) - episodes, max(exact))  # goals that a row misses beside the best search
    known = Known(*whole, len(of_tasks), evaluations, *shares, *regrets)
    returns = dict(zip(curriculum.example_labels, of_tasks, strict=True))
    alike = (
        evaluation.greedy and are_graphs(curriculum.examples) and all(t.is_deterministic for t in curriculum.examples)
    )
    return BoundsOfRuns(returns, known, _around(of_episode), one_episode=alike)


def _around(bounds: Sequence[Bounds]) -> Bounds:
    return Bounds(min(each.low for each in bounds), max(each.high for each in bounds))


def _shares(tasks: Sequence[TaskLike], returns: Sequence[Bounds]) -> Bounds:
    failures = lowest_returns(tasks)
    optima = optimal_values(tasks)
    if isinstance(failures, Undefined) or isinstance(optima, Undefined):
        return UNBOUNDED
    shares = []
    for bounds, failure, optimum in zip(returns, failures.tolist(), optima.tolist(), strict=True):
        if not optimum > failure:
            return UNBOUNDED
        ends = [round((end - failure) / (optimum - failure), SCALED_DIGITS) for end in bounds]
        shares.append(Bounds(*ends))
    return _around(shares)


def curriculum_of(run: Run) -> Curriculum | None:
    """Return what a run learned, from its directory or published; None without an equal fingerprint."""
    found: Curriculum | None
    try:
        found = Curriculum.from_json(run.path / CURRICULUM)
    except (OSError, ValueError):
        found = published(run.group[0])
    return found if found is not None and found.fingerprint == run.about["fingerprint"] else None


@cache
def published(name: str) -> Curriculum | None:
    """Return the published curriculum of a name, if any."""
    try:
        return curriculum_named(name)
    except ValueError:
        return None
