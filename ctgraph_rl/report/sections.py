"""Runs as the sections of a report: one for each curriculum, and in it each agent with all its seeds.

Numbers of different curricula are never put together. A seed without results counts as missing: n = 9/10.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, chain, zip_longest
from statistics import fmean
from typing import NamedTuple

import numpy as np

from ctgraph_rl.learn.progress import Count, silent
from ctgraph_rl.report.bounds_of_runs import NO_BOUNDS, BoundsOfRuns, bounds_by_curriculum
from ctgraph_rl.report.formats import measure_name
from ctgraph_rl.report.intervals import UNBOUNDED, Bounds
from ctgraph_rl.report.names import modifications
from ctgraph_rl.report.results import AT_END, Row, table
from ctgraph_rl.report.statistics import Estimate, mean
from ctgraph_rl.runs.read import BySeed, Curve, History, Run, grouped, histories, present, split_by

Estimates = list[list[Estimate]]


FEWEST_FOR_BANDS = 10
"""Seeds from which bands of curves are intervals; those of fewer fill a panel."""


class Point(NamedTuple):
    """A place on a curve over seeds."""

    frames: float
    value: float  # mean over seeds
    low: float | None  # ends of the interval; None for fewer than `FEWEST_FOR_BANDS` seeds
    high: float | None
    n: int


@dataclass(frozen=True)
class Result:
    """The runs of an agent on a curriculum."""

    agent: str
    by_seed: BySeed
    bounds: BoundsOfRuns = NO_BOUNDS

    @property
    def runs(self) -> list[Run]:
        """All runs, finished or not."""
        return present(self.by_seed)

    @property
    def finished(self) -> list[Run]:
        """Runs with results, by seed."""
        return [run for run in self.runs if run.reason is None]

    @property
    def n(self) -> str:
        """Seeds with results, as ``9/10`` if others have none."""
        all_there = len(self.finished) == len(self.by_seed)
        return f"{len(self.finished)}" if all_there else f"{len(self.finished)}/{len(self.by_seed)}"

    def performance(self) -> Estimates:
        """Mean return on each task before training and after each block."""
        return self._over_seeds([each.performance for each in histories(self.finished)], self.bounds.of_task)

    def transfer(self) -> Estimates:
        """Changes of each task by each block, between rows of the performance matrix."""
        changes = [np.diff(history.performance, axis=0).tolist() for history in histories(self.finished)]
        return self._over_seeds(changes, self.bounds.of_change)

    def _over_seeds(self, matrices: Sequence[list[list[float]]], bounds: Callable[[str], Bounds]) -> Estimates:
        missing = [None] * (len(self.by_seed) - len(matrices))
        labels = next((history.labels for history in histories(self.finished)), ())
        estimates = []
        for rows in zip_longest(*matrices, fillvalue=[]):
            of_block = []
            for values, label in zip_longest(zip_longest(*rows), labels):
                limits = UNBOUNDED if label is None else bounds(label)
                of_block.append(mean([*(values or [None] * len(matrices)), *missing], bounds=limits))
            estimates.append(of_block)
        return estimates


@dataclass(frozen=True)
class Section:
    """The results of all agents on a curriculum.

    Args:
        name: the curriculum's, unique among sections.
        modified: what differs from the published curriculum, if anything.
    """

    name: str
    results: tuple[Result, ...]
    rows: list[Row]
    modified: str = ""

    @property
    def runs(self) -> list[Run]:
        """All runs, finished or not."""
        return list(chain(*(result.runs for result in self.results)))

    @property
    def finished(self) -> list[Run]:
        """Runs with results."""
        return [run for run in self.runs if run.reason is None]

    @cached_property
    def one(self) -> Run:
        """The run of the section's facts: the first finished one, if any."""
        return min(self.runs, key=lambda run: (run.reason is not None, run.history is None))

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the tasks."""
        return self.one.history.labels if self.one.history else ()

    @property
    def trained(self) -> tuple[tuple[int, ...], ...]:
        """For each block the positions of its tasks."""
        return self.one.history.trained if self.one.history else ()

    @cached_property
    def ends(self) -> tuple[int, ...]:
        """Frames at the end of each block, 0 first; other runs complete those that a run does not measure."""
        every = [history.ends for history in histories(self.runs)]
        return tuple(accumulate(map(max, zip_longest(*every, fillvalue=0)), max)) or (0,)

    def definitions(self) -> dict[str, tuple[str, str, str]]:
        """Formula and source of each measure in the table, by id."""
        known = {each.id: (each.formula, each.source) for each in AT_END.values()}
        for run in self.runs:
            for metric in run.metrics.values():
                known[metric["definition"]] = (metric.get("formula", ""), metric.get("source", ""))
        found = {}
        for row in self.rows:
            if row.definition:
                found[row.definition] = (measure_name(row.kind), *known[row.definition])
        return found


def sections(runs: Sequence[Run], count: Count = silent) -> list[Section]:
    """Return a section for each curriculum, in the order of the runs."""
    agents: dict[str, list[Result]] = {}
    bounds = bounds_by_curriculum(runs)
    for (curriculum, agent), by_seed in grouped(runs).items():
        agents.setdefault(curriculum, []).append(Result(agent, by_seed, bounds[curriculum]))
    rows = split_by(table(runs, count=count), lambda row: row.curriculum)
    modified = modifications(runs)
    return [Section(name, tuple(results), rows[name], modified.get(name, "")) for name, results in agents.items()]


def mean_curve(history: History) -> Curve:
    """Return a run's mean return over all tasks, at evaluations of all."""
    curves = [dict(history.evaluations.get(label, [])) for label in history.labels]
    shared = sorted(set.intersection(*map(set, curves))) if curves else []
    return [(frames, fmean(curve[frames] for curve in curves)) for frames in shared]


def training_curve(
    runs: Iterable[Run], block: int, *, start: int, end: int, places: int, bounds: Bounds = UNBOUNDED
) -> list[Point]:
    """Return while training in a block: means over equal spans of frames in which every run has a value."""
    width = max((end - start) / places, 1)
    curves = []
    for history in histories(runs):
        values: dict[int, list[float]] = {}
        for frames, value in history.training.get(block, []):
            values.setdefault(math.ceil((frames - start) / width), []).append(value)
        curves.append([(min(round(start + place * width), end), fmean(some)) for place, some in values.items()])
    return over_seeds(curves, bounds)


def over_seeds(curves: Sequence[Curve], bounds: Bounds = UNBOUNDED) -> list[Point]:
    """Means over curves where all have a value, with bands."""
    values: dict[int, list[float]] = {}
    for curve in curves:
        for frames, value in dict(curve).items():
            if not math.isnan(value):
                values.setdefault(frames, []).append(value)
    points = []
    for frames, some in sorted(values.items()):
        if len(some) == len(curves):
            has_band = len(some) >= FEWEST_FOR_BANDS
            band = mean(some, bounds=bounds) if has_band else None
            low, high = (None, None) if band is None else (band.low, band.high)
            points.append(Point(frames, fmean(some), low, high, len(some)))
    return points
