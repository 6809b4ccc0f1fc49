"""Level *rescored* of a verification: a submission's logs are those that it names, whole, and all rules hold.

Scores are computed from the logs; no code of the submission runs. Only a rerun finds logs that are made up.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

from ctgraph_rl.board.method_yaml import fact_rules, facts_of, track_version
from ctgraph_rl.board.submission import Submission, SubmittedRun, log_sum
from ctgraph_rl.board.tracks import TUNING_SEEDS, Track, write_seeds
from ctgraph_rl.checks import ReadOnlyValues, Rule, require
from ctgraph_rl.learn.evaluate import Evaluator
from ctgraph_rl.log.escape import listed
from ctgraph_rl.log.provenance import is_published
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.scores import scores
from ctgraph_rl.packages import class_named
from ctgraph_rl.parsers import LEVELS
from ctgraph_rl.report.columns import board_columns
from ctgraph_rl.runs.load import match_class
from ctgraph_rl.runs.read import MODIFIED
from ctgraph_rl.runs.settings import differences, with_added
from ctgraph_rl.tasks.curriculum import Curriculum

RESCORED = LEVELS[0]

OF_OURS = "baselines."

MAY_BE_READ = ("", "the frames of each block")
"""What methods may read beside what the protocol gives: a track fixes the frames of its blocks."""


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


def equal(what: str, expected: object, found: object, run: str = "") -> Check:
    """Return the check that two values are equal."""
    return Check(what, str(expected), str(found), expected == found, run)


def rescore(submission: Submission) -> list[Check]:
    """Check a submission by its files.

    Raises:
        ValueError: for files that cannot be read.
        OSError: if a file cannot be read.
    """
    checks = [*_of_the_whole(submission)]
    for run in submission.runs:
        checks += _of_the_log(submission, run, submission.log(run))
    return checks


def scores_of(submission: Submission, run: SubmittedRun) -> dict[str, float | None]:
    """Return a board's values of a finished run, from its log: the track's score and `board_columns`.

    Raises:
        ValueError: if the log is not the one that the submission names, or of another curriculum.
    """
    log = submission.log(run)
    own = log_sum(log) == run.log_sha256
    require((own, f"the log of {run.run} is another one than the submission names: restore it"))
    found = scores(log, submission.curriculum)
    names = board_columns(submission.curriculum)
    if submission.track is not None:
        names = [submission.track.score, *names]
    return {name: found[name].value for name in names}


def _of_the_whole(submission: Submission) -> Iterator[Check]:
    method = submission.method
    curriculum = submission.curriculum
    runs = submission.runs
    of_track = submission.track
    if of_track is not None:
        yield equal("version of the track", track_version(method), of_track.version)
    facts = facts_of(curriculum.protocol, runs)
    rules = {
        "curriculum": [curriculum_rule(curriculum, of_track)],
        "seeds": seed_rules([run.seed for run in runs], method["tuning"]["seeds"], of_track),
        "way to run it again": [entry_rule(submission.config, method["entry_point"])],
        "oracle": [oracle_rule(submission.config)],
        "method": fact_rules(method, facts, runs, len(curriculum.tasks)),
    }
    for what, own in rules.items():
        broken = "; ".join(message for holds, message in own if not holds)
        yield Check(what, "all rules hold", broken or "they hold", not broken)


def _of_the_log(submission: Submission, run: SubmittedRun, log: RunLog) -> Iterator[Check]:
    about = log.about
    config = dict(about.get("config") or {})
    seed = config.pop("seed", None)
    changed = listed(differences(config, submission.config))
    last = (log.measurements or [{}])[-1]
    compared = {
        "sum of the log": (run.log_sha256, log_sum(log)),
        "seed": (run.seed, seed),
        "config": ("equal settings", changed or "equal settings"),
        "versions": (dict(submission.versions), about.get("versions")),
        "curriculum of the log": (submission.curriculum.fingerprint, about.get("fingerprint")),
        "seconds": (last.get("seconds", 0.0), run.seconds),
        "group": (run.group, tuple(about.get("together") or ())),
        "machine": (run.machine, about.get("machine")),
        "threads": (run.num_threads, about.get("num_threads")),
        "CPU": (run.cpu or None, about.get("cpu")),
    }
    for what, (expected, found) in compared.items():
        yield equal(what, expected, found, run.run)
    if run.finished:
        yield from of_the_protocol(submission.curriculum, run.seed, log, run.run)


def of_the_protocol(curriculum: Curriculum, seed: int, log: RunLog, run: str) -> Iterator[Check]:
    """Yield checks that a log has all evaluations of the protocol and all frames of the curriculum."""
    how = curriculum.evaluation
    yield equal("frames", curriculum.num_frames, log.ends()[-1], run)
    tasks_at = Evaluator(curriculum, seed, log).tasks_at
    wanted = []
    for at in curriculum.moments:
        for number, _ in tasks_at(at).values():
            wanted.append((at, number, None if how.exact else how.num_episodes))
    there = [(m["frames"], m["task"], m.get("episodes")) for m in log.of_kind("evaluation")]
    notes = []
    for what, some in (("missing", {*wanted} - {*there}), ("more", {*there} - {*wanted})):
        if some:
            notes.append(f"{what} (frames, task, episodes): {listed(sorted(some, key=str))}")
    yield Check("evaluations", str(len(wanted)), str(len(there)), wanted == there, run, note="; ".join(notes))


# rules of a submission, pairs of (holds, message)


def curriculum_rule(curriculum: Curriculum, of_track: Track | None) -> Rule:
    """Return the rule that a curriculum is one of a track, or without a track the published one of its name."""
    name = curriculum.name.removesuffix(MODIFIED)
    found = curriculum.fingerprint
    if of_track is not None:
        wanted = of_track.by_fingerprint
        return found in wanted, (
            f"curriculum {name} has fingerprint {found}, track {of_track.id} has {', '.join(wanted)}: "
            f"run ctgraph-rl -m track={of_track.name}, with no other curriculum, protocol or evaluation"
        )
    published = is_published(replace(curriculum, name=name))
    if published is None:
        return False, f"no published curriculum is named {name}: run a published one, or name a track that has it"
    fix = "run it without changes, or name a track that has it"
    return published, f"curriculum {name} (fingerprint {found}) is not the published one, it was modified: {fix}"


def seed_rules(seeds: Iterable[int], tuned: Iterable[int], of_track: Track | None) -> list[Rule]:
    """Return the rules that seeds are those of the track, if any, and were not used for tuning."""
    own = set(seeds)
    used = own & set(tuned)
    rules = [(not used, f"seeds {listed(sorted(used))} are among tuning.seeds: submit runs of other seeds")]
    if of_track is None:
        return rules
    wanted = set(of_track.seeds)
    reserved = own & set(TUNING_SEEDS)
    missing = wanted - own
    others = own - wanted - reserved
    asked = f"track {of_track.id} has seeds {write_seeds(wanted)}"
    return [
        *rules,
        (not missing, f"seeds {listed(sorted(missing))} are missing: {asked}"),
        (not reserved, f"seeds {listed(sorted(reserved))} are for tuning: {asked}"),
        (not others, f"seeds {listed(sorted(others))} are of no submission: {asked}"),
    ]


def entry_rule(config: ReadOnlyValues, entry_point: str | None) -> Rule:
    """Return the rule that a configuration can be run again."""
    agent = config.get("agent")
    is_built = isinstance(agent, Mapping) and "_target_" in agent
    fix = "set entry_point: module:function in method.yaml, a function (curriculum, seed, run_dir) that trains a run"
    return is_built or entry_point is not None, f"no agent can be built from the configuration of the runs: {fix}"


def oracle_rule(config: ReadOnlyValues) -> Rule:
    """Return the rule that a method or detector of ours reads no more of the tasks than the learner is given.

    A class of `baselines` goes by the name of its defining module only. A method is built, as its settings decide; a
    detector, whose settings may ask for any memory, is not.
    """
    kinds: dict[str, type] = {}
    unknown = []
    reads = ""
    for group in ("method", "detector"):
        settings = config.get(group)
        name = str(settings.get("_target_")) if isinstance(settings, Mapping) else ""
        ours = match_class(group, name)
        kind = None if ours is None else class_named(ours[1], ours[2])
        if kind is not None:
            kinds[group] = kind
        elif name.startswith(OF_OURS):
            unknown.append(f"{group}={name}")
    if unknown:
        return False, f"{listed(unknown)} is no method or detector of baselines: name it by the module that defines it"
    if "method" in kinds:
        given = {key: value for key, value in with_added(config["method"]).items() if not key.startswith("_")}
        with suppress(TypeError, ValueError):  # settings of another version
            reads = getattr(kinds["method"](**given), "reads_tasks", "")
    if getattr(kinds.get("detector"), "is_oracle", False):
        reads = "the true tasks"
    oracles = " ".join(f"{group}={kind.__name__}" for group, kind in kinds.items())
    fix = "it is a reference for others, submit runs without it"
    return reads in MAY_BE_READ, f"{oracles} is an oracle, which reads {reads}: {fix}"
