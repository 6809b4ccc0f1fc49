"""What a finished run wrote: ``sums.json`` holds length and SHA-256 of each file, so that a damaged run is noticed.

It is written after all other results and right before ``metrics.json``, which it covers, too. Its ``run`` differs
each time that results are written. `ctgraph_rl.log.damage` compares the files with it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from ctgraph_rl.disk import read_regular, write_whole
from ctgraph_rl.log.files import AGENT, CURRICULUM, LOG, METRICS
from ctgraph_rl.strict import json_value

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
    files = {}
    for name in RESULTS:
        if name not in (SUMS, METRICS) and (run_dir / name).exists():
            files[name] = sum_of((run_dir / name).read_bytes())
    files[METRICS] = sum_of(metrics)
    write_whole(run_dir / SUMS, (json.dumps({"run": uuid4().hex, "files": files}, indent=2) + "\n").encode())


def is_complete(run_dir: Path) -> bool:
    """Return whether a run says that it is complete and its files have the lengths that were written.

    Without sums, files must not be empty. No file but the sums is read, as a sweep asks this of every cell.
    """
    sizes = {}
    for name in RESULTS:
        if (run_dir / name).exists():
            sizes[name] = (run_dir / name).stat().st_size
    if METRICS not in sizes or SUMS not in sizes:
        return METRICS in sizes and all(sizes.values())
    sums = stored_sums(run_dir)
    return bool(sums) and all(sizes.get(name) == sums[name].get("bytes") for name in sums)


def stored_sums(run_dir: Path) -> Mapping[str, Mapping[str, Any]]:
    """Return the stored sum of each file, none where they cannot be read."""
    try:
        files = json_value(read_regular(run_dir / SUMS, MOST_BYTES_OF_SUMS))["files"]
        ours = METRICS in files and all(name in RESULTS and isinstance(files[name], dict) for name in files)
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return files if ours else {}


def sum_of(content: bytes) -> dict[str, Any]:
    """Return length and SHA-256 of the content of a file."""
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
