"""A submission: a folder of files that show what a method reached.

- ``submission.json``: an object of `PARTS`, with a run of `RUN` for each seed.
- ``logs/RUN.jsonl.gz``: the log of each run. Those of single-task experts are no part of it.
- ``verification.json``: what a verification found; not part of what was submitted.

Readers compute scores from the logs. No code of the folder is ever run.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

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


OBJECT = Kind(lambda value: isinstance(value, dict), "an object")
ANY_TEXT = Kind(lambda value: isinstance(value, str), "a text")
SUM = matching("[0-9a-f]{64}", "64 hexadecimal digits")


PARTS = {
    "schema": Kind(lambda value: is_int(value, SCHEMA, SCHEMA), str(SCHEMA)),
    "method": OBJECT,
    "config": Kind(OBJECT.holds, "settings"),
    "versions": Kind(
        lambda value: isinstance(value, dict) and all(map(ANY_TEXT.holds, value.values())), "texts by name"
    ),
    "curriculum": OBJECT,
    "runs": Kind(lambda value: isinstance(value, list) and 0 < len(value) <= MOST_RUNS, f"a list of 1..{MOST_RUNS:,}"),
}

RUN = {
    "run": matching(NAME.pattern, "a name of a file"),
    "seed": COUNT,
    "reason": or_null(ANY_TEXT),
    "group": list_of(COUNT, "a list of seeds"),
    "agent_sha256": or_null(SUM),
    "agent_bytes": or_null(COUNT),
    "log_sha256": SUM,
    "experts": Kind(lambda value: value == [], "empty"),  # digests of published submissions have it
    "machine": ANY_TEXT,
    "num_threads": COUNT,
    "cpu": ANY_TEXT,
    "seconds": Kind(lambda value: is_real(value, 0, MOST_SECONDS), f"a number in 0..{MOST_SECONDS:,.0f}"),
}


@dataclass(frozen=True)
class SubmittedRun:
    """One of the ``runs``, with the keys of `RUN` but ``experts``."""

    run: str
    seed: int
    reason: str | None
    group: tuple[int, ...]
    agent_sha256: str | None
    agent_bytes: int | None
    log_sha256: str
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


def read_submission(path: Path | str, config_dir: Path | None = None) -> Submission:
    """Read a submission and check its form; `ctgraph_rl.board.rescore` checks its content.

    Args:
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
        name = method["track"]
        of_track = None if name is None else track(name, config_dir)
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
    if of_track is None:
        where = "published"
        known = [curriculum_named(str(content.get("name")))]
    else:
        where = f"of track {of_track.id}"
        known = [variant.curriculum for variant in of_track.variants]
    for curriculum in known:
        if curriculum.fingerprint == content.get("fingerprint"):
            return curriculum
    raise ValueError(f"curriculum has tasks that are no CT-graphs, and is not {where}: its environments are not made")


def _check_fields(given: Any, kinds: Mapping[str, Kind], what: str, owner: str = "") -> None:
    whole = isinstance(given, dict) and {*given} == {*kinds}
    require((whole, f"{what} {', '.join(kinds)}, got {given!r:.80}"))
    require(*kind_rules(given, kinds, owner))


def _run(given: Any) -> SubmittedRun:
    owner = f" of {given.get('run')!r:.80}" if isinstance(given, dict) else ""
    _check_fields(given, RUN, "a run must have", owner)
    values = {**given, "group": tuple(given["group"])}
    del values["experts"]
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
        "config": config,
        "versions": versions,
        "curriculum": curriculum.to_json(),
        "runs": [{**asdict(run), "experts": []} for run in runs],
    }
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def log_name(run: str) -> str:
    """Return the place of a run's log in a submission."""
    return f"{LOGS}/{run}.jsonl.gz"


def packed(content: bytes) -> bytes:
    """Return the content of a submitted log, equal for equal logs."""
    return gzip.compress(content, mtime=0)


def read_log(path: Path) -> RunLog:
    """Read a log of a submission; no more than `MOST_BYTES_OF_A_LOG` are unpacked.

    Raises:
        ValueError: if it is no gzip file, larger, or no log.
        OSError: if it cannot be read.
    """
    most = MOST_BYTES_OF_A_LOG
    with named(path):
        data = read_regular(path, most)
        try:
            content = gzip.GzipFile(fileobj=BytesIO(data)).read(most + 1)
        except (EOFError, OSError, zlib.error) as error:
            raise ValueError(f"is no file of gzip: {error}; restore it") from None
        require((len(content) <= most, f"holds more than {most:,} bytes, the limit"))
    return RunLog.of_content(content, path)


def log_sum(log: RunLog) -> str:
    """Return the SHA-256 of a log without times, versions and machine: equal for equal runs, bit for bit.

    It is over a line of JSON with sorted keys for each measurement. Lines on experts, and later settings with their
    value for "as before", do not count.
    """
    found = hashlib.sha256()
    for line in counted_lines(log):
        found.update(json.dumps(line, sort_keys=True).encode() + b"\n")
    return found.hexdigest()


def counted_lines(log: RunLog) -> Iterator[NamedValues]:
    """Yield what of each measurement counts in the log's sum."""
    for measurement in log.measurements:
        kept = without_time(measurement)
        if kept["kind"] == "run":
            kept = {key: value for key, value in kept.items() if key not in NOT_COUNTED}
            kept["config"] = as_before(kept.get("config") or {})
        if kept["kind"] != "experts":
            yield kept
