"""Length and SHA-256 of each file of a finished run, in ``sums.json``, so that damage is noticed.

It is written after all other results, right before ``metrics.json``, which it covers, too. ``run`` differs each time.
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

MOST_BYTES_OF_SUMS = 2**16

TABLES = ("evaluations.csv", "training.csv", "performance.csv")

RESULTS = (LOG, CURRICULUM, AGENT, *TABLES, SUMS, METRICS)
"""Files of a run, in the order of writing; ``curriculum.json`` only for parts of this package's classes."""


def write_sums(run_dir: Path, metrics: bytes) -> None:
    """Write the sums of a directory's results and of the metrics to come."""
    files = {}
    for name in RESULTS:
        if name not in (SUMS, METRICS) and (run_dir / name).exists():
            files[name] = sum_of((run_dir / name).read_bytes())
    files[METRICS] = sum_of(metrics)
    write_whole(run_dir / SUMS, (json.dumps({"run": uuid4().hex, "files": files}, indent=2) + "\n").encode())


def is_complete(run_dir: Path) -> bool:
    """Return whether a run says that it is complete and its files have their lengths.

    Without sums, files must not be empty. Only the sums are read, as a sweep asks this of every cell.
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
    """Return the stored sums by file, none if unreadable."""
    try:
        files = json_value(read_regular(run_dir / SUMS, MOST_BYTES_OF_SUMS))["files"]
        ours = METRICS in files and all(name in RESULTS and isinstance(files[name], dict) for name in files)
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return files if ours else {}


def sum_of(content: bytes) -> dict[str, Any]:
    """Return a content's length and SHA-256."""
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
