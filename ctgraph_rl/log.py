"""RunLog: append measurements to ``run.jsonl``, read them back as the performance matrix.

Every line is one JSON object with a ``kind``:

- ``run``: the first line: schema, curriculum, seed, versions.
- ``training``: one batch of a block: frames so far, finished episodes and their means, what the agent reports.
- ``evaluation``: one task after a block (0 = before any training): means over the evaluation episodes.

``seconds`` is the time since the start of the run, and the only field that differs between two equal runs.
"""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TextIO

import torch
from torch import Tensor

SCHEMA = 1


class RunLog:
    """Measurements of one run, in memory and, with a path, in a file that is written line by line.

    Args:
        path: the file to append to; None keeps measurements in memory only.

    Raises:
        FileExistsError: if the file exists.
    """

    def __init__(self, path: Path | str | None = None) -> None:
        self.measurements: list[dict[str, Any]] = []
        self._start = time.perf_counter()
        self._file: TextIO | None = None
        if path is not None:
            self._file = Path(path).open("x", buffering=1, encoding="utf-8")  # noqa: SIM115, open until `close`

    def append(self, kind: str, **values: Any) -> None:
        """Add one measurement; NaN and infinity become null, as JSON has neither."""
        finite = {name: _finite(value) for name, value in values.items()}
        measurement = {"kind": kind, **finite, "seconds": round(time.perf_counter() - self._start, 3)}
        self.measurements.append(measurement)
        if self._file is not None:
            self._file.write(json.dumps(measurement) + "\n")

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    @classmethod
    def read(cls, path: Path | str) -> RunLog:
        """The log of a run directory's ``run.jsonl``, in memory."""
        log = cls()
        log.measurements = [json.loads(line) for line in Path(path).read_text(encoding="utf-8").splitlines()]
        return log

    def of_kind(self, kind: str) -> list[dict[str, Any]]:
        """Measurements of one kind, in order."""
        return [measurement for measurement in self.measurements if measurement["kind"] == kind]

    def performance(self) -> Tensor:
        """The performance matrix so far: mean return, float64 [blocks evaluated, tasks]."""
        rows: dict[int, list[float]] = {}
        for measurement in self.of_kind("evaluation"):
            rows.setdefault(measurement["block"], []).append(measurement["return_mean"])
        return torch.tensor([rows[block] for block in sorted(rows)], dtype=torch.float64)


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_performance(path: Path | str, log: RunLog, labels: Iterable[str]) -> None:
    """Write the performance matrix as CSV: one line per block, block 0 before any training.

    Args:
        path: file to write.
        log: the run's log.
        labels: a name per task, the last columns.
    """
    frames = {measurement["block"]: measurement["frames"] for measurement in log.of_kind("evaluation")}
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["block", "frames", *labels])
        for block, row in enumerate(log.performance().tolist()):
            writer.writerow([block, frames[block], *row])


def write_metrics(path: Path | str, metrics: Mapping[str, Any]) -> None:
    """Write metrics as JSON: for each name the value, its definition, formula and source."""
    content = {name: vars(metric) for name, metric in metrics.items()}
    Path(path).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
