"""Run directories as data: each log is read once, and only what tables and figures need is kept.

Runs that differ only in their seed belong together. Those in one folder that name no agent are one learner with the
folder's name. An unreadable directory is a `Problem` with its reason, never a number.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, is_int, is_real, repeated, require
from ctgraph_rl.disk import read_regular
from ctgraph_rl.learn.labels import Span, label_spans
from ctgraph_rl.learn.progress import Count, silent
from ctgraph_rl.log.escape import listed
from ctgraph_rl.log.files import FAILURE, LOG, METRICS, MOST_BYTES_OF_METRICS, no_run, without_sweeps_files
from ctgraph_rl.log.life_curves import by_windows
from ctgraph_rl.log.measurement import check, parsed
from ctgraph_rl.log.provenance import is_ours, targets
from ctgraph_rl.log.run_log import MOST_BYTES, SCHEMA, RunLog, label_of, tuning_share
from ctgraph_rl.log.sums import metrics_of
from ctgraph_rl.metrics.adaptation import Adaptation
from ctgraph_rl.runs.experts import EXPERT
from ctgraph_rl.runs.settings import as_before, flat
from ctgraph_rl.runs.status import failure
from ctgraph_rl.strict import files_below, one_line_of, too_deep

MODIFIED = " (modified)"

OF_THE_CURRICULUM = ("curriculum", "evaluation", "protocol")

ABOUT = ("curriculum", "fingerprint", "config")

NO_METHOD = "Finetune"
"""The method that changes nothing, as none."""

FOLDER = "folder"
"""Setting of runs that name no agent: those in one folder are one learner."""

MEASURES = {
    "evaluation": ("", ("return_mean", "success_rate")),
    "adaptation": ("adaptation_", ("return_mean", "success_rate", "found_rate", "exact_rate")),
    "training": ("training_", ("return_mean", "success_rate")),
}
"""By kind of measurement: the beginning of values' names, and the fields."""

MOST_SEEDS = 10

MOST_MODULES = 3
"""Differing modules that are named; one digest stands for the others."""

CurriculumKey = tuple[str, str]
"""A curriculum's name and fingerprint."""

AgentKey = tuple[str, str]
"""Curriculum and agent, as tables name them."""

Curve = list[tuple[int, float]]
"""Mean returns by frames, or NaN."""


class Value(NamedTuple):
    """A number that a run measured; fields that do not apply are None."""

    task: str | None  # label of an evaluated task
    held_out: bool | None  # whether no block trains the task
    block: int | None  # in or after which it was measured; 0 before any training
    moment: str | None  # of an evaluation: before any training, during a block or after it
    frames: int | None  # learned so far
    episode: int | None  # of a row that adapts, from 1
    metric: str
    value: float | None


NOWHERE = (None,) * 6


UNIT_METRICS = {"dead": "dead units", "dormant_0.1": "dormant units (0.1)", "rank_effective": "effective rank"}
"""Metrics of hidden units in figures, with their names."""


class History(NamedTuple):
    """A run's measurements of the curriculum's own tasks."""

    labels: tuple[str, ...]  # name of each task
    trained: tuple[tuple[int, ...], ...]  # for each block the positions of its tasks; empty if the log does not say
    ends: tuple[int, ...]  # frames at the end of each block so far; 0 for block 0, before any training
    performance: list[list[float]]  # mean return [blocks + 1][tasks]; NaN where not evaluated
    evaluations: Mapping[str, Curve]  # by label
    training: Mapping[int, Curve]  # by block, of finished episodes
    units: Mapping[str, Curve]  # of `UNIT_METRICS`, on fresh images; empty where they were not measured
    spans: tuple[Span, ...]  # of labels that the learner gave tasks itself
    adaptation: Mapping[str, Adaptation]  # the last one, of ``trained`` and ``held-out`` tasks as far as there is one
    seconds: float
    experts_together: tuple[bool, ...]  # for each single-task expert of the log, whether a group of seeds trained it


def split_by(items: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Return items by key, in their order."""
    found: dict[Any, list[Any]] = {}
    for item in items:
        found.setdefault(key(item), []).append(item)
    return found


@dataclass(frozen=True)
class Run:
    """A run directory as data.

    Args:
        about: the first line of its log.
        agent: class or name of the learner, ``PPO + EWC`` with a method, if known.
        settings: the configuration without seed and fingerprint, by dotted keys; with the folder if there is no agent.
        reason: why it has no results; None for a finished run.
        metrics: `Metric` fields by name; empty without results.
        values: everything that tables show; empty for an unreadable log.
        history: curves and performance; None for an unreadable log.
        shown: its agent's place and name in tables and figures; None: by `grouped`.
    """

    path: Path
    about: ReadOnlyValues
    agent: str | None
    settings: ReadOnlyValues
    seed: int
    reason: str | None = None
    metrics: Mapping[str, ReadOnlyValues] = field(default_factory=dict)
    values: Sequence[Value] = ()
    history: History | None = None
    shown: tuple[int, str] | None = None

    @cached_property
    def success(self) -> Mapping[str, float | None]:
        """Final success rate by task label; empty without results."""
        return self._at_end("success_rate")

    @cached_property
    def returns(self) -> Mapping[str, float | None]:
        """Final mean return by task label; empty without results."""
        return self._at_end("return_mean")

    @cached_property
    def tasks(self) -> Sequence[str]:
        """Labels of tasks not held out; empty without results."""
        evaluated = dict.fromkeys(each.task for each in self.values if each.held_out is False)
        return [task for task in self.returns if task in evaluated]

    def _at_end(self, metric: str) -> dict[str, float | None]:
        if not self.metrics or "life" in self.about:  # whose tasks are windows
            return {}
        last_block = len(self.about.get("trained") or ()) or max(each.block or 0 for each in self.values)
        found: dict[str, float | None] = {}
        for each in self.values:
            if each.metric == metric and each.task is not None:
                is_last = each.moment != "during" and each.block == last_block
                found[each.task] = each.value if is_last else found.get(each.task)
        return found

    def windows(self, metric: str) -> list[float]:
        """The terms of a metric of lives, or NaN, for each task of ``history``, which is a window."""
        terms = self.metrics.get(metric, {}).get("windows") or []
        count = len(self.history.labels) if self.history is not None else 0
        return [math.nan if term is None else term for term in [*terms, *[None] * count][:count]]

    @property
    def curriculum(self) -> CurriculumKey:
        """The curriculum's name and fingerprint."""
        return self.about["curriculum"], self.about["fingerprint"]

    @property
    def group(self) -> CurriculumKey:
        """The curriculum's published name and fingerprint."""
        name, fingerprint = self.curriculum
        return name.removesuffix(MODIFIED), fingerprint

    @property
    def code(self) -> NamedValues:
        """The numbers version, and the digest of each user module, if known."""
        found = {"numbers version": self.about.get("numbers", 1)}
        sources = self.about.get("sources")
        if sources is not None:
            return {**found, **sources}
        for name in targets({**self.about["config"], "curriculum": None}):
            if not is_ours(name):
                found[name.rpartition(".")[0]] = None
        return found

    @property
    def alike(self) -> tuple[CurriculumKey, str]:
        """Equal for runs that differ only in seed and code."""
        return self.group, json.dumps(self.settings, sort_keys=True)

    @property
    def configuration(self) -> tuple[CurriculumKey, str, str]:
        """Equal for runs that differ only in their seed."""
        return *self.alike, json.dumps(self.code, sort_keys=True)


class Problem(NamedTuple):
    """A directory left out."""

    path: Path
    reason: str
    is_error: bool = True


def why_left_out(problems: Iterable[Problem]) -> str:
    """Return why directories are left out."""
    return "; ".join(problem.reason for problem in problems)


BySeed = Mapping[int, Run | None]
"""Runs by seed; None if only other agents have it."""


def present(by_seed: BySeed) -> list[Run]:
    """Return the existing runs."""
    return list(filter(None, by_seed.values()))


def find_runs(
    paths: Iterable[Path | str], count: Count = silent, tuning: bool = False
) -> tuple[list[Run], list[Problem]]:
    """Return every run in or below directories, and what is left out: unreadable logs, and duplicate runs.

    Single-task experts are silently left out beside other runs.

    Args:
        count: called after each file that is read.
        tuning: return tuning runs, too, instead of a sentence on them.
    """
    found: list[Run] = []
    problems: list[Problem] = []
    refused: dict[Path, Path] = {}
    every = []
    for path in without_sweeps_files(paths):
        files, deep = files_below(path, (LOG, FAILURE))
        problems += map(Problem, deep, map(too_deep, deep))
        if not files:
            problems.append(Problem(path, no_run(path)))
        every += files
    for done, file in enumerate(every, 1):
        try:
            if file.name == LOG:
                found.append(read_run(file.parent))
            elif not (file.parent / LOG).exists():
                refused.setdefault(file.parent.resolve(), file.parent)
        except Exception as error:  # a broken directory is never an end for others
            problems.append(Problem(file.parent, one_line_of(error, file)))
        count("runs read", done, len(every))
    problems += [Problem(folder, f"{folder} did not begin, {_failure(folder)}") for folder in refused.values()]
    runs: dict[tuple[Any, ...], Run] = {}
    for run in [run for run in found if run.group[0] != EXPERT] or found:
        first = runs.setdefault((*run.configuration, run.seed), run)
        if first.path.resolve() == run.path.resolve():
            continue
        left = run
        if first.reason is not None and run.reason is None:
            left = first
            runs[*run.configuration, run.seed] = run
        reason = f"{first.path} and {run.path} are "
        if run.agent is None:
            name = 'Recorder(..., about={"learner": "NAME"})'
            reason += f"both seed {run.seed} of the learner of {run.settings[FOLDER]}, {left.path} is left out: "
            reason += f"learners need names, such as {name}, or separate folders"
        else:
            reason += f"one run twice; {left.path} is left out"
        problems.append(Problem(left.path, reason if left.reason is None else f"{reason} ({left.reason})"))
    if tuning:
        return list(runs.values()), problems
    is_tuning = split_by(runs.values(), lambda run: tuning_share(run.about) is not None)
    tuned = split_by(is_tuning.get(True, ()), lambda run: (run.group[0], run.agent, tuning_share(run.about)))
    for (name, agent, share), some in tuned.items():
        trials = len({run.alike for run in some})
        seeds = listed(sorted({run.seed for run in some}), MOST_SEEDS)
        runs_of = f"{len(some)} tuning run{'s' * (len(some) > 1)} of {agent} on {name}"
        what = f"{runs_of}: {trials} trial{'s' * (trials > 1)}, seeds {seeds}"
        ends = {max(value.frames or 0 for value in run.values) for run in some if run.values}
        ended = f", ended after {listed(sorted(ends), MOST_SEEDS)} frames" if ends else ""
        reason = f"{what}, objective_until={share:g}{ended}; --tuning, in Python tuning=True, shows them"
        problems.append(Problem(some[0].path, reason, is_error=False))
    return is_tuning.get(False, []), problems


def read_run(path: Path) -> Run:
    """A run directory, finished or not. With a broken file it has only what was run, and the reason.

    Raises:
        ValueError: if its log lacks its first line, or is of a newer version.
        OSError: if its log cannot be opened.
    """
    file = path / LOG
    about = _about(file)
    config = dict(about["config"])
    for key in OF_THE_CURRICULUM:
        config.pop(key, None)
    if called(config.get("method")) == NO_METHOD:
        del config["method"]
    seed = config.pop("seed")
    config = as_before(config)
    agent = _agent(config)
    settings = dict(flat(config))
    if agent is None:
        settings[FOLDER] = str(path.resolve().parent)
    try:
        log = RunLog.read(file)
        log = by_windows(log) if "life" in about else log
        values = list(_values(log))
        history = _history(log, values)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = str(error) if isinstance(error, ValueError) else f"{file}: a measurement lacks or misuses {error}"
        return Run(path, about, agent, settings, seed, reason=reason)
    metrics, why = _metrics(path, log)
    for name, metric in metrics.items():
        values.append(Value(*NOWHERE, metric=name, value=metric["value"]))
    return Run(path, about, agent, settings, seed, reason=why, metrics=metrics, values=values, history=history)


def _values(log: RunLog) -> Iterator[Value]:
    for m in log.measurements:
        prefix, names = MEASURES.get(m["kind"], ("", ()))
        is_task = "task" in m
        task = label_of(m) if is_task else None
        held_out = bool(m.get("held_out")) if is_task else None
        for name in names:
            place = (m["block"], m.get("moment"), m["frames"], m.get("step"))
            yield Value(task, held_out, *place, metric=prefix + name, value=m.get(name))


def _about(file: Path) -> NamedValues:
    first, _, _ = read_regular(file, MOST_BYTES).partition(b"\n")
    try:
        about = parsed(first)
        check(about)
    except ValueError:
        about = {}
    is_run = about.get("kind") == "run"
    require((is_run, f"{file} does not say what was run: its first line is missing, or it is no log of ours"))
    missing = [name for name in ABOUT if not about.get(name)]
    require((not missing, f"{file} does not say its {', '.join(missing)}; add it to the first line"))
    config = about["config"]
    schema = about.get("schema", SCHEMA)
    has_seed = isinstance(config, dict) and is_int(config.get("seed"))
    require(
        (has_seed, f"{file} has no seed in its config; add it to the first line"),
        (is_int(schema, 1, SCHEMA), f"{file} has schema {schema}, this version reads {SCHEMA}: update ctgraph_rl"),
    )
    return {**about, "curriculum": str(about["curriculum"]), "fingerprint": str(about["fingerprint"])}


def _agent(config: ReadOnlyValues) -> str | None:
    learner = config.get("agent")
    agent = called(learner) or called(config.get("learner"))
    cell = called(learner.get("cell")) if isinstance(learner, Mapping) else None
    others = [called(config.get(part)) for part in ("method", "plasticity", "detector")]
    parts = (agent, cell, *others)
    return " + ".join(filter(None, parts)) if agent else agent


def called(part: Any) -> str | None:
    """Return the class that a configuration's part builds, or its name."""
    if isinstance(part, Mapping) and "_target_" in part:
        return str(part["_target_"]).rpartition(".")[2]
    return part if isinstance(part, str) and part else None


def _metrics(path: Path, log: RunLog) -> tuple[NamedValues, str | None]:
    file = path / METRICS
    if file.exists():
        try:
            return metrics_of(read_regular(file, MOST_BYTES_OF_METRICS)), None
        except (OSError, ValueError) as error:
            return {}, f"{file} cannot be read: {error}"
    reason = _failure(path)
    if reason is None:
        total = log.about.get("num_frames")
        reached = max(m.get("frames", 0) for m in log.measurements)
        reason = "unfinished" if total is None else f"unfinished: {reached:,} of {total:,} frames"
    return {}, f"{reason}, with a torn last line" if log.torn_lines else reason


def _failure(path: Path) -> str | None:
    return "failed: " + " ".join(failure(path).split()) if (path / FAILURE).exists() else None


def _history(log: RunLog, values: Sequence[Value]) -> History:
    performance = log.performance().tolist()
    evaluations: dict[str, Curve] = {}
    training: dict[int, Curve] = {}
    for task, held_out, block, _, frames, _, metric, value in values:
        assert frames is not None
        if metric == "return_mean" and task is not None and not held_out:
            evaluations.setdefault(task, []).append((frames, math.nan if value is None else value))
        elif metric == "training_return_mean" and block is not None and value is not None:
            training.setdefault(block, []).append((frames, value))
    adapted = {"trained": log.adaptation(), "held-out": log.adaptation(held_out=True)}
    units: dict[str, Curve] = {}
    for line in log.of_kind("units"):
        for name in UNIT_METRICS if line["images"] == "fresh" and line["moment"] != "start" else ():
            units.setdefault(name, []).append((line["frames"], line[name]))
    experts_together: list[bool] = []
    for line in log.of_kind("experts"):
        experts_together += ["together" in each for each in line["experts"]]
    return History(
        labels=log.labels(len(performance[0])),
        trained=tuple(tuple(number - 1 for number in block) for block in log.about.get("trained") or ()),
        ends=tuple(log.ends()),
        performance=performance,
        evaluations=evaluations,
        training=training,
        units=units,
        spans=label_spans(log),
        adaptation={name: found for name, found in adapted.items() if found is not None},
        seconds=log.measurements[-1].get("seconds", 0.0),
        experts_together=tuple(experts_together),
    )


def grouped(runs: Sequence[Run]) -> dict[AgentKey, dict[int, Run | None]]:
    """Return runs by seed, for each (curriculum, agent); None for a seed that only other agents have.

    Tuning runs and others expect no seeds of each other.

    Runs of a curriculum and agent stand at the first's place, by the settings in which they differ. A curriculum has
    its shortest name, with its fingerprint if another has the same.
    """
    groups: dict[tuple[Any, ...], dict[int, Run]] = {}
    expected: dict[Any, set[int]] = {}
    named: dict[CurriculumKey, str] = {}
    differing: dict[Any, list[str]] = {}
    for kind, some in split_by(runs, _kind).items():
        known = {key for run in some for key in run.settings}
        keys = sorted(key for key in known if len({json.dumps(run.settings.get(key)) for run in some}) > 1)
        differing[kind] = keys
        for run in sorted(some, key=lambda run: [_rank(run.settings.get(key)) for key in keys]):
            groups.setdefault(run.configuration, {})[run.seed] = run
            if run.agent is not None:
                expected.setdefault((run.group, tuning_share(run.about)), set()).add(run.seed)
    for run in runs:
        named[run.group] = min(named.get(run.group, run.curriculum[0]), run.curriculum[0], key=len)
    several = repeated(named.values())
    one_each = [next(iter(by_seed.values())) for by_seed in groups.values()]
    found: dict[AgentKey, dict[int, Run | None]] = {}
    twins = split_by(one_each, lambda run: run.alike)
    for one, by_seed in zip(one_each, groups.values(), strict=True):
        curriculum = named[one.group]
        if curriculum in several:
            curriculum += f" {one.group[1]}"
        seeds = sorted(by_seed if one.agent is None else expected[one.group, tuning_share(one.about)])
        parts = [_name(one)]
        for key in differing[_kind(one)]:
            short = key.removeprefix("agent.").removeprefix("method.").removeprefix("plasticity.")
            parts.append(f"{short}={one.settings.get(key)}")
        code = code_of(one, twins[one.alike])
        if code:
            parts.append(f"({code})")
        name = " ".join(parts) if one.shown is None else one.shown[1]
        found[curriculum, name] = {seed: by_seed.get(seed) for seed in seeds}
    return dict(sorted(found.items(), key=lambda item: min(map(_place, item[1].values()))))


def by_curriculum(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Return runs by curriculum name, in the order of tables."""
    found: dict[str, list[Run]] = {}
    for (name, _), by_seed in grouped(runs).items():
        found.setdefault(name, []).extend(present(by_seed))
    return found


def histories(runs: Iterable[Run]) -> list[History]:
    """Return the histories of readable runs."""
    return [run.history for run in runs if run.history is not None]


def _place(run: Run | None) -> float:
    return math.inf if run is None or run.shown is None else run.shown[0]


def _rank(value: Any) -> tuple[int, float, str]:
    return (1, value, "") if is_real(value) else (0 if value is None else 2, 0.0, str(value))


def code_of(run: Run, others: Sequence[Run]) -> str:
    """Return in words a run's code, where it differs between others."""
    codes = [other.code for other in others]
    own = run.code
    values = []
    for name in sorted(set(chain(*codes))):
        if len({code.get(name, "") for code in codes}) > 1:
            values.append((name, own.get(name, "")))
    said = [f"{name} {'unknown' if value is None else value or 'not there'}" for name, value in values]
    if len(said) > MOST_MODULES:
        rest = json.dumps(values[MOST_MODULES:])
        said[MOST_MODULES:] = [f"{len(said) - MOST_MODULES} more {hashlib.sha256(rest.encode()).hexdigest()[:8]}"]
    return ", ".join(said)


def _kind(run: Run) -> tuple[CurriculumKey, str]:
    return run.group, _name(run)


def _name(run: Run) -> str:
    return Path(run.settings[FOLDER]).name if run.agent is None else run.agent
