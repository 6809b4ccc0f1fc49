"""RunLog: append measurements to ``run.jsonl``, read them back as matrices, curves and regimes.

Every line is one JSON object with a ``kind``. Schema 1:

- ``run``: the first line: ``schema``, curriculum, configuration, seed, versions; ``trained``, the task numbers of each
  block, such as ``[[1], [2]]``.
- ``training``: one interval of a block: ``block`` from 1, ``frames`` of the run so far, finished ``episodes`` and their
  ``return_mean``, ``success_rate`` and ``length_mean``; what the agent reports.
- ``evaluation``: means over the evaluation episodes of one task. ``moment`` says when: ``before`` any training (block
  0), ``during`` a block, or ``after`` it. ``task`` counts the curriculum's tasks from 1; held-out tasks, marked
  ``held_out``, count on from there.

What is not finite, such as a mean over no episodes, is null. ``seconds`` is the time since the start of the run, and
the only field that differs between two equal runs. A reader in three lines, for what `RunLog.read` does not give::

    import json
    with open("run.jsonl", encoding="utf-8") as file:
        measurements = [json.loads(line) for line in file]
"""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import torch
from torch import Tensor

from ctgraph_rl.checks import require
from ctgraph_rl.metrics import Curves, Regime

SCHEMA = 1
"""Raised when a line means something else than before; fields may be added without."""


class RunLog:
    """Measurements of one run, in memory and, with a path, in a file that is written line by line.

    Args:
        path: the file to append to; None keeps measurements in memory only.

    Raises:
        FileExistsError: if the file exists.
    """

    def __init__(self, path: Path | str | None = None) -> None:
        self.measurements: list[dict[str, Any]] = []
        self.torn_lines = 0
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
        """The log of a run directory's ``run.jsonl``, in memory.

        A last line that was torn when the run was killed is left out and counted in ``torn_lines``.

        Raises:
            ValueError: for any other line that is no measurement, and for a newer schema.
        """
        log = cls()
        lines = Path(path).read_bytes().splitlines()
        for number, line in enumerate(lines, 1):
            try:
                log.measurements.append(_measurement(line))
            except ValueError:
                require((number == len(lines), f"{path}: line {number} is no measurement; restore the file"))
                log.torn_lines = 1
        for run in log.of_kind("run"):
            newer = run.get("schema", SCHEMA) > SCHEMA
            require(
                (not newer, f"{path} has schema {run.get('schema')}, this version reads {SCHEMA}: update ctgraph_rl")
            )
        return log

    def of_kind(self, kind: str) -> list[dict[str, Any]]:
        """Measurements of one kind, in order."""
        return [measurement for measurement in self.measurements if measurement["kind"] == kind]

    def performance(self) -> Tensor:
        """The performance matrix so far: mean return, float64 [blocks evaluated, tasks]; NaN where not evaluated."""
        return _matrix(self._points(("block",), during=False).values())

    def curves(self, trained: Sequence[Sequence[int]] | None = None) -> Curves:
        """All evaluations of the curriculum's tasks in time order, those during blocks included.

        Args:
            trained: for each block, its tasks counted from 0; default: as the log says.
        """
        points = self._points(("block", "frames", "moment"), during=True)
        blocks, frames = zip(*((block, frames) for block, frames, _ in points), strict=True)
        return Curves(_matrix(points.values()), blocks, frames, self._trained(trained))

    def regimes(self, trained: Sequence[Sequence[int]] | None = None) -> list[Regime]:
        """The run as the lifelong metrics see it: a regime per training block and per evaluation at its boundaries.

        An experience is a training interval with finished episodes; evaluations during blocks are left out.

        Args:
            trained: for each block, its tasks counted from 0; default: as the log says.

        Raises:
            ValueError: for a block that trains several tasks, whose effects cannot be told apart.
        """
        tasks = [sorted(set(block)) for block in self._trained(trained)]
        mixed = [str(number) for number, block in enumerate(tasks, 1) if len(block) > 1]
        require(
            (not mixed, f"lifelong metrics need blocks that train one task, block {', '.join(mixed)} trains several")
        )
        labels = {m["task"]: m["label"] for m in self._evaluations(during=False)}
        regimes = []
        for block in range(len(tasks) + 1):
            if block:
                regimes.append(Regime(labels[tasks[block - 1][0] + 1], True, self._training_returns(block)))
            at_end = [m for m in self._evaluations(during=False) if m["block"] == block]
            regimes += [Regime(m["label"], False, _row([m["return_mean"]])) for m in at_end]
        return regimes

    def _trained(self, trained: Sequence[Sequence[int]] | None) -> tuple[tuple[int, ...], ...]:
        if trained is None:
            said = [run["trained"] for run in self.of_kind("run") if "trained" in run]
            require((bool(said), "this log does not say what each block trained: give trained, Curriculum.trained"))
            trained = [[number - 1 for number in block] for block in said[0]]
        return tuple(tuple(block) for block in trained)

    def _evaluations(self, during: bool) -> Iterator[dict[str, Any]]:
        """Evaluations of the curriculum's own tasks."""
        own = (m for m in self.of_kind("evaluation") if not m.get("held_out"))
        return (m for m in own if during or m.get("moment") != "during")

    def _points(self, key: tuple[str, ...], during: bool) -> dict[tuple[Any, ...], dict[int, float]]:
        """Mean returns by task, for each point in time."""
        points: dict[tuple[Any, ...], dict[int, float]] = {}
        for m in self._evaluations(during):
            points.setdefault(tuple(m.get(name) for name in key), {})[m["task"]] = m["return_mean"]
        return points

    def _training_returns(self, block: int) -> Tensor:
        means = [m["return_mean"] for m in self.of_kind("training") if m["block"] == block]
        return _row([mean for mean in means if mean is not None])


def _measurement(line: bytes) -> dict[str, Any]:
    measurement = json.loads(line)
    if not (isinstance(measurement, dict) and "kind" in measurement):
        raise ValueError(f"a measurement is an object with a kind, got {line!r}")
    return measurement


def _matrix(rows: Iterable[Mapping[int, float | None]]) -> Tensor:
    """Rows of values by task number, NaN where a row has none."""
    rows = list(rows)
    tasks = range(1, max((task for row in rows for task in row), default=0) + 1)
    return torch.stack([_row([row.get(task) for task in tasks]) for row in rows]) if rows else _row([])


def _row(values: Sequence[float | None]) -> Tensor:
    return torch.tensor([math.nan if value is None else value for value in values], dtype=torch.float64)


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_performance(path: Path | str, log: RunLog, labels: Iterable[str]) -> None:
    """Write the performance matrix as CSV: one line per block, block 0 before any training.

    Args:
        path: file to write.
        log: the run's log.
        labels: a name per task, the last columns.
    """
    frames = {m["block"]: m["frames"] for m in log.of_kind("evaluation") if m.get("moment") != "during"}
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["block", "frames", *labels])
        for block, row in enumerate(log.performance().tolist()):
            writer.writerow([block, frames[block], *row])


def write_metrics(path: Path | str, metrics: Mapping[str, Any]) -> None:
    """Write metrics as JSON: for each name the value, its definition, formula and source, or why it is undefined."""
    content = {name: vars(metric) for name, metric in metrics.items()}
    Path(path).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
