"""Scores of agents over seeds, from runs of profile curricula."""

from __future__ import annotations

import math
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import yaml

from ctgraph_rl.checks import require
from ctgraph_rl.learn.evaluate import Evaluator
from ctgraph_rl.log.files import LOG
from ctgraph_rl.log.named_curricula import curriculum_named
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.metrics import Undefined
from ctgraph_rl.packages import check_packages, class_named
from ctgraph_rl.profile.properties import Evidence, Measured, measure
from ctgraph_rl.report.bounds_of_runs import curriculum_of
from ctgraph_rl.report.intervals import Bounds, gaffke
from ctgraph_rl.report.names import displayed
from ctgraph_rl.runs.read import MODIFIED, Problem, Run, grouped, present, why_left_out

LEVEL = 0.95

HALVINGS = 20


REPLACED = ("curriculum=", "seed=", "overwrite=")

OF_AGENTS = ("policy_for", "initial_state", "learn", "load_state_dict")


class Score(NamedTuple):
    """A score over seeds, with means over seeds; without a value, the reason."""

    value: float | None
    low: float | None = None
    high: float | None = None
    n: int = 0
    reason: str = ""
    measured: float | None = None  # mean of what was measured
    floor: float | None = None
    optimum: float | None = None
    controls: str = ""  # the means of the controls that the floor is the best of; empty where it is exact

    def __str__(self) -> str:
        value = "-" if self.value is None else f"{self.value:.2f}"
        return value if self.low is None else f"{value} [{self.low:.2f}, {self.high:.2f}]"

    @property
    def absolute(self) -> str:
        """The measured value, the floor and the optimum."""
        if self.measured is None:
            return "-"
        of = f" (best of {self.controls})" if self.controls else ""
        return f"{self.measured:.2f}, floor {self.floor:.2f}{of}, optimum {self.optimum:.2f}"


Profiles = Mapping[str, Mapping[str, Score]]
"""For each agent the scores by the properties' titles, in the paper's order."""


def score_of(results: Sequence[Measured], controls: Sequence[str] = (), reason: str = "") -> Score:
    """Return the mean of value - floor over the mean of optimum - floor, within [0, 1], with a 95 % interval.

    A seed without room adds value - floor to the first mean and 0 to the second. The floor is that of the control with
    the best mean. A gap where there is no result, or the controls leave no room.

    Args:
        results: one for each seed.
        controls: the curricula that floors were measured on.
        reason: of a gap, or what is special about the results.
    """
    if not results:
        return Score(None, reason=reason)
    means = [fmean(floors) for floors in zip(*(each.floors for each in results), strict=True)]
    floor = max(means)
    measured = fmean(each.value for each in results)
    optimum = fmean(each.optimum for each in results)
    if optimum - floor <= 0:
        no_room = f"{controls[means.index(floor)] if controls else 'the floor'} leaves no room"
        return Score(None, reason=f"{reason}: {no_room}" if reason else no_room)
    value = min(max((measured - floor) / (optimum - floor), 0.0), 1.0)
    low = high = None
    if len(results) > 1:
        if results[0].exact:  # one floor and optimum of all seeds
            room = optimum - floor
            scores = [(each.value - floor) / room for each in results]
            found = gaffke(scores, Bounds(-floor / room, (results[0].highest - floor) / room), LEVEL)
        else:
            found = _paired_interval(results)
        low = min(max(found[0], 0.0), value)
        high = max(min(found[1], 1.0), value)
    said = ", ".join(f"{name} {mean:.2f}" for name, mean in zip(controls, means, strict=False))
    return Score(value, low, high, len(results), reason, measured=measured, floor=floor, optimum=optimum, controls=said)


def _paired_interval(results: Sequence[Measured]) -> tuple[float, float]:
    """Return the scores r that no control contradicts.

    A is the area of a seed, C that of its control, both in [0, 1]. r is the score above this control where the mean of
    A - C - r(1 - C) is 0. Its values are within [-1, 1 - r], so r is contradicted where Gaffke's interval of their mean
    leaves out 0. The score is the lowest one above a control.
    """
    lows = []
    highs = []
    for floors in zip(*(each.floors for each in results), strict=True):
        pairs = list(zip((each.value for each in results), floors, strict=True))
        lows.append(_highest(pairs, lambda rest: rest[0] > 0))
        highs.append(_highest(pairs, lambda rest: rest[1] >= 0))
    return min(lows), min(highs)


def rest_of_gain(pairs: Sequence[tuple[float, float]], score: float) -> tuple[float, float]:
    """Return Gaffke's interval of the mean of A - C - score (1 - C), which is 0 for the true score.

    Args:
        pairs: areas A and C of each seed, in [0, 1].
        score: in [0, 1].
    """
    rest = [own - control - score * (1 - control) for own, control in pairs]
    return gaffke(rest, Bounds(-1.0, 1 - score), LEVEL)


def _highest(pairs: Sequence[tuple[float, float]], holds: Callable[[tuple[float, float]], bool]) -> float:
    """Return the highest score in [0, 1] whose `rest_of_gain` has a property; 0 if none."""
    low = 0.0
    high = 1.0
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if holds(rest_of_gain(pairs, middle)):
            low = middle
        else:
            high = middle
    return low


RunsByName = dict[str, dict[int, Run]]


def profile_scores(
    runs: Sequence[Run], problems: Sequence[Problem], agents: Sequence[str] = ()
) -> dict[str, dict[str, Score]]:
    """Return the scores of all agents with runs of profile curricula.

    A property counts all seeds of an agent or none. It has a gap where a run is unfinished, lacks a control of the same
    seed, or was evaluated at other moments than its curriculum says. The reason names the run and a command.

    Args:
        runs: of ``ctgraph-rl profile`` or of a `ctgraph_rl.Recorder`.
        problems: as `find_runs` returns them.

    Returns:
        For each agent its score by the title of each property. A modified curriculum counts where the published one has
        no score, and the reason names it.

    Raises:
        ValueError: if there is no run of a profile curriculum.
    """
    check_packages()
    properties = import_module("curricula.profile").PROPERTIES
    names = {*properties}
    for prop in properties.values():
        names.update(prop.controls)
    own = [run for run in runs if run.group[0] in names]
    others = ", ".join(sorted({run.group[0] for run in runs}))
    none = f"no run of a profile, only of {others}: learn curriculum={next(iter(properties))}"
    require((bool(own), why_left_out(problems) or none))
    of_agents: dict[str, dict[bool, RunsByName]] = {}
    for (curriculum, agent), by_seed in grouped(displayed(own, agents)).items():
        kinds = of_agents.setdefault(agent, {False: {}, True: {}})
        for run in present(by_seed):
            kinds[MODIFIED in curriculum].setdefault(run.group[0], {})[run.seed] = run
    read: dict[Path, Evidence] = {}
    scores: dict[str, dict[str, Score]] = {}
    for agent, kinds in of_agents.items():
        scores[agent] = {}
        for name, prop in properties.items():
            began = [problem.reason for problem in problems if problem.path.parent.name == name]
            scores[agent][prop.title] = _score(kinds, name, prop, read, began)
    return scores


def _score(
    kinds: Mapping[bool, RunsByName], name: str, prop: Any, read: dict[Path, Evidence], began: Sequence[str]
) -> Score:
    gaps = []
    for is_modified, runs in kinds.items():
        said = f"of {name}{MODIFIED}" if is_modified else ""
        if name in runs:
            try:
                return score_of(_over_seeds(runs, name, prop, read), prop.controls, said)
            except Undefined as error:
                gaps.append(f"{said}: {error}" if said else str(error))
    return Score(None, reason=next(iter([*gaps, *began]), "there is no run"))


def _over_seeds(runs: RunsByName, name: str, prop: Any, read: dict[Path, Evidence]) -> list[Measured]:
    results = []
    for seed, run in sorted(runs[name].items()):
        needed = []
        for control in prop.controls:
            if seed not in runs.get(control, {}):
                raise Undefined(f"{run.path} lacks its control {control}: {_command(run, control)}")
            needed.append(runs[control][seed])
        for each in (*needed, run):
            if each.path not in read:
                read[each.path] = _evidence(each)
        try:
            measured = measure(read[run.path], [read[each.path] for each in needed], prop)
        except (ValueError, OSError) as error:
            raise Undefined(f"{run.path}: {error}") from error
        if not all(map(math.isfinite, (measured.value, *measured.floors))):
            raise Undefined(f"{run.path}: an evaluation has no mean return")
        results.append(measured)
    return results


def _evidence(run: Run) -> Evidence:
    """Return what a run measured, and what it learned.

    Raises:
        Undefined: for an unfinished run, an unpublished curriculum that is not stored, an earlier version, and other
            moments of evaluation than its curriculum says.
    """
    if run.reason:
        raise Undefined(f"{run.path} has no results, {run.reason}: {_command(run)}")
    published = curriculum_named(run.group[0])
    learned = curriculum_of(run)
    if learned is None:
        raise Undefined(f"{run.path} learned another curriculum than the published {run.group[0]}")
    if learned.version != published.version:
        raise Undefined(
            f"{run.path} learned version {learned.version} of {learned.name}, the profile has version "
            f"{published.version}: train it again in another folder"
        )
    log = RunLog.read(run.path / LOG)
    evaluator = Evaluator(learned, 0, RunLog())
    due: Counter[tuple[int, int]] = Counter()
    for frames in learned.moments:
        due.update((frames, number) for number, _ in evaluator.tasks_at(frames).values())
    made = Counter((m["frames"], m["task"]) for m in log.of_kind("evaluation"))
    for word, others in (("lacks the evaluation", due - made), ("has one evaluation too many", made - due)):
        if others:
            frames, number = min(others)
            what = f"{run.path} {word} of task {number} after {frames:,} frames"
            raise Undefined(f"{what}: {_command(run)} overwrite=true")
    return Evidence(log, learned, run.path, _agent_class(run))


def _command(run: Run, curriculum: str = "") -> str:
    curriculum = curriculum or run.group[0]
    typed = run.path / ".hydra" / "overrides.yaml"
    if not typed.exists():
        return f"give Recorder(curricula.load({curriculum!r}), ...) all evaluations of its moments"
    own = [word for word in yaml.safe_load(typed.read_text(encoding="utf-8")) if not word.startswith(REPLACED)]
    words = [*own, f"curriculum={curriculum}", f"seed={run.seed}", f"hydra.sweep.dir={run.path.parent.parent}"]
    return f"ctgraph-rl profile {shlex.join(words)}"


def _agent_class(run: Run) -> Any:
    """Return the class of a run's agent; None if it is no baseline and its module is not imported.

    Nothing that a file names is imported, but for baselines.
    """
    agent = run.about["config"].get("agent")
    module, _, name = str(agent.get("_target_") if isinstance(agent, Mapping) else agent).rpartition(".")
    if module.startswith("baselines."):
        return class_named(module, name)
    kind = getattr(sys.modules.get(module), name, None)
    is_agent = isinstance(kind, type) and kind.__module__ == module and all(hasattr(kind, each) for each in OF_AGENTS)
    return kind if is_agent else None
