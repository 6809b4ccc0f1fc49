"""RunLog: append measurements to ``run.jsonl``, read them back as matrices, curves and regimes.

Every line is one JSON object with a ``kind``. Schema 1:

- ``run``: the first line: ``schema``, curriculum, configuration, seed, versions; ``trained``, the task numbers of each
  block, such as ``[[1], [2]]``.
- ``training``: one interval of a block: ``block`` from 1, ``frames`` of the run so far, finished ``episodes`` and their
  ``return_mean``, ``success_rate``, ``end_rate`` (the share that reached an end state) and ``length_mean``; what the
  agent reports. A batch over a hidden boundary has a line per block; an episode counts where it ends.
- ``evaluation``: means over the episodes of one task. ``moment`` is ``before`` any training (block 0), ``during`` a
  block, or ``after`` it. ``task`` counts the curriculum's tasks from 1, then those ``held_out``.
- ``adaptation``: as ``evaluation``, means over the rows' episodes number ``step``, from 1; ``found_rate``, the share of
  rows that have reached the goal by then; ``exact_rate``, the success rate of the best search.
- ``units``: `ctgraph_rl.learn.unit_metrics.unit_metrics` on the ``num_images`` of a block's tasks, or fresh ones
  (``images``), at its ``start``, ``during`` it, at its ``end`` or after a ``batch``. ``training`` then has norms.

Numbers that are not finite are null. Only ``seconds``, the time since the start, differs between two equal runs. A
reader in three lines::

    import json
    with open("run.jsonl", encoding="utf-8") as file:
        measurements = [json.loads(line) for line in file]
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, as_path, is_real, require
from ctgraph_rl.disk import appending, cannot_write, open_own, read_regular
from ctgraph_rl.log.measurement import check, parsed
from ctgraph_rl.metrics import Curves, RegimeTable, Trained
from ctgraph_rl.metrics.adaptation import Adaptation

MOST_CELLS = 10**7

MOST_BYTES = 2**30

MOST_MEMORY, BYTES_OF_A_VALUE = 2**32, 100
"""Memory of a log, 4 GiB, and bytes per value, as small records grow many times."""

VALUES = (b",", b":", b"{", b"[", b"\n")

FEW, BYTES_OF_A_NUMBER = 1000, 4
"""Blocks and tasks of a log of any size, and file bytes for each more."""

FEW_CELLS, CELLS_OF_A_BYTE = 10**4, 16
"""Cells of a table of a log of any size, and more per file byte."""

BROKEN = "restore the file, or run again"

SCHEMA = 1
"""Rises when the meaning of a line changes; fields may be added without."""

BEGINNING = b'{"kind": "run"'


class RunLog:
    """Measurements of one run, in memory and, with a path, in a file, line by line.

    ``listeners`` are called with every new measurement.

    Args:
        path: the file to append to; None keeps measurements in memory only.

    Raises:
        FileExistsError: if the file exists.
    """

    def __init__(self, path: Path | str | None = None) -> None:
        self.measurements: list[NamedValues] = []
        self.torn_lines = 0
        self._num_bytes = MOST_BYTES  # of the file that was read
        self.listeners: list[Callable[[NamedValues], object]] = []
        self._start = time.perf_counter()
        self._path: Path | None = None
        self._is_closed = False
        if path is not None:
            with open_own(as_path("path", path), "xb") as file:
                self._write_to(file)

    def _write_to(self, file: BinaryIO) -> None:
        self._path = Path(os.fsdecode(file.name)).absolute()  # a program may change its directory
        self._found = os.fstat(file.fileno())

    def __repr__(self) -> str:
        run = self._run()
        counts = f"{len(self.of_kind('training'))} training intervals, {len(self.of_kind('evaluation'))} evaluations"
        return f"<RunLog {run['curriculum']!s:.80}, seed {run['seed']}: {counts}>"

    def _run(self) -> NamedValues:
        about = self.about
        seed = (about.get("config") or {}).get("seed")
        return {"curriculum": about.get("curriculum"), "fingerprint": about.get("fingerprint"), "seed": seed}

    @property
    def about(self) -> NamedValues:
        """The first line; empty without."""
        return next(iter(self.of_kind("run")), {})

    @classmethod
    def resume(cls, path: Path | str, position: Mapping[str, float]) -> RunLog:
        """Resume a log from a `position`, removing later lines.

        Raises:
            ValueError: if the file ends before it, or a line is no measurement.
        """
        path = Path(path)
        size = int(position["bytes"])
        there = path.stat().st_size
        require((there >= size, f"{path} has {there} bytes and the checkpoint needs {size}: restore the file"))
        with open_own(path, "r+b") as file:
            file.truncate(size)
            log = cls.read(path)
            log._write_to(file)
        require((log.torn_lines == 0, f"{path}: the last line before the checkpoint is torn: restore the file"))
        log._num_bytes = MOST_BYTES
        log._start -= position["seconds"]
        return log

    def position(self) -> dict[str, float]:
        """Return the file's bytes on disk, and the run's seconds."""
        return {"bytes": self.sync(), "seconds": round(time.perf_counter() - self._start, 3)}

    def sync(self) -> int:
        """Let all lines reach the disk; return the file's bytes."""
        if self._path is None or self._is_closed:
            return 0
        with appending(self._path, self._found) as descriptor:
            size = os.fstat(descriptor).st_size
            try:
                os.fsync(descriptor)
            except OSError as error:
                raise cannot_write(self._path, size, error) from error
        return size

    def append(self, kind: str, **values: Any) -> None:
        """Add one measurement; NaN and infinity become null, as JSON has neither.

        Raises:
            OSError: if it cannot be written, or the file was moved.
        """
        finite = {
            name: (None if isinstance(value, float) and not math.isfinite(value) else value)
            for name, value in values.items()
        }
        measurement = {"kind": kind, **finite, "seconds": round(time.perf_counter() - self._start, 3)}
        self.measurements.append(measurement)
        if self._path is not None:
            require((not self._is_closed, f"{self._path} is closed: nothing can be added"))
            line = json.dumps(measurement).encode() + b"\n"
            with appending(self._path, self._found) as descriptor:
                try:
                    written = os.write(descriptor, line)
                    while written < len(line):  # a full disk takes a part, and fails at the next attempt
                        written += os.write(descriptor, line[written:])
                except OSError as error:
                    raise cannot_write(self._path, len(line), error) from error
        for listener in self.listeners:
            listener(measurement)

    def close(self) -> None:
        """Let all lines reach the disk, and end the log."""
        try:
            self.sync()
        finally:
            self._is_closed = True

    @classmethod
    def read(cls, path: Path | str) -> RunLog:
        """The log of a run directory's ``run.jsonl``, in memory.

        A torn last line of a killed run is left out and counted in ``torn_lines``.

        Raises:
            ValueError: for any other line that is no measurement, a newer schema, anything but a regular file of at
                most `MOST_BYTES`, and more blocks and tasks than a file of its size can measure.
        """
        return cls.of_content(read_regular(as_path("path", path), MOST_BYTES), path)

    @classmethod
    def of_content(cls, content: bytes, path: Path | str) -> RunLog:
        """Return the log of a file's content, as `read`. Errors name ``path``."""
        needed = len(content) + BYTES_OF_A_VALUE * sum(map(content.count, VALUES))
        require((needed <= MOST_MEMORY, f"{path} would take {needed:,} bytes of memory, the limit is {MOST_MEMORY:,}"))
        *lines, last = content.split(b"\n")
        log = cls()
        log._num_bytes = len(content)
        if last:  # without an end: the run was killed while it wrote
            try:
                parsed(last)
                lines.append(last)
            except ValueError:
                log.torn_lines = 1
        most = FEW + len(content) // BYTES_OF_A_NUMBER
        for number, line in enumerate(lines, 1):
            try:
                measurement = parsed(line)
                check(measurement, most)
            except json.JSONDecodeError as error:
                why = f"{error.msg} at character {error.pos + 1}"
                raise ValueError(f"{path}: line {number} is no measurement, {why}: {BROKEN}") from None
            except ValueError as error:
                raise ValueError(f"{path}: line {number}: {error}: {BROKEN}") from None
            log.measurements.append(measurement)
        schema = log.about.get("schema", SCHEMA)
        newer = f"{path} has schema {schema}, this version reads {SCHEMA}: update ctgraph_rl"
        require((schema <= SCHEMA, newer))
        return log

    @classmethod
    def begun(cls, path: Path | str) -> NamedValues | None:
        """Return a log's first line, or None; what follows may be anything."""
        try:
            first = parsed(read_regular(path, MOST_BYTES).partition(b"\n")[0])
            check(first)
        except (FileNotFoundError, ValueError):
            return None
        return first if first["kind"] == "run" else None

    @classmethod
    def is_blank(cls, path: Path | str) -> bool:
        """Return whether a log holds at most a part of its first line, as after an early crash."""
        try:
            content = read_regular(path, MOST_BYTES).strip(b"\0")
        except ValueError:
            return False
        return b"\n" not in content and BEGINNING.startswith(content[: len(BEGINNING)])

    def of_kind(self, kind: str) -> list[NamedValues]:
        """Measurements of one kind, in order."""
        return [measurement for measurement in self.measurements if measurement["kind"] == kind]

    def rows(self, kind: str) -> Iterator[NamedValues]:
        """Yield the measurements of a kind, after the run's curriculum, fingerprint and seed."""
        run = self._run()
        for measurement in self.of_kind(kind):
            row = {**run, **measurement}
            del row["kind"]
            yield row

    def to_pandas(self, kind: str = "evaluation") -> Any:
        """Return `rows` of a kind, ``evaluation`` or ``training``, as a ``pandas.DataFrame``.

        Raises:
            ModuleNotFoundError: without pandas.
        """
        try:
            import pandas
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("RunLog.to_pandas needs pandas: pip install pandas") from error
        return pandas.DataFrame(list(self.rows(kind)))

    def performance(self, num_tasks: int = 0) -> Tensor:
        """The performance matrix: mean return, float64 [blocks + 1, tasks]; NaN where not evaluated.

        Blocks and tasks are the log's trained ones, or else those so far.

        Args:
            num_tasks: least columns, for tasks never evaluated.
        """
        num_rows = max(len(self.ends()), 1 + len(self._said()))
        rows: dict[int, dict[int, float]] = {block: {} for block in range(num_rows)}
        for m in self._evaluations(during=False):
            rows[m["block"]][m["task"]] = m["return_mean"]
        return self._matrix(rows.values(), num_tasks)

    def labels(self, count: int) -> tuple[str, ...]:
        """The labels of the first tasks, such as the columns of `performance`."""
        known = dict(enumerate(map(str, self.about.get("tasks") or ()), 1))
        for m in self._evaluations(during=True):
            known[m["task"]] = label_of(m)
        return tuple(known.get(task, f"task {task}") for task in range(1, count + 1))

    def reached(self, kind: str) -> int:
        """Frames of the run at the last measurement of a kind; 0 without."""
        return max((m["frames"] for m in self.of_kind(kind)), default=0)

    def ends(self) -> list[int]:
        """Frames of the run at the end of each block so far; 0 for block 0."""
        ends = {0: 0}
        for m in self.measurements:
            if m["kind"] in ("training", "evaluation"):
                ends[m["block"]] = m["frames"]
        return [ends.get(block, 0) for block in range(max(ends) + 1)]

    def training(self, name: str) -> Tensor:
        """A field of all training intervals, float64 [intervals]; NaN for null."""
        return _row([m.get(name) for m in self.of_kind("training")])

    def training_by_block(self, name: str) -> dict[int, Tensor]:
        """`training` of each block that has intervals, by its number."""
        values: dict[int, list[float | None]] = {}
        for m in self.of_kind("training"):
            values.setdefault(m["block"], []).append(m.get(name))
        return {block: _row(of_block) for block, of_block in values.items()}

    def last(self, name: str, num_tasks: int = 0) -> Tensor:
        """A field of each task's evaluation after the curriculum's last block, float64 [tasks], or NaN.

        Args:
            num_tasks: as in `performance`.
        """
        evaluations = self._evaluations(during=False)
        block = len(self._said()) or max((m["block"] for m in evaluations), default=0)
        return self._matrix([{m["task"]: m.get(name) for m in evaluations if m["block"] == block}], num_tasks)[0]

    def adaptation(self, held_out: bool = False) -> Adaptation | None:
        """Return the last evaluation with adaptation, of held-out or trained tasks, or None.

        Raises:
            ValueError: if tasks differ in the number of episodes.
        """
        rows: dict[tuple[int, int], list[NamedValues]] = {}
        for m in self.of_kind("adaptation"):
            if bool(m.get("held_out")) == held_out:
                rows.setdefault((m["frames"], m["task"]), []).append(m)
        if not rows:
            return None
        frames, _ = next(reversed(rows))
        last = [row for (when, _), row in rows.items() if when == frames]
        lengths = set(map(len, last))
        require((len(lengths) == 1, f"tasks must adapt in as many episodes, the log has {lengths}: restore the log"))
        fields = []
        for name in ("return_mean", "success_rate", "found_rate", "exact_rate"):
            fields.append(torch.stack([_row([m.get(name) for m in row]) for row in last]))
        return Adaptation(*fields)

    def curves(self, trained: Trained | None = None, name: str = "return_mean") -> Curves:
        """All evaluations of the curriculum's tasks in time order, those during blocks included.

        Args:
            trained: each block's tasks, from 0; default: the log's.
            name: the field that is the performance.

        Raises:
            ValueError: if nothing was evaluated.
        """
        points: dict[tuple[int, int], dict[int, float]] = {}
        for m in self._evaluations(during=True):
            points.setdefault((m["block"], m["frames"]), {})[m["task"]] = m.get(name, math.nan)
        require((bool(points), "this log has no evaluation"))
        blocks, frames = zip(*points, strict=True)
        of_blocks = self._trained(trained)
        num_tasks = 1 + max(chain(*of_blocks))
        return Curves(self._matrix(points.values(), num_tasks), blocks, frames, of_blocks)

    def regimes(self, trained: Trained | None = None, labels: Sequence[str] | None = None) -> RegimeTable:
        """The run as the lifelong metrics see it: a regime per training block and per evaluation at its boundaries.

        An experience is a training interval with finished episodes. Evaluations during blocks or held out do not count.

        Args:
            trained: each block's tasks, from 0; default: the log's.
            labels: tasks' names; default: those of evaluations, else ``task 1`` and so on.

        Raises:
            ValueError: for a block that trains several tasks, one without a finished episode, and a task never
                evaluated.
        """
        tasks = []
        mixed = []
        for number, block in enumerate(self._trained(trained), 1):
            tasks.append(min(block) + 1)
            if len({*block}) > 1:
                mixed.append(str(number))
        several = f"lifelong metrics need blocks that train one task, block {', '.join(mixed)} trains several"
        require((not mixed, several))
        said = {m["task"]: label_of(m) for m in self._evaluations(during=True)}
        require(({*tasks} <= {*said}, "lifelong metrics need an evaluation of every task"))
        label = said if labels is None else dict(enumerate(labels, 1))
        names: dict[str, int] = {}
        rows = []
        values: list[float | None] = []
        at_end: dict[int, list[NamedValues]] = {}
        for m in self._evaluations(during=False):
            at_end.setdefault(m["block"], []).append(m)
        returns = self.training_by_block("return_mean")
        for number in range(len(tasks) + 1):
            if number:
                own = returns.get(number, _row([]))
                own = own[~own.isnan()]
                rows.append((names.setdefault(label[tasks[number - 1]], len(names)), True, len(own)))
                values += own.tolist()
            for m in at_end.get(number, ()):
                rows.append((names.setdefault(label[m["task"]], len(names)), False, 1))
                values.append(m["return_mean"])
        return RegimeTable(names, _row(values), *zip(*rows, strict=True))

    def _trained(self, trained: Trained | None) -> tuple[tuple[int, ...], ...]:
        if trained is None:
            trained = self._said()
            require((bool(trained), "this log does not say what each block trained: give trained, Curriculum.trained"))
        return tuple(map(tuple, trained))

    def _said(self) -> list[list[int]]:
        return [[number - 1 for number in block] for block in self.about.get("trained", ())]

    def _evaluations(self, during: bool) -> list[NamedValues]:
        found = []
        for m in self.of_kind("evaluation"):
            if not m.get("held_out") and (during or m.get("moment") != "during"):
                found.append(m)
        return found

    def _matrix(self, rows: Iterable[Mapping[int, float | None]], num_tasks: int) -> Tensor:
        evaluated = {m["task"] for m in self._evaluations(during=True)}
        tasks = range(1, max(num_tasks, 1 + max(chain(*self._said()), default=-1), *evaluated) + 1)
        rows = list(rows)
        size = len(rows) * len(tasks)
        most = min(MOST_CELLS, FEW_CELLS + CELLS_OF_A_BYTE * self._num_bytes)
        require((size <= most, f"a table of {len(rows):,} x {len(tasks):,} is no run's: restore the log"))
        return torch.stack([_row([row.get(task) for task in tasks]) for row in rows])


def label_of(evaluation: ReadOnlyValues) -> str:
    """Return the label, or else the number, of an evaluation's task."""
    return str(evaluation.get("label", f"task {evaluation['task']}"))


def tuning_share(about: ReadOnlyValues) -> float | None:
    """Return the share of the frames after which a tuning run ends, from its first line; None for other runs."""
    config = about.get("config")
    share = config.get("objective_until") if isinstance(config, Mapping) else None
    return share if is_real(share, 0, 1) else None


def _row(values: Sequence[float | None]) -> Tensor:
    return torch.tensor([math.nan if value is None else value for value in values], dtype=torch.float64, device="cpu")
