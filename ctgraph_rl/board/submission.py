"""A submission: a folder of files with which you can check what a method reached.

- ``method.yaml``: about the method, see `ctgraph_rl.board.method_yaml`.
- ``config.yaml``: the configuration that all runs share, without the seed; ``versions.txt``: the versions that computed
  them, and the kind of machine that computed the metrics; ``curriculum.json``: what they learned.
- ``runs.csv``: a line for each seed, with the columns `COLUMNS`.
- ``logs/RUN.jsonl.gz``: the log of each run; ``logs/RUN.expert_K.jsonl.gz``: of its single-task expert of task K.
- ``evaluations.parquet`` and ``metrics.csv``: what the logs give.
- ``verification.json``: what a verification found; not part of what was submitted.

No code of the folder is ever run when it is read.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ctgraph_rl.board.method_yaml import read_method
from ctgraph_rl.board.tracks import Track, track
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, is_int, is_shallow, repeated, require
from ctgraph_rl.disk import read_regular
from ctgraph_rl.log.escape import csv_text, from_csv
from ctgraph_rl.log.files import CURRICULUM
from ctgraph_rl.log.measurement import without_time
from ctgraph_rl.log.run_log import MOST_BYTES, RunLog
from ctgraph_rl.runs.settings import as_before
from ctgraph_rl.strict import MAX_DEPTH, csv_rows, files_below, named, sha256_of, unpacked, yaml_value
from ctgraph_rl.tasks.curriculum import Curriculum

METHOD = "method.yaml"
CONFIG = "config.yaml"
VERSIONS = "versions.txt"
RUNS = "runs.csv"
LOGS = "logs"
EVALUATIONS = "evaluations.parquet"
METRICS = "metrics.csv"

FILES = (METHOD, CONFIG, VERSIONS, CURRICULUM, RUNS, EVALUATIONS, METRICS)
"""Files of a submission beside its logs."""

VERIFICATION = "verification.json"
"""The file that a verification writes."""

MOST_BYTES_OF_A_FILE, MOST_BYTES_OF_A_TABLE = 2**28, 2**26
"""Largest file but the logs that is read, 256 MiB, and largest CSV file."""

MOST_BYTES_OF_A_CONFIGURATION = 2**18
MAX_NESTING = 16

MOST_RUNS, MOST_METRICS, MOST_SECONDS = 10_000, 1_000, 1e9
"""Of a submission, of a run in ``metrics.csv``, and of a run."""

MACHINE = "machine"

NO_PACKAGES = ("python", MACHINE)
"""Names in ``versions.txt`` that pip does not know."""

FINISHED = "finished"
FAILED = "failed"

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.=-]{0,119}")
"""Names of runs, which are names of files."""

SUM = re.compile(r"[0-9a-f]{64}")
WHOLE = re.compile(r"[0-9]{1,19}")

NOT_COUNTED = ("versions", "machine", "num_threads", "cpu", "source")
"""Fields of a log's first line that its sum leaves out; the fingerprint stands for what the source describes."""

COLUMNS = {
    "run": "name of the run, and of its log in `logs/`",
    "seed": "its seed",
    "curriculum": "name of the curriculum",
    "fingerprint": "what the curriculum is, in 16 digits",
    "state": "`finished`, or `failed` for a run that failed or was stopped and that `method.yaml` accounts for",
    "reason": "why it failed; empty for a finished run",
    "group": "seeds that were trained together as one batch, separated by spaces; empty for a run without others",
    "agent_sha256": "SHA-256 of the agent's state: names, types, shapes and bits; empty where a run left none",
    "agent_bytes": "bytes of all tensors of that state",
    "log_sha256": "SHA-256 of the log without times, versions and machine",
    "machine": "kind of machine that it ran on",
    "num_threads": "threads of torch",
    "cpu": "model of the CPU; empty where the system does not say",
    "seconds": "time of the run; runs of one group share it",
}
"""Columns of ``runs.csv`` with their meaning."""

METRIC_COLUMNS = {
    "run": "name of the run",
    "seed": "its seed",
    "metric": "name of the metric",
    "value": "its value, with all digits; empty where it is undefined",
    "definition": "id of the definition",
    "undefined": "why it has no value",
}
"""Columns of ``metrics.csv`` with their meaning."""


@dataclass(frozen=True)
class SubmittedRun:
    """A line of ``runs.csv``; see `COLUMNS`."""

    run: str
    seed: int
    curriculum: str
    fingerprint: str
    state: str
    reason: str
    group: tuple[int, ...]
    agent_sha256: str
    agent_bytes: int | None
    log_sha256: str
    machine: str
    num_threads: int
    cpu: str
    seconds: float

    @property
    def finished(self) -> bool:
        """Whether it has results."""
        return self.state == FINISHED

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of its group; its own for a run without others."""
        return self.group or (self.seed,)

    @property
    def cells(self) -> list[Any]:
        """The cells of its line."""
        return list({**vars(self), "group": " ".join(map(str, self.group))}.values())


@dataclass(frozen=True)
class Submission:
    """A submission as data.

    Args:
        path: its folder.
        method: what ``method.yaml`` says.
        config: the configuration of all runs, without the seed.
        versions: of what computed them, by the names of packages.
        scored_on: the kind of machine that computed ``metrics.csv``.
        curriculum: what they learned.
        runs: a line for each seed, sorted by it.
        track: the track that it is for; None: it is for none.
    """

    path: Path
    method: ReadOnlyValues
    config: ReadOnlyValues
    versions: Mapping[str, str]
    scored_on: str
    curriculum: Curriculum
    runs: tuple[SubmittedRun, ...]
    track: Track | None

    @property
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

    def experts(self, run: SubmittedRun) -> list[RunLog] | None:
        """Return the logs of the single-task experts of a run; None if it was trained without.

        Raises:
            ValueError: see `log`.
            OSError: if one of them cannot be read.
        """
        found = []
        for each in experts_of(self.log(run)):
            found.append(read_log(self.path / log_name(run.run, each["task"])))
        return found or None

    @cached_property
    def metrics(self) -> dict[str, dict[str, dict[str, str]]]:
        """Cells of ``metrics.csv`` by run and metric; see `METRIC_COLUMNS`."""
        found: dict[str, dict[str, dict[str, str]]] = {}
        for row in _rows(self.path / METRICS, METRIC_COLUMNS, ["run", "metric"], MOST_METRICS * len(self.runs)):
            found.setdefault(row["run"], {})[row["metric"]] = row
        return found

    @cached_property
    def digest(self) -> str:
        """SHA-256 over the sums of all files but verifications and hidden ones, in the order of their names."""
        names = []
        for file in _files(self.path):
            name = file.relative_to(self.path).as_posix()
            if "/." not in f"/{name}" and name != VERIFICATION:
                names.append(name)
        found = hashlib.sha256()
        for name in sorted(names):
            found.update(f"{name} {sha256_of(self.path / name, MOST_BYTES)}\n".encode())
        return found.hexdigest()


def read_submission(path: Path | str, of_track: Track | None = None, config_dir: Path | None = None) -> Submission:
    """Read a submission and check its form; `ctgraph_rl.board.rescore` checks what it says.

    Args:
        path: its folder.
        of_track: the track, in place of the one that ``method.yaml`` names.
        config_dir: where a track of the user's own is, as ``track/NAME.yaml``.

    Raises:
        ValueError: for what is no submission; names what is missing or wrong.
        OSError: if a file cannot be read.
    """
    path = Path(path)
    require((path.is_dir(), f"{path} must be the folder of a submission"))
    odd = [name for name in map(str, _files(path)) if name != name.encode("utf-8", "replace").decode()]
    missing = [name for name in (*FILES, LOGS) if not (path / name).exists()]
    require(
        (not odd, f"{path} has names that are not UTF-8, {', '.join(map(ascii, odd[:3]))}: give them others"),
        (not missing, f"{path} lacks {', '.join(missing)}: ctgraph-rl submit RUNS --to DIR writes all of them"),
    )
    method = read_method(path / METHOD)
    runs = read_runs(path / RUNS)
    absent = [log_name(run.run) for run in runs if not (path / log_name(run.run)).is_file()]
    require((not absent, f"{path} lacks {', '.join(absent[:3])}, which {RUNS} names"))
    if of_track is None and method["track"] is not None:
        of_track = track(method["track"], config_dir)
    versions = _versions(path / VERSIONS)
    return Submission(
        path=path,
        method=method,
        config=_config(path / CONFIG),
        scored_on=versions.pop(MACHINE),
        versions=versions,
        curriculum=Curriculum.from_json(path / CURRICULUM),
        runs=runs,
        track=of_track,
    )


def read_runs(path: Path) -> tuple[SubmittedRun, ...]:
    """Read ``runs.csv``.

    Raises:
        ValueError: for other columns, cells out of range, and a run or seed that is there twice.
        OSError: if it cannot be read.
    """
    rows = _rows(path, COLUMNS, ["run"], MOST_RUNS)
    runs = [_run(row, f"{path}: line {number}") for number, row in enumerate(rows, 2)]
    names = sorted(repeated(run.run.lower() for run in runs))
    seeds = sorted(repeated(str(run.seed) for run in runs))
    require(
        (len(rows) > 0, f"{path} must have 1..{MOST_RUNS:,} runs, got none"),
        (not names, f"{path} names a run twice: {', '.join(names[:3])}"),
        (not seeds, f"{path} has a seed twice: {', '.join(seeds[:3])}"),
    )
    return tuple(sorted(runs, key=lambda run: run.seed))


def _run(row: Mapping[str, str], place: str) -> SubmittedRun:
    """Return a line of ``runs.csv``."""
    group = row["group"].split(" ") if row["group"] else []
    is_time = re.fullmatch(r"[0-9]+(\.[0-9]+)?", row["seconds"]) is not None and float(row["seconds"]) <= MOST_SECONDS
    rules = [
        (NAME.fullmatch(row["run"]) is not None, f"{place}: run must be a name of a file, got {row['run']!r:.80}"),
        (
            row["state"] in (FINISHED, FAILED),
            f"{place}: state must be {FINISHED} or {FAILED}, got {row['state']!r:.80}",
        ),
    ]
    whole = [("seed", row["seed"]), ("num_threads", row["num_threads"]), *((f"group {each}", each) for each in group)]
    for key, value in (*whole, ("agent_bytes", row["agent_bytes"] or "0")):
        rules.append((WHOLE.fullmatch(value) is not None, f"{place}: {key} must be an integer >= 0, got {value!r:.80}"))
    for key in ("log_sha256", "agent_sha256"):
        value = row[key]
        is_sum = SUM.fullmatch(value) is not None or (key == "agent_sha256" and not value)
        rules.append((is_sum, f"{place}: {key} must be 64 hexadecimal digits, got {value!r:.80}"))
    require(
        *rules,
        (is_time, f"{place}: seconds must be a number in 0..{MOST_SECONDS:,.0f}, got {row['seconds']!r:.80}"),
    )
    values: NamedValues = {**row, "seed": int(row["seed"]), "num_threads": int(row["num_threads"])}
    values["agent_bytes"] = int(row["agent_bytes"]) if row["agent_bytes"] else None
    values["group"] = tuple(map(int, group))
    values["seconds"] = float(row["seconds"])
    return SubmittedRun(**values)


def _rows(path: Path, columns: Mapping[str, str], key: Sequence[str], most: int) -> list[dict[str, str]]:
    """Return the rows of a CSV file with exactly these columns, of which some are a key."""
    with named(path):
        return csv_rows(read_regular(path, MOST_BYTES_OF_A_TABLE), list(columns), key, most, from_csv)


def _config(path: Path) -> NamedValues:
    """Return the configuration of all runs."""
    with named(path):
        config = yaml_value(read_regular(path, MOST_BYTES_OF_A_CONFIGURATION))
    plain = isinstance(config, dict) and is_shallow(config, MAX_NESTING)
    require((plain, f"{path} must hold settings by name, got {config!r:.80}"))
    require(("seed" not in config, f"{path} must leave out the seed, which {RUNS} lists"))
    return config


def _versions(path: Path) -> dict[str, str]:
    """Return what ``versions.txt`` says, by names."""
    with named(path):
        text = read_regular(path, MOST_BYTES_OF_A_CONFIGURATION).decode("utf-8")
    lines = text.replace("\r\n", "\n").removesuffix("\n").split("\n")  # no other letter ends a line, as for pip
    pairs = {}
    wrong = []
    for line in lines:
        name, _, version = line.removeprefix("# ").partition("==")
        pairs[name] = version
        wrong += [] if version else [name]
    require(
        (len(pairs) == len(lines), f"{path} has a name twice: leave one out"),
        (not wrong, f"{path} must have lines such as torch==2.9.0, got {wrong[:1]!r:.80}"),
        (MACHINE in pairs, f"{path} must have a line # {MACHINE}==KIND, of the machine that computed {METRICS}"),
    )
    return pairs


def versions_text(versions: Mapping[str, str], machine: str) -> str:
    """Return the content of ``versions.txt``, which pip reads as constraints; what is no package is a comment."""
    text = ""
    for name, value in sorted({**versions, MACHINE: machine}.items()):
        text += f"{'# ' * (name in NO_PACKAGES)}{name}=={value}\n"
    return text


def runs_text(runs: Sequence[SubmittedRun]) -> str:
    """Return the content of ``runs.csv``."""
    return csv_text([list(COLUMNS), *(run.cells for run in runs)])


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
        content = unpacked(read_regular(path, MOST_BYTES), MOST_BYTES)
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


def _files(path: Path) -> list[Path]:
    """Return all files of a submission.

    Raises:
        ValueError: for links, what is no file, too large ones, and folders within too many others.
    """
    files, deep = files_below(path)
    links = [str(each.relative_to(path)) for each in files if each.is_symlink()]
    large = [str(each.relative_to(path)) for each in files if each.name and each.lstat().st_size > MOST_BYTES]
    require(
        (not deep, f"{path} has folders within more than {MAX_DEPTH} others: remove them"),
        (not links, f"{path} has links, {', '.join(links[:3])}: put the files in their place"),
        (not large, f"{path} has files of more than {MOST_BYTES:,} bytes, {', '.join(large[:3])}: remove them"),
    )
    return files
