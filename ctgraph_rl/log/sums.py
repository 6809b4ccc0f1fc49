"""Length and SHA-256 of each file of a finished run, in its ``metrics.json``, so that damage is noticed.

``files`` there has them; of ``metrics.json`` they are those of the metrics alone. ``run`` differs each time.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, is_real, require
from ctgraph_rl.disk import read_regular, write_whole
from ctgraph_rl.log.files import AGENT, CURRICULUM, LOG, METRICS, MOST_BYTES_OF_METRICS
from ctgraph_rl.log.measurement import LARGEST
from ctgraph_rl.strict import json_value, sha256_of

FILES = "files"

MOST_BYTES_OF_A_FILE = 2**33

RESULTS = (LOG, CURRICULUM, AGENT, METRICS)
"""Files of a run, in the order of writing; ``curriculum.json`` only for parts of this package's classes."""


def write_metrics(path: Path, metrics: ReadOnlyValues, of_windows: Collection[str] = ()) -> None:
    """Write metrics as JSON, one a line: by name the value, definition, formula and source, or why it is undefined.

    Terms are left out, as pairs of tasks grow with the square of tasks; `ctgraph_rl.log.scores.scores` has them. The
    sums of the files beside it are written, too.

    Args:
        of_windows: metrics whose terms are few, and kept as ``windows``.
    """
    content = {}
    for name, metric in metrics.items():
        values = {**vars(metric), "n_seeds": 1, "interval": None}
        terms = values.pop("terms")
        content[name] = {**values, "windows": terms} if name in of_windows else values
    files = {"run": uuid4().hex, **sums_of(path.parent), METRICS: _sum_of_metrics(content)}
    lines = [f"{json.dumps(name)}: {json.dumps(value)}" for name, value in {FILES: files, **content}.items()]
    write_whole(path, "{\n" + ",\n".join(lines) + "\n}\n")


def _sum_of_metrics(content: ReadOnlyValues) -> NamedValues:
    return sum_of(json.dumps(content).encode())


def sums_of(run_dir: Path) -> NamedValues:
    """Return the sums of a run's files other than its metrics."""
    found = {}
    for name in RESULTS:
        if name != METRICS and (run_dir / name).exists():
            found[name] = sum_of((run_dir / name).read_bytes())
    return found


def is_complete(run_dir: Path) -> bool:
    """Return whether a run says that it is complete and its files have their lengths.

    Only the metrics are read, as a sweep asks this of every cell.
    """
    try:
        sums = stored_sums(run_dir)
        return all((run_dir / name).stat().st_size == stored["bytes"] for name, stored in sums.items())
    except (OSError, ValueError):
        return False


def stored_sums(run_dir: Path) -> Mapping[str, Mapping[str, Any]]:
    """Return the stored sums of all files but the metrics, which are compared.

    Raises:
        OSError: without metrics.
        ValueError: if they are not what was written.
    """
    content = json_value(read_regular(run_dir / METRICS, MOST_BYTES_OF_METRICS))
    try:
        files = content.pop(FILES)
        own = files.pop(METRICS)
        del files["run"]
        are_sums = all(name in RESULTS and {"bytes", "sha256"} <= files[name].keys() for name in files)
    except (AttributeError, KeyError, TypeError):
        are_sums = False
    require((are_sums and own == _sum_of_metrics(content), "it is not what was written"))
    return files


def sum_of(content: bytes) -> dict[str, Any]:
    """Return a content's length and SHA-256."""
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


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
    """Return what `write_metrics` wrote, as plain values by name.

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
