"""Level *rescored* of a verification: what a submission says is what its own logs give.

All metrics and evaluations are computed again from the logs and compared, digit by digit on one kind of machine. It
runs no code of the submission. Logs may still be made up: a rerun finds that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import NamedTuple

from ctgraph_rl.board.method_yaml import fact_rules, facts_of, track_version
from ctgraph_rl.board.submission import (
    CONFIG,
    EVALUATIONS,
    LOGS,
    METHOD,
    METRIC_COLUMNS,
    METRICS,
    RUNS,
    VERSIONS,
    Submission,
    SubmittedRun,
    experts_of,
    log_sum,
)
from ctgraph_rl.board.submission_rules import curriculum_rule, entry_rule, one_line, oracle_rule, seed_rules
from ctgraph_rl.checks import ReadOnlyValues, Rule, is_real
from ctgraph_rl.disk import read_regular
from ctgraph_rl.learn.evaluate import Evaluator
from ctgraph_rl.log.escape import csv_text, listed
from ctgraph_rl.log.provenance import machine
from ctgraph_rl.log.run_log import MOST_BYTES, RunLog
from ctgraph_rl.log.scores import scores
from ctgraph_rl.log.tables import evaluations_parquet, require_parquet
from ctgraph_rl.metrics import Metric
from ctgraph_rl.parsers import LEVELS
from ctgraph_rl.runs.read import MODIFIED
from ctgraph_rl.runs.settings import differences
from ctgraph_rl.strict import named, parquet_rows

RESCORED = LEVELS[0]

MEASURES = ("average_performance", "forgetting")
"""Metrics that each table of a board shows beside the score of its track."""

ROUNDING = 1e-9
"""Largest difference, as a share of the value, between what two kinds of machines compute from one log."""


NO_ROW: ReadOnlyValues = {}


class Check(NamedTuple):
    """One thing that was compared."""

    what: str
    expected: str
    found: str
    passed: bool | None  # None: it could not be decided
    run: str = ""
    note: str = ""
    level: str = RESCORED

    @property
    def text(self) -> str:
        """The check as a line."""
        where = f"{self.run}: " if self.run else ""
        note = f" ({self.note})" if self.note else ""
        return f"{where}{self.what}: expected {self.expected}, found {self.found}{note}"


def differing(one: ReadOnlyValues, other: ReadOnlyValues) -> list[str]:
    """Return the names that have other values in two mappings; None stands for none."""
    return [name for name in {**one, **other} if one.get(name) != other.get(name)]


def equal(what: str, expected: object, found: object, run: str = "") -> Check:
    """Return the check that two values are equal."""
    return Check(what, str(expected), str(found), expected == found, run)


def rescore(submission: Submission) -> list[Check]:
    """Check what a submission says by its own files.

    Raises:
        ModuleNotFoundError: without pyarrow; names the extra to install.
        ValueError: for files that cannot be read.
        OSError: if a file cannot be read.
    """
    require_parquet()
    checks = [*_of_the_whole(submission)]
    finished = {}
    for run in submission.runs:
        log = submission.log(run)
        checks += _of_the_log(submission, run, log)
        if run.finished:
            finished[run] = log
    checks += _of_metrics(submission, finished)
    return checks + _of_evaluations(submission, list(finished.values()))


def _of_the_whole(submission: Submission) -> Iterator[Check]:
    """Yield checks of curriculum, seeds and method."""
    method = submission.method
    runs = submission.runs
    of_track = submission.track
    named = None if of_track is None else of_track.name
    yield equal("track", method["track"], named)
    if of_track is not None:
        yield equal("version of the track", track_version(method), of_track.version)
    found = submission.curriculum.fingerprint
    wanted = "the published one" if of_track is None else f"one of track {of_track.id}"
    yield _rules("curriculum", [curriculum_rule(submission.curriculum, of_track)], wanted, found)
    seeds = [run.seed for run in runs]
    wanted = "no seed of tuning" if of_track is None else ", ".join(map(str, of_track.seeds))
    rules = seed_rules(seeds, method["tuning"]["seeds"], of_track)
    yield _rules("seeds", rules, wanted, ", ".join(map(str, seeds)))
    entry = method["entry_point"]
    yield _rules("way to run it again", [entry_rule(submission.config, entry)], "agent or entry_point", str(entry))
    rule = oracle_rule(submission.config)
    yield _rules("oracle", [rule], "none", "none" if rule[0] else "one")
    facts = facts_of(submission.curriculum.protocol, runs)
    rules = fact_rules(method, facts, runs, len(submission.curriculum.tasks))
    said = {part: method[part] for part in facts}
    yield _rules(METHOD, rules, str(facts), str(said))
    failed = [run.seed for run in runs if not run.finished]
    yield equal(f"failed seeds of {METHOD}", sorted(method["failed"]), failed)


def _rules(what: str, rules: Sequence[Rule], expected: str, found: str) -> Check:
    """Return a check of rules, with the messages of those that are broken."""
    broken = "; ".join(message for holds, message in rules if not holds)
    return Check(what, expected, found, not broken, note=broken)


def _of_the_log(submission: Submission, run: SubmittedRun, log: RunLog) -> Iterator[Check]:
    """Yield checks of a log against what the other files say of its run."""
    yield equal("sum of the log", run.log_sha256, log_sum(log), run.run)
    about = (log.of_kind("run") or [{}])[0]
    config = dict(about.get("config") or {})
    yield equal("seed", run.seed, config.pop("seed", None), run.run)
    changed = differences(config, submission.config)
    yield Check(CONFIG, "equal settings", listed(changed) or "equal settings", not changed, run.run)
    yield equal(VERSIONS, dict(submission.versions), about.get("versions"), run.run)
    yield equal("curriculum of the log", submission.curriculum.fingerprint, about.get("fingerprint"), run.run)
    yield equal(f"curriculum of {RUNS}", submission.curriculum.fingerprint, run.fingerprint, run.run)
    named = str(about.get("curriculum")).removesuffix(MODIFIED)
    yield equal(f"name of the curriculum in {RUNS}", named, run.curriculum, run.run)
    yield equal(f"seconds of {RUNS}", (log.measurements or [{}])[-1].get("seconds", 0.0), run.seconds, run.run)
    reason = "" if run.finished else one_line(submission.method["failed"].get(run.seed, ""))
    yield equal(f"reason of {RUNS}", reason, run.reason, run.run)
    yield equal("group", run.group, tuple(about.get("together") or ()), run.run)
    stored = about.get("machine"), about.get("num_threads"), about.get("cpu")
    yield equal("machine", (run.machine, run.num_threads, run.cpu or None), stored, run.run)
    if run.finished:
        yield from _of_experts(submission, run, log)
        yield from of_the_protocol(submission, run, log)


def _of_experts(submission: Submission, run: SubmittedRun, log: RunLog) -> Iterator[Check]:
    """Yield checks that the logs of experts are those that a log names."""
    said = experts_of(log)
    alone = [expert.of_kind("run")[0] for expert in submission.experts(run) or ()]
    for what, key in (("curricula", "fingerprint"), ("groups", "together")):
        if said or what == "curricula":
            expected = [each.get(key) for each in said]
            found = [each.get(key) for each in alone]
            yield equal(f"{what} of experts", expected, found, run.run)


def of_the_protocol(submission: Submission, run: SubmittedRun, log: RunLog) -> Iterator[Check]:
    """Yield checks that a log has the evaluations of the protocol, and frames to the end of the curriculum."""
    curriculum = submission.curriculum
    how = submission.curriculum.evaluation
    yield equal("frames", curriculum.num_frames, log.ends()[-1], run.run)
    tasks_at = Evaluator(curriculum, run.seed, log).tasks_at
    wanted = []
    for at in curriculum.moments:
        for number, _ in tasks_at(at).values():
            wanted.append((at, number, None if how.exact else how.num_episodes))
    there = [(m["frames"], m["task"], m.get("episodes")) for m in log.of_kind("evaluation")]
    notes = []
    for what, some in (("missing", {*wanted} - {*there}), ("more", {*there} - {*wanted})):
        if some:
            notes.append(f"{what} (frames, task, episodes): {listed(sorted(some, key=str))}")
    yield Check("evaluations", str(len(wanted)), str(len(there)), wanted == there, run.run, note="; ".join(notes))


def metrics_text(found: Mapping[SubmittedRun, Mapping[str, Metric]]) -> str:
    """Return the content of ``metrics.csv``."""
    rows = [list(METRIC_COLUMNS)]
    for run, metrics in found.items():
        rows += _metric_cells(run, metrics).values()
    return csv_text(rows)


def _metric_cells(run: SubmittedRun, metrics: Mapping[str, Metric]) -> dict[str, list[str]]:
    """Return the cells of the lines of a run in ``metrics.csv``, by metric."""
    found = {}
    for name, metric in metrics.items():
        value = "" if metric.value is None else repr(metric.value)
        found[name] = [run.run, str(run.seed), name, value, metric.definition, metric.undefined or ""]
    return found


def near(one: object, other: object) -> bool:
    """Return whether two values are equal up to the rounding of another machine."""
    if not (is_real(one) and is_real(other)):
        return one == other
    return math.isclose(one, other, rel_tol=ROUNDING, abs_tol=ROUNDING)  # type: ignore[arg-type]


def _of_metrics(submission: Submission, logs: Mapping[SubmittedRun, RunLog]) -> list[Check]:
    """Return the checks of ``metrics.csv``: one for each difference, or one for all.

    A metric that no run states may have been defined since, and is not missed unless a board shows it: the score of
    the track and `MEASURES`.
    """
    same_kind = submission.scored_on == machine()["machine"]
    wrong = []
    count = 0
    needed = set(MEASURES).union(*submission.metrics.values())
    if submission.track is not None:
        needed.add(submission.track.score)
    more = sorted(set(submission.metrics) - {run.run for run in logs})
    rule = "no finished run has this name"
    if more:
        wrong.append(Check(METRICS, "metrics of finished runs", listed(more), False, note=rule))
    for run, log in logs.items():
        try:
            cells = _metric_cells(run, scores(log, submission.curriculum, submission.experts(run)))
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RuntimeError) as error:
            wrong.append(Check(METRICS, "metrics of the log", "none", False, run.run, note=str(error)))
            continue
        stated = submission.metrics.get(run.run, {})
        for name in {**cells, **stated}:
            if name in needed:
                count += 1
                line = list(stated[name].values()) if name in stated else None
                check = _of_metric(run.run, name, cells.get(name), line, same_kind)
                wrong += [] if check is None else [check]
    return wrong or [equal(METRICS, f"{count} values", f"{count} values")]


def _of_metric(
    run: str, name: str, cells: Sequence[str] | None, stated: Sequence[str] | None, same_kind: bool
) -> Check | None:
    """Return the check of a metric that is not what its log gives; None for one that is."""
    if cells == stated:
        return None
    what = f"{name} in {METRICS}"
    if cells is None or stated is None:
        return Check(what, _value(cells), _value(stated), False, run)
    if not same_kind and cells[4:] == stated[4:] and near(_number(cells[3]), _number(stated[3])):
        return None
    expected = []
    found = []
    for cell, other in zip(cells, stated, strict=True):
        if cell != other:
            expected.append(cell or "nothing")
            found.append(other or "nothing")
    return Check(what, ", ".join(expected), ", ".join(found), False, run)


def _value(cells: Sequence[str] | None) -> str:
    return "no line" if cells is None else cells[3] or "undefined"


def _number(cell: str) -> object:
    """Return a cell as a number if it is one, else its text."""
    try:
        return float(cell)
    except ValueError:
        return cell


def _of_evaluations(submission: Submission, logs: Sequence[RunLog]) -> list[Check]:
    """Return the checks of ``evaluations.parquet``: one for each row that differs, or one for all."""
    with named(submission.path / LOGS):
        table = evaluations_parquet(logs)
        expected = parquet_rows(table, table)
    try:
        found = parquet_rows(read_regular(submission.path / EVALUATIONS, MOST_BYTES), table)
    except ValueError as error:
        return [Check(EVALUATIONS, f"{len(expected)} rows", "a file that cannot be read", False, note=str(error))]
    wrong = []
    for number, pair in enumerate(zip_longest(expected, found, fillvalue=NO_ROW), 1):
        if pair[0] != pair[1]:
            wrong.append(Check(f"row {number} of {EVALUATIONS}", *_differing(*pair), False))
    return wrong or [equal(EVALUATIONS, f"{len(expected)} rows", f"{len(expected)} rows")]


def _differing(one: ReadOnlyValues, other: ReadOnlyValues) -> tuple[str, str]:
    """Return in words what two rows have where they differ."""
    if not one or not other:
        return ("a row" if one else "no row"), ("a row" if other else "no row")
    names = differing(one, other)
    return listed(f"{name}={one.get(name)}" for name in names), listed(f"{name}={other.get(name)}" for name in names)
