"""A submission: a folder of files with which you can check what a method reached.

- ``submission.json``: an object of `PARTS`, with a run of `RUN` for each seed.
- ``logs/RUN.jsonl.gz``: the log of each run; ``logs/RUN.expert_K.jsonl.gz``: of its single-task expert of task K.
- ``verification.json``: what a verification found; not part of what was submitted.

Scores are not stated: who reads a submission computes them from its logs. No code of the folder is ever run.
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
from typing import Any

from ctgraph_rl.board.method_yaml import check_method
from ctgraph_rl.board.tracks import Track, track
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, are_ints, is_int, is_real, is_shallow, repeated, require
from ctgraph_rl.disk import read_regular
from ctgraph_rl.log.measurement import without_time
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.runs.settings import as_before
from ctgraph_rl.strict import json_value, named
from ctgraph_rl.tasks.curriculum import Curriculum

SUBMISSION = "submission.json"
LOGS = "logs"

VERIFICATION = "verification.json"
"""The file that a verification writes."""

SCHEMA = 2
"""Of ``submission.json``."""

MOST_BYTES, MOST_BYTES_OF_A_LOG = 2**24, 2**26
"""Largest ``submission.json``, 16 MiB, and largest log, before and after it is unpacked, 64 MiB."""

MAX_NESTING = 16
"""Of a configuration."""

MOST_RUNS, MOST_SECONDS = 10_000, 1e9
"""Of a submission, and of a run."""

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.=-]{0,119}")
"""Names of runs, which are names of files."""

SUM = re.compile(r"[0-9a-f]{64}")

NOT_COUNTED = ("versions", "machine", "num_threads", "cpu", "source", "num_frames")
"""Fields of a log's first line that its sum leaves out; the fingerprint stands for source and frames."""

PARTS = {
    "schema": "version of this format",
    "method": "what `method.yaml` says, without the failed seeds",
    "config": "the configuration that all runs share, without the seed",
    "versions": "versions of the packages and of Python that computed the runs, by name",
    "curriculum": "what was learned, see `Curriculum.to_json`",
    "runs": "an object for each seed",
}
"""Keys of ``submission.json`` with their meaning."""

RUN = {
    "run": "name of the run, and of its log in `logs/`",
    "seed": "its seed",
    "reason": "why it failed or was stopped; null for a finished run",
    "group": "seeds that were trained together as one batch; empty for a run without others",
    "agent_sha256": "SHA-256 of the agent's state: names, types, shapes and bits; null where a run left none",
    "agent_bytes": "bytes of all tensors of that state",
    "log_sha256": "SHA-256 of the log without times, versions and machine",
    "experts": "such a sum for the log of each single-task expert",
    "machine": "kind of machine that it ran on",
    "num_threads": "threads of torch",
    "cpu": "model of the CPU; empty where the system does not say",
    "seconds": "time of the run; runs of one group share it",
}
"""Keys of each of the ``runs`` with their meaning."""


@dataclass(frozen=True)
class SubmittedRun:
    """One of the ``runs``; see `RUN`."""

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
        """The seeds of its group; its own for a run without others."""
        return self.group or (self.seed,)


@dataclass(frozen=True)
class Submission:
    """A submission as data.

    Args:
        path: its folder.
        method: what ``method.yaml`` says.
        config: the configuration of all runs, without the seed.
        versions: of what computed them, by the names of packages.
        curriculum: what they learned.
        runs: sorted by their seeds.
        track: the track that it is for; None: it is for none.
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
            ValueError: if it is no log, or larger than a log may be.
            OSError: if it cannot be read.
        """
        return read_log(self.path / log_name(run.run))

    def experts(self, run: SubmittedRun, log: RunLog) -> list[RunLog] | None:
        """Return the logs of the single-task experts that the log of a run names; None if it was trained without.

        Raises:
            ValueError: see `log`.
            OSError: if one of them cannot be read.
        """
        found = []
        for each in experts_of(log):
            found.append(read_log(self.path / log_name(run.run, each["task"])))
        return found or None


def read_submission(path: Path | str, of_track: Track | None = None, config_dir: Path | None = None) -> Submission:
    """Read a submission and check its form; `ctgraph_rl.board.rescore` checks what it says.

    Args:
        path: its folder.
        of_track: the track, in place of the one that its method names.
        config_dir: where a track of the user's own is, as ``track/NAME.yaml``.

    Raises:
        ValueError: for what is no submission; names what is missing or wrong.
        OSError: if a file cannot be read.
    """
    path = Path(path)
    file = path / SUBMISSION
    fix = "ctgraph-rl submit RUNS --to DIR writes one"
    require((path.is_dir(), f"{path} must be the folder of a submission"))
    require((file.is_file(), f"{path} holds no submission, it lacks {SUBMISSION}: {fix}"))
    data = read_regular(file, MOST_BYTES)
    with named(file):
        content = json_value(data)
        _check_parts(content)
        runs = tuple(sorted(map(_run, content["runs"]), key=lambda run: run.seed))
        _check_runs(runs)
        method = {**content["method"], "failed": {run.seed: run.reason for run in runs if not run.finished}}
        check_method(method)
        curriculum = Curriculum.from_json(content["curriculum"])
    absent = [log_name(run.run) for run in runs if not (path / log_name(run.run)).is_file()]
    require((not absent, f"{path} lacks {', '.join(absent[:3])}, which {SUBMISSION} names"))
    if of_track is None and method["track"] is not None:
        of_track = track(method["track"], config_dir)
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


def _check_parts(content: Any) -> None:
    """Refuse what has other parts than a submission, or parts of other kinds."""
    is_object = isinstance(content, dict)
    require((is_object and {*content} == {*PARTS}, f"must be an object of {', '.join(PARTS)}, got {content!r:.80}"))
    config = content["config"]
    versions = content["versions"]
    runs = content["runs"]
    texts = isinstance(versions, dict) and {*map(type, versions.values())} <= {str}
    require(
        (
            is_int(content["schema"], SCHEMA, SCHEMA),
            f"has schema {content['schema']!r:.80}, this reads {SCHEMA}",
        ),
        (isinstance(content["method"], dict), f"method must be an object, got {content['method']!r:.80}"),
        (isinstance(config, dict) and is_shallow(config, MAX_NESTING), f"config must be settings, got {config!r:.80}"),
        (not isinstance(config, dict) or "seed" not in config, "config must leave out the seed, which the runs have"),
        (texts, f"versions must be texts by name, got {versions!r:.80}"),
        (isinstance(content["curriculum"], dict), "curriculum must be an object"),
        (
            isinstance(runs, list) and 0 < len(runs) <= MOST_RUNS,
            f"runs must be a list of 1..{MOST_RUNS:,}, got {runs!r:.80}",
        ),
    )


def _run(given: Any) -> SubmittedRun:
    """Return one of the runs."""
    require((isinstance(given, dict) and {*given} == {*RUN}, f"a run must have {', '.join(RUN)}, got {given!r:.80}"))
    name = given["run"]
    sums = given["experts"]
    rules = [(isinstance(name, str) and NAME.fullmatch(name) is not None, f"run must name a file, got {name!r:.80}")]
    for key in ("seed", "num_threads"):
        rules.append((is_int(given[key], 0), f"{key} of {name!r:.80} must be an integer >= 0, got {given[key]!r:.80}"))
    for key in ("machine", "cpu"):
        rules.append((isinstance(given[key], str), f"{key} of {name!r:.80} must be a text, got {given[key]!r:.80}"))
    rules += [
        (are_ints(given["group"], 0), f"group of {name!r:.80} must be a list of seeds, got {given['group']!r:.80}"),
        (_is_sum(given["log_sha256"]), f"log_sha256 of {name!r:.80} must be 64 hexadecimal digits"),
        (
            isinstance(sums, list) and all(map(_is_sum, sums)),
            f"experts of {name!r:.80} must be sums of 64 hexadecimal digits",
        ),
        (
            given["agent_sha256"] is None or _is_sum(given["agent_sha256"]),
            f"agent_sha256 of {name!r:.80} must be 64 hexadecimal digits or null",
        ),
        (
            given["agent_bytes"] is None or is_int(given["agent_bytes"], 0),
            f"agent_bytes of {name!r:.80} must be an integer >= 0 or null, got {given['agent_bytes']!r:.80}",
        ),
        (
            is_real(given["seconds"], 0, MOST_SECONDS),
            f"seconds of {name!r:.80} must be a number in 0..{MOST_SECONDS:,.0f}, got {given['seconds']!r:.80}",
        ),
        (
            given["reason"] is None or isinstance(given["reason"], str),
            f"reason of {name!r:.80} must be a text or null, got {given['reason']!r:.80}",
        ),
    ]
    require(*rules)
    return SubmittedRun(**{**given, "group": tuple(given["group"]), "experts": tuple(sums)})


def _is_sum(value: object) -> bool:
    return isinstance(value, str) and SUM.fullmatch(value) is not None


def _check_runs(runs: tuple[SubmittedRun, ...]) -> None:
    """Refuse a run or a seed that is there twice."""
    names = sorted(repeated(run.run.lower() for run in runs))
    seeds = sorted(repeated(str(run.seed) for run in runs))
    require(
        (not names, f"names a run twice: {', '.join(names[:3])}"),
        (not seeds, f"has a seed twice: {', '.join(seeds[:3])}"),
    )


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
    """Return where the log of a run is in a submission, or that of its expert of a task from 1."""
    return f"{LOGS}/{run}{'' if expert is None else f'.expert_{expert}'}.jsonl.gz"


def experts_of(log: RunLog) -> list[NamedValues]:
    """Return what a log says of single-task experts, in the order of tasks; empty without any."""
    said: list[NamedValues] = []
    for line in log.of_kind("experts"):
        said += line.get("experts", ())
    for each in said:
        numbered = isinstance(each, dict) and is_int(each.get("task"), 1)
        require((numbered, "the log names experts without the numbers of their tasks: restore it"))
    return said


def packed(content: bytes) -> bytes:
    """Return the content of a submitted log: equal bytes for equal logs."""
    return gzip.compress(content, mtime=0)


def read_log(path: Path) -> RunLog:
    """Read a log of a submission; no more of it is unpacked than a log may have.

    Raises:
        ValueError: if it is no log, or larger than a log may be.
        OSError: if it cannot be read.
    """
    with named(path):
        data = read_regular(path, MOST_BYTES_OF_A_LOG)
        try:
            content = gzip.GzipFile(fileobj=BytesIO(data)).read(MOST_BYTES_OF_A_LOG + 1)
        except (EOFError, OSError, zlib.error) as error:
            raise ValueError(f"is no file of gzip: {error}; restore it") from None
        require((len(content) <= MOST_BYTES_OF_A_LOG, f"holds more than {MOST_BYTES_OF_A_LOG:,} bytes, the limit"))
    return RunLog.of_content(content, path)


def log_sum(log: RunLog) -> str:
    """Return the SHA-256 of a log without times, versions and machine: equal for equal runs, bit for bit.

    It is over a line of JSON for each measurement, with sorted keys. Settings that were added after the run, with their
    value for "as before", do not count.
    """
    found = hashlib.sha256()
    for measurement in log.measurements:
        found.update(json.dumps(counted(measurement), sort_keys=True).encode() + b"\n")
    return found.hexdigest()


def counted(measurement: ReadOnlyValues) -> NamedValues:
    """Return what of a measurement counts in the sum of a log."""
    kept = without_time(measurement)
    if kept["kind"] != "run":
        return kept
    kept = {key: value for key, value in kept.items() if key not in NOT_COUNTED}
    return {**kept, "config": as_before(kept.get("config") or {})}
