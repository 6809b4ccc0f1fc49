"""Finds the files of a finished run that are not as they were written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ctgraph_rl.checks import NamedValues, is_real, require
from ctgraph_rl.log.files import METRICS
from ctgraph_rl.log.measurement import LARGEST
from ctgraph_rl.log.sums import FILES, stored_sums
from ctgraph_rl.strict import json_value, sha256_of

MOST_BYTES_OF_A_FILE = 2**33


def damaged(run_dir: Path) -> list[str]:
    """Return the files of a complete run that are not as they were written; reads all of them."""
    try:
        sums = stored_sums(run_dir)
    except (OSError, ValueError):
        return [METRICS]
    found = []
    for name, stored in sums.items():
        path = run_dir / name
        there = path.is_file() and path.stat().st_size == stored["bytes"]
        if not there or sha256_of(path, MOST_BYTES_OF_A_FILE) != stored["sha256"]:
            found.append(name)
    return found


def metrics_of(content: bytes) -> NamedValues:
    """Return what `ctgraph_rl.log.sums.write_metrics` wrote, as plain values by name.

    Raises:
        ValueError: for anything else.
    """
    found = json_value(content)
    metrics = {name: found[name] for name in found if name != FILES} if isinstance(found, dict) else {}
    ours = bool(metrics) and all(map(_is_metric, metrics.values()))
    require((ours, "it does not hold metrics of ours"))
    return metrics


def _is_metric(metric: Any) -> bool:
    if not (isinstance(metric, dict) and {"value", "definition", "undefined"} <= metric.keys()):
        return False
    values = [metric["value"]]
    if isinstance(metric.get("windows"), list):
        values += metric["windows"]
    number = all(value is None or is_real(value, -LARGEST, LARGEST) for value in values)
    return number and isinstance(metric["definition"], str) and isinstance(metric["undefined"], str | None)
