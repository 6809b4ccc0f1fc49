"""Finds the files of a finished run that are not as they were written.

Runs of earlier versions have no `ctgraph_rl.log.sums.SUMS`; their files must only be readable.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, is_real, require
from ctgraph_rl.disk import read_regular
from ctgraph_rl.log.files import AGENT, CURRICULUM, LOG, METRICS
from ctgraph_rl.log.measurement import LARGEST
from ctgraph_rl.log.run_log import MOST_BYTES, RunLog
from ctgraph_rl.log.sums import SUMS, TABLES, stored_sums
from ctgraph_rl.strict import json_value, sha256_of

MOST_BYTES_OF_A_FILE = 2**33
"""Largest file whose sum is computed: 8 GiB."""


def damaged(run_dir: Path) -> list[str]:
    """Return the files of a complete run that are not as they were written; reads all of them."""
    if not (run_dir / SUMS).exists():
        return [name for name, check in _CHECKS.items() if not _is_readable(run_dir / name, check)]
    sums = stored_sums(run_dir)
    return [SUMS] if not sums else [name for name in sums if not _is_same(run_dir / name, sums[name])]


def _is_same(path: Path, stored: ReadOnlyValues) -> bool:
    there = path.is_file() and path.stat().st_size == stored.get("bytes")
    return there and sha256_of(path, MOST_BYTES_OF_A_FILE) == stored.get("sha256")


def _is_log(path: Path) -> bool:
    log = RunLog.read(path)
    return bool(log.of_kind("run")) and not log.torn_lines


def _is_json(path: Path) -> bool:
    return isinstance(json_value(read_regular(path, MOST_BYTES)), dict)


def _ends_with_a_line(path: Path) -> bool:
    return read_regular(path, MOST_BYTES).endswith(b"\n")


_CHECKS: dict[str, Callable[[Path], bool]] = {
    **{LOG: _is_log, CURRICULUM: _is_json, AGENT: zipfile.is_zipfile, METRICS: _is_json},
    **dict.fromkeys(TABLES, _ends_with_a_line),
}


def _is_readable(path: Path, check: Callable[[Path], bool]) -> bool:
    """Return whether a file passes a check; all but the log may be missing."""
    try:
        return path.is_file() and check(path) if path.exists() or path.name == LOG else True
    except (OSError, ValueError, RecursionError):
        return False


def metrics_of(content: bytes) -> NamedValues:
    """Return the content of `metrics_text` as plain values by name.

    Raises:
        ValueError: for anything else.
    """
    found = json_value(content)
    ours = isinstance(found, dict) and bool(found) and all(map(_is_metric, found.values()))
    require((ours, "it does not hold metrics of ours"))
    return found


def _is_metric(metric: Any) -> bool:
    if not (isinstance(metric, dict) and {"value", "definition", "undefined"} <= metric.keys()):
        return False
    number = metric["value"] is None or is_real(metric["value"], -LARGEST, LARGEST)
    return number and isinstance(metric["definition"], str) and isinstance(metric["undefined"], str | None)
