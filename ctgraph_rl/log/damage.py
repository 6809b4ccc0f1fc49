"""Finds the files of a finished run that are not as they were written.

Runs of earlier versions have no `ctgraph_rl.log.sums.SUMS`: of theirs it is checked that the files can be read.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ctgraph_rl.log.files import AGENT, CURRICULUM, LOG, METRICS
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.sums import SUMS, TABLES, stored_sums, sum_of


def damaged(run_dir: Path) -> list[str]:
    """Return the files of a run that says that it is complete which are not as they were written; reads all of them."""
    if not (run_dir / SUMS).exists():
        return [name for name, check in _CHECKS.items() if not _is_readable(run_dir / name, check)]
    sums = stored_sums(run_dir)
    return [SUMS] if not sums else [name for name in sums if not _is_same(run_dir / name, sums[name])]


def _is_same(path: Path, stored: Mapping[str, Any]) -> bool:
    there = path.is_file() and path.stat().st_size == stored.get("bytes")
    return there and sum_of(path.read_bytes()) == stored


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
