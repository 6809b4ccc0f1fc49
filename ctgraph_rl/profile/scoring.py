"""Scores of agents over seeds, read from the directories of runs of profile curricula."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from ctgraph_rl.checks import ReadOnlyValues, require
from ctgraph_rl.log.files import CURRICULUM, LOG
from ctgraph_rl.log.named_curricula import curriculum_named
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.metrics import Undefined
from ctgraph_rl.packages import check_packages
from ctgraph_rl.profile.properties import Evidence, Measured, measure
from ctgraph_rl.report.intervals import UNBOUNDED, Bounds
from ctgraph_rl.report.names import displayed
from ctgraph_rl.report.statistics import mean
from ctgraph_rl.runs.read import MODIFIED, BySeed, Run, find_runs, grouped
from ctgraph_rl.tasks.curriculum import Curriculum


class Score(NamedTuple):
    """A score over seeds; without a value, the reason."""

    value: float | None
    low: float | None = None
    high: float | None = None
    n: int = 0
    reason: str = ""

    def __str__(self) -> str:
        value = "-" if self.value is None else f"{self.value:.2f}"
        return value if self.low is None else f"{value} [{self.low:.2f}, {self.high:.2f}]"


Profiles = Mapping[str, Mapping[str, Score]]
"""For each agent the scores by the titles of the properties, in the order of the paper."""


def score_of(results: Sequence[Measured]) -> Score:
    """Return the ratio of means over seeds, (value - floor) / (optimum - floor), within [0, 1], with a 95 % interval.

    Where floor and optimum are exact it is a mean of bounded scores, and the interval is Gaffke's, which covers with
    few seeds, too. Where they are measured it is Student's of the ratio, to first order, so that their own spread
    counts. One seed has no interval, nor have equal seeds there.

    Args:
        results: one for each seed, at least one.
    """
    room = fmean(each.optimum - each.floor for each in results)
    ratio = fmean(each.value - each.floor for each in results) / room
    rest = [each.value - each.floor - ratio * (each.optimum - each.floor) for each in results]
    exact = Bounds(min(-each.floor / room for each in results), 1.0)
    bounds = exact if all(each.exact for each in results) else UNBOUNDED
    found = mean([ratio + each / room for each in rest], bounds=bounds)
    value = min(max(ratio, 0.0), 1.0)
    if found.low is None or found.high is None:
        return Score(value, n=found.n)
    return Score(value, min(max(found.low, 0.0), value), max(min(found.high, 1.0), value), found.n)


def profile_scores(paths: Sequence[Path | str], agents: Sequence[str] = ()) -> dict[str, dict[str, Score]]:
    """Return the scores of all agents whose runs of profile curricula are in or below some folders.

    Args:
        paths: folders of runs, of ``ctgraph-rl profile`` or of a `ctgraph_rl.Recorder`.
        agents: names and order of agents, see `ctgraph_rl.report.names.displayed`.

    Returns:
        For each agent its score by the title of each property; one without a run or a value says why. A modified
        curriculum counts where the published one has no score, and the reason names it.

    Raises:
        ValueError: if there is no run of a profile curriculum.
    """
    properties = profile_properties()
    runs, problems = find_runs(paths)
    runs = [run for run in runs if run.group[0] in properties]
    why = "; ".join(problem.reason for problem in problems)
    first = next(iter(properties))
    require((bool(runs), why or f"no run of a profile in {', '.join(map(str, paths))}: learn curriculum={first}"))
    found: dict[str, dict[str, Score]] = {}
    for (curriculum, agent), by_seed in grouped(displayed(runs, agents)).items():
        prop = properties[curriculum.partition(" ")[0]]
        missing = {each.title: Score(None, reason="there is no run") for each in properties.values()}
        scores = found.setdefault(agent, missing)
        score = _over_seeds(by_seed, prop)
        is_modified = MODIFIED in curriculum
        if is_modified:
            score = score._replace(reason=": ".join(filter(None, [f"of {curriculum}", score.reason])))
        if not scores[prop.title].n or (score.n and not is_modified):
            scores[prop.title] = score
    return found


def _over_seeds(by_seed: BySeed, prop: Any) -> Score:
    """Return the score of the seeds that have a value, with the reason of one that has none."""
    results = []
    reason = ""
    for seed, run in by_seed.items():
        try:
            results.append(measure(_evidence(run), prop))
        except Undefined as error:
            reason = f"seed {seed}: {error}"
    return score_of(results)._replace(reason=reason) if results else Score(None, reason=reason)


def _evidence(run: Run | None) -> Evidence:
    """Return what a run has measured, and what it learned.

    Raises:
        Undefined: for a run that is not finished, and one of another curriculum than published that is not stored.
    """
    if run is None or run.reason:
        raise Undefined("there is no run" if run is None else str(run.reason))
    stored = run.path / CURRICULUM
    learned = Curriculum.from_json(stored) if stored.exists() else curriculum_named(run.group[0])
    if learned.fingerprint != run.curriculum[1]:
        raise Undefined(f"{run.path} learned another curriculum than the published {run.group[0]}")
    return Evidence(RunLog.read(run.path / LOG), learned, run.path)


def profile_properties() -> ReadOnlyValues:
    """Return the properties of a profile by their curricula; see `curricula.profile`.

    Raises:
        ValueError: see `check_packages`.
    """
    check_packages()
    return import_module("curricula.profile").PROPERTIES
