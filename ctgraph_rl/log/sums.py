"""What a finished run wrote: ``sums.json`` holds length and SHA-256 of each file, so that a damaged run is noticed.

It is written after all other results and right before ``metrics.json``, which it covers, too. Its ``run`` differs
each time that results are written. Runs of earlier versions have no such file: of theirs it is checked that the files
can be read.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from ctgraph_rl.disk import read_regular, write_whole
from ctgraph_rl.log.files import AGENT, CURRICULUM, LOG, METRICS
from ctgraph_rl.log.run_log import RunLog

SUMS = "sums.json"
"""The file with the sums."""

MOST_BYTES_OF_SUMS = 2**16
"""Largest `SUMS` that is read."""

TABLES = ("evaluations.csv", "training.csv", "performance.csv")

RESULTS = (LOG, CURRICULUM, AGENT, *TABLES, SUMS, METRICS)
"""Files that a run writes into its directory, in this order; ``metrics.json`` is there when the run is complete,
``curriculum.json`` where the curriculum has only parts of this package's classes."""


def write_sums(run_dir: Path, metrics: bytes) -> None:
    """Write the sums of the results in a directory, and of the metrics that are about to be written."""
    there = [name for name in RESULTS if name not in (SUMS, METRICS) and (run_dir / name).exists()]
    files = {**{name: _sum((run_dir / name).read_bytes()) for name in there}, METRICS: _sum(metrics)}
    write_whole(run_dir / SUMS, (json.dumps({"run": uuid4().hex, "files": files}, indent=2) + "\n").encode())


def damaged(run_dir: Path) -> list[str]:
    """Return the files of a run that says that it is complete which are not as they were written; reads all of them."""
    if not (run_dir / SUMS).exists():
        return [name for name, check in _CHECKS.items() if not _is_readable(run_dir / name, check)]
    sums = _stored(run_dir)
    return [SUMS] if not sums else [name for name in sums if not _is_same(run_dir / name, sums[name])]


def is_complete(run_dir: Path) -> bool:
    """Return whether a run says that it is complete and its files have the lengths that were written.

    Without sums, files must not be empty. No file but the sums is read, as a sweep asks this of every cell.
    """
    sizes = {name: path.stat().st_size for name in RESULTS if (path := run_dir / name).exists()}
    if METRICS not in sizes or SUMS not in sizes:
        return METRICS in sizes and all(sizes.values())
    sums = _stored(run_dir)
    return bool(sums) and all(sizes.get(name) == sums[name].get("bytes") for name in sums)


def _stored(run_dir: Path) -> Mapping[str, Mapping[str, Any]]:
    """Return the stored sum of each file, none where they cannot be read."""
    try:
        files = json.loads(read_regular(run_dir / SUMS, MOST_BYTES_OF_SUMS))["files"]
        ours = METRICS in files and all(name in RESULTS and isinstance(files[name], dict) for name in files)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}
    return files if ours else {}


def _sum(content: bytes) -> dict[str, Any]:
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _is_same(path: Path, stored: Mapping[str, Any]) -> bool:
    there = path.is_file() and path.stat().st_size == stored.get("bytes")
    return there and _sum(path.read_bytes()) == stored


def _is_log(path: Path) -> bool:
    """Return whether it is the log of a run, to its end."""
    log = RunLog.read(path)
    return bool(log.of_kind("run")) and not log.torn_lines


def _is_json(path: Path) -> bool:
    return isinstance(json.loads(path.read_bytes()), dict)


def _ends_with_a_line(path: Path) -> bool:
    return path.read_bytes().endswith(b"\n")


_CHECKS: dict[str, Callable[[Path], bool]] = {
    **{LOG: _is_log, CURRICULUM: _is_json, AGENT: zipfile.is_zipfile, METRICS: _is_json},
    **dict.fromkeys(TABLES, _ends_with_a_line),
}


def _is_readable(path: Path, check: Callable[[Path], bool]) -> bool:
    """Return whether a file passes a check; all but the log may be missing, as others than a run of ours write none."""
    try:
        return path.is_file() and check(path) if path.exists() or path.name == LOG else True
    except (OSError, ValueError, RecursionError):
        return False
