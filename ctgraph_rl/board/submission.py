"""A submission: a folder of files that show what a method reached.

- ``submission.json``: an object of `PARTS`, with a run of `RUN` for each seed.
- ``logs/RUN.jsonl.gz``: the log of each run; ``logs/RUN.expert_K.jsonl.gz``: of its single-task expert of task K.
- ``verification.json``: what a verification found; not part of what was submitted.

Readers compute scores from the logs. No code of the folder is ever run.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import re
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from ctgraph_rl.board.method_yaml import COUNT, Kind, check_method, kind_rules, list_of, matching, or_null
from ctgraph_rl.board.tracks import Track, track
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, is_int, is_real, repeated, require
from ctgraph_rl.disk import read_regular
from ctgraph_rl.log.escape import listed
from ctgraph_rl.log.measurement import without_time
from ctgraph_rl.log.named_curricula import curriculum_named
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.runs.settings import as_before
from ctgraph_rl.strict import json_value, named
from ctgraph_rl.tasks.curriculum import Curriculum

SUBMISSION = "submission.json"
LOGS = "logs"

VERIFICATION = "verification.json"

SCHEMA = 2

MOST_BYTES, MOST_BYTES_OF_A_LOG = 2**24, 2**26
"""Largest ``submission.json``, 16 MiB, and largest log, packed and unpacked, 64 MiB."""

MOST_RUNS, MOST_SECONDS = 10_000, 1e9

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.=-]{0,119}")

NOT_COUNTED = ("versions", "machine", "num_threads", "cpu", "source", "num_frames")
"""Fields of a log's first line outside its sum; the fingerprint stands for source and frames."""


class Field(NamedTuple):
    """A field of ``submission.json``."""

    kind: Kind
    meaning: str


OBJECT = Kind(lambda value: isinstance(value, dict), "an object")
ANY_TEXT = Kind(lambda value: isinstance(value, str), "a text")
SUM = matching("[0-9a-f]{64}", "64 hexadecimal digits")


def _are_texts(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(each, str) for each in value.values())


def _are_runs(value: object) -> bool:
    return isinstance(value, list) and 0 < len(value) <= MOST_RUNS


PARTS = {
    "schema": Field(Kind(lambda value: is_int(value, SCHEMA, SCHEMA), str(SCHEMA)), "version of this format"),
    "method": Field(OBJECT, "what `method.yaml` says, without the failed seeds"),
    "config": Field(Kind(OBJECT.holds, "settings"), "the configuration that all runs share, without the seed"),
    "versions": Field(
        Kind(_are_texts, "texts by name"),
        "versions of the packages and of Python that computed the runs, by name",
    ),
    "curriculum": Field(OBJECT, "what was learned, see `Curriculum.to_json`"),
    "runs": Field(Kind(_are_runs, f"a list of 1..{MOST_RUNS:,}"), "an object for each seed"),
}

RUN = {
    "run": Field(matching(NAME.pattern, "a name of a file"), "name of the run, and of its log in `logs/`"),
    "seed": Field(COUNT, "its seed"),
    "reason": Field(or_null(ANY_TEXT), "why it failed or was stopped; null for a finished run"),
    "group": Field(
        list_of(COUNT, "a list of seeds"),
        "seeds that were trained together as one batch; empty for a run without others",
    ),
    "agent_sha256": Field(
        or_null(SUM), "SHA-256 of the agent's state: names, types, shapes and bits; null where a run left none"
    ),
    "agent_bytes": Field(or_null(COUNT), "bytes of all tensors of that state"),
    "log_sha256": Field(SUM, "SHA-256 of the log without times, versions and machine"),
    "experts": Field(
        list_of(SUM, "sums of 64 hexadecimal digits"), "such a sum for the log of each single-task expert"
    ),
    "machine": Field(ANY_TEXT, "kind of machine that it ran on"),
    "num_threads": Field(COUNT, "threads of torch"),
    "cpu": Field(ANY_TEXT, "model of the CPU; empty where the system does not say"),
    "seconds": Field(
        Kind(lambda value: is_real(value, 0, MOST_SECONDS), f"a number in 0..{MOST_SECONDS:,.0f}"),
        "time of the run; runs of one group share it",
    ),
}


@dataclass(frozen=True)
class SubmittedRun:
    """One of the ``runs``, with the keys of `RUN`."""

    run: str
    seed: int
    reason: str | None
    group: tuple[int, ...]
    agent_sha256: str | None
    agent_bytes: int | None
    log_sha256: str
    experts: tuple[str, ...]
    machine: str
    num_threads: int
    cpu: str
    seconds: float

    @property
    def finished(self) -> bool:
        """Whether it has results."""
        return self.reason is None

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of its group, or its one seed."""
        return self.group or (self.seed,)


@dataclass(frozen=True)
class Submission:
    """A submission as data.

    Args:
        method: from ``method.yaml``.
        config: of all runs, without the seed.
        versions: of packages that computed them, by name.
        track: that it is for, or None.
        digest: SHA-256 of ``submission.json``, which has the sums of all logs.
    """

    path: Path
    method: ReadOnlyValues
    config: ReadOnlyValues
    versions: Mapping[str, str]
    curriculum: Curriculum
    runs: tuple[SubmittedRun, ...]
    track: Track | None
    digest: str

    @cached_property
    def finished(self) -> tuple[SubmittedRun, ...]:
        """The runs that have results."""
        return tuple(run for run in self.runs if run.finished)

    def log(self, run: SubmittedRun) -> RunLog:
        """Return the log of a run.

        Raises:
            ValueError: if it is no log, or too large.
            OSError: if it cannot be read.
        """
        return read_log(self.path / log_name(run.run))

    def experts(self, run: SubmittedRun, log: RunLog) -> list[RunLog] | None:
        """Return the logs of the single-task experts of a run; None if it had none.

        Raises:
            ValueError: as `log`.
            OSError: if one of them cannot be read.
        """
        found = []
        left = MOST_BYTES_OF_A_LOG  # of all of them together
        for each in experts_of(log):
            path = self.path / log_name(run.run, each["task"])
            content = unpacked(path, left)
            left -= len(content)
            found.append(RunLog.of_content(content, path))
        return found or None


def read_submission(path: Path | str, of_track: Track | None = None, config_dir: Path | None = None) -> Submission:
    """Read a submission and check its form; `ctgraph_rl.board.rescore` checks its content.

    Args:
        of_track: in place of the track that its method names.
        config_dir: where the user's tracks are, as ``track/NAME.yaml``.

    Raises:
        ValueError: for what is no submission; names what is missing or wrong.
        OSError: if a file cannot be read.
    """
    path = Path(path)
    file = path / SUBMISSION
    fix = "ctgraph-rl submit RUNS --to DIR writes one"
    require((path.is_dir(), f"{path} holds no submission: there is no such folder; {fix}"))
    require((file.is_file(), f"{path} holds no submission, it lacks {SUBMISSION}: {fix}"))
    data = read_regular(file, MOST_BYTES)
    with named(file):
        content = json_value(data)
        _check_fields(content, PARTS, "must be an object of")
        runs = tuple(sorted(map(_run, content["runs"]), key=lambda run: run.seed))
        names = sorted(repeated(run.run.lower() for run in runs))
        seeds = sorted(repeated(str(run.seed) for run in runs))
        require(
            ("seed" not in content["config"], "config must leave out the seed, which the runs have"),
            (not names, f"names a run twice: {listed(names)}"),
            (not seeds, f"has a seed twice: {listed(seeds)}"),
        )
        method = {**content["method"], "failed": {run.seed: run.reason for run in runs if not run.finished}}
        check_method(method)
        if of_track is None and method["track"] is not None:
            of_track = track(method["track"], config_dir)
        curriculum = _curriculum(content["curriculum"], of_track)
    absent = [log_name(run.run) for run in runs if not (path / log_name(run.run)).is_file()]
    require((not absent, f"{path} lacks {listed(absent)}, which {SUBMISSION} names"))
    return Submission(
        path=path,
        method=method,
        config=content["config"],
        versions=content["versions"],
        curriculum=curriculum,
        runs=runs,
        track=of_track,
        digest=hashlib.sha256(data).hexdigest(),
    )


def _curriculum(content: ReadOnlyValues, of_track: Track | None) -> Curriculum:
    """Return what runs learned; for other tasks than CT-graphs our curriculum of the same fingerprint.

    Environments with arguments from a file could take any memory.
    """
    tasks = content.get("tasks")
    if not isinstance(tasks, list) or not any(isinstance(task, dict) and "type" in task for task in tasks):
        return Curriculum.from_json(content)
    known = [curriculum_named(str(content.get("name")))] if of_track is None else []
    for variant in () if of_track is None else of_track.variants:
        known.append(variant.curriculum)
    same = [curriculum for curriculum in known if curriculum.fingerprint == content.get("fingerprint")]
    where = "published" if of_track is None else f"of track {of_track.id}"
    message = f"curriculum has tasks that are no CT-graphs, and is not {where}: its environments are not made"
    require((bool(same), message))
    return same[0]


def _check_fields(given: Any, fields: Mapping[str, Field], what: str, owner: str = "") -> None:
    whole = isinstance(given, dict) and {*given} == {*fields}
    require((whole, f"{what} {', '.join(fields)}, got {given!r:.80}"))
    require(*kind_rules(given, {name: field.kind for name, field in fields.items()}, owner))


def _run(given: Any) -> SubmittedRun:
    owner = f" of {given.get('run')!r:.80}" if isinstance(given, dict) else ""
    _check_fields(given, RUN, "a run must have", owner)
    values = dict(given)
    values["group"] = tuple(given["group"])
    values["experts"] = tuple(given["experts"])
    return SubmittedRun(**values)


def submission_text(
    method: ReadOnlyValues,
    config: ReadOnlyValues,
    versions: ReadOnlyValues,
    curriculum: Curriculum,
    runs: tuple[SubmittedRun, ...],
) -> str:
    """Return the content of ``submission.json``."""
    content = {
        "schema": SCHEMA,
        "method": {key: value for key, value in method.items() if key != "failed"},
        "config": dict(config),
        "versions": dict(versions),
        "curriculum": curriculum.to_json(),
        "runs": list(map(asdict, runs)),
    }
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def log_name(run: str, expert: int | None = None) -> str:
    """Return the place of a run's log in a submission, or that of its expert of a task from 1."""
    return f"{LOGS}/{run}{'' if expert is None else f'.expert_{expert}'}.jsonl.gz"


def experts_of(log: RunLog) -> list[NamedValues]:
    """Return what a log says of single-task experts, in the order of tasks."""
    said: list[NamedValues] = []
    for line in log.of_kind("experts"):
        said += line.get("experts", ())
    for each in said:
        numbered = isinstance(each, dict) and is_int(each.get("task"), 1)
        require((numbered, "the log names experts without the numbers of their tasks: restore it"))
    twice = repeated(each["task"] for each in said)
    require((not twice, f"the log names two experts of task {listed(twice)}: restore it"))
    return said


def packed(content: bytes) -> bytes:
    """Return the content of a submitted log, equal for equal logs."""
    return gzip.compress(content, mtime=0)


def read_log(path: Path) -> RunLog:
    """Read a log of a submission; errors as `unpacked` and `RunLog.of_content`."""
    return RunLog.of_content(unpacked(path, MOST_BYTES_OF_A_LOG), path)


def unpacked(path: Path, most: int) -> bytes:
    """Return the content of a submitted log; no more than ``most`` bytes are unpacked.

    Raises:
        ValueError: if it is no gzip file, or larger.
        OSError: if it cannot be read.
    """
    with named(path):
        data = read_regular(path, MOST_BYTES_OF_A_LOG)
        try:
            content = gzip.GzipFile(fileobj=BytesIO(data)).read(most + 1)
        except (EOFError, OSError, zlib.error) as error:
            raise ValueError(f"is no file of gzip: {error}; restore it") from None
        require((len(content) <= most, f"holds more than {most:,} bytes, the limit"))
    return content


def log_sum(log: RunLog) -> str:
    """Return the SHA-256 of a log without times, versions and machine: equal for equal runs, bit for bit.

    It is over a line of JSON with sorted keys for each measurement. Later settings with their value for "as before" do
    not count.
    """
    found = hashlib.sha256()
    for measurement in log.measurements:
        found.update(json.dumps(counted(measurement), sort_keys=True).encode() + b"\n")
    return found.hexdigest()


def counted(measurement: ReadOnlyValues) -> NamedValues:
    """Return what of a measurement counts in the log's sum."""
    kept = without_time(measurement)
    if kept["kind"] != "run":
        return kept
    kept = {key: value for key, value in kept.items() if key not in NOT_COUNTED}
    return {**kept, "config": as_before(kept.get("config") or {})}
