"""A run's log as tidy tables: one row per evaluation of a task, one row per training interval; the performance matrix.

CSV always, Parquet with ``pip install 'ctgraph_rl[tables]'``. The first columns name the run, so tables of many runs
can be concatenated. Unmeasured values are empty or null. A reader in three lines::

    import csv
    with open("evaluations.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

and in one, ``pandas.read_csv("evaluations.csv")`` or ``pandas.read_parquet("evaluations.parquet")``.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

from ctgraph_rl.checks import require
from ctgraph_rl.disk import write_named, write_whole
from ctgraph_rl.log.escape import csv_text, utf8_text
from ctgraph_rl.log.run_log import RunLog

RUN = {
    "curriculum": ("string", "name of the curriculum"),
    "fingerprint": ("string", "what the curriculum is, in 16 digits"),
    "seed": ("int64", "seed of the run"),
}
EPISODES = {
    "episodes": ("int64", "finished episodes; empty where means are exact"),
    "return_mean": ("double", "their mean return"),
    "success_rate": ("double", "share that reached the goal"),
    "end_rate": ("double", "share that reached an end state"),
    "length_mean": ("double", "their mean steps"),
}
SECONDS = {"seconds": ("double", "since the start of the run; the only column that differs between equal runs")}

EVALUATIONS = {
    **RUN,
    "block": ("int64", "block in or after which it was made; 0 before any training"),
    "moment": ("string", "`before` any training, `during` a block, or `after` it"),
    "frames": ("int64", "frames learned so far"),
    "task": ("int64", "number of the task from 1; held-out tasks count on"),
    "label": ("string", "short name of the task"),
    "held_out": ("bool", "whether no block trains the task"),
    **EPISODES,
    **SECONDS,
}
"""Columns: type and meaning."""

TRAINING = {
    **RUN,
    "block": ("int64", "block from 1"),
    "frames": ("int64", "frames learned so far, this interval included"),
    **EPISODES,
    **SECONDS,
}
"""Columns: type and meaning; the agent's reports follow as doubles."""

MOST_COLUMNS = 256
"""Of a table: each line of a log may name others."""

TABLES = {"evaluation": ("evaluations", EVALUATIONS), "training": ("training", TRAINING)}


def write_tables(log: RunLog, folder: Path | str, parquet: bool | None = None) -> list[Path]:
    """Write ``evaluations``, ``training`` and ``performance.csv`` into a folder; return the files.

    Args:
        parquet: write Parquet, too; None: if pyarrow is installed.

    Raises:
        ModuleNotFoundError: with ``parquet=True`` and without pyarrow; names the extra to install.
    """
    if parquet is None:
        parquet = find_spec("pyarrow") is not None
    elif parquet:
        require_parquet()
    written = []
    for kind, (name, columns) in TABLES.items():
        types = _types(kind, columns, log)
        rows = list(_rows(log, kind, types))
        written.append(Path(folder) / f"{name}.csv")
        write_whole(written[-1], csv_text([types, *rows]))
        if parquet:
            written.append(Path(folder) / f"{name}.parquet")
            write_whole(written[-1], _parquet(types, rows))
    written.append(Path(folder) / "performance.csv")
    write_performance(written[-1], log)
    return written


def write_performance(path: Path | str, log: RunLog) -> None:
    """Write the performance matrix as CSV: a line per block so far, block 0 before any training; a column per task."""
    performance = log.performance()
    lines: list[list[Any]] = [["block", "frames", *log.labels(performance.shape[1])]]
    for block, (frames, row) in enumerate(zip(log.ends(), performance.tolist(), strict=False)):
        lines.append([block, frames, *row])
    write_whole(path, csv_text(lines, "\r\n"))


def check_table(path: Path) -> None:
    """Refuse a file that `write_evaluations` cannot write.

    Raises:
        ValueError: for another ending than ``.csv`` and ``.parquet``.
        ModuleNotFoundError: for Parquet without pyarrow; names the extra to install.
    """
    require((path.suffix in (".csv", ".parquet"), f"a table of evaluations ends in .csv or .parquet, got {path}"))
    if path.suffix == ".parquet":
        require_parquet()


def write_evaluations(path: Path, runs: Sequence[tuple[str, str, RunLog]]) -> None:
    """Write the evaluations of many runs as one table, CSV or Parquet by its ending.

    Args:
        path: as `check_table` allows.
        runs: agent, directory (the first two columns) and log of each.
    """
    check_table(path)
    types = _types("evaluation", EVALUATIONS, *(log for _, _, log in runs))
    rows = []
    for agent, place, log in runs:
        rows += [[agent, place, *row] for row in _rows(log, "evaluation", types)]
    columns = {"agent": "string", "run": "string", **types}
    is_csv = path.suffix == ".csv"
    write_named(path, csv_text([columns, *rows]) if is_csv else _parquet(columns, rows))


def require_parquet() -> None:
    """Refuse work without pyarrow.

    Raises:
        ModuleNotFoundError: names the extra to install.
    """
    try:
        import pyarrow  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("Parquet tables need pyarrow: pip install 'ctgraph_rl[tables]'") from error


def _types(kind: str, columns: dict[str, tuple[str, str]], *logs: RunLog) -> dict[str, str]:
    types = {name: type_ for name, (type_, _) in columns.items()}
    for log in logs:
        names = dict.fromkeys(chain(*log.of_kind(kind)))
        require((len(names) <= MOST_COLUMNS, f"a table of {len(names):,} columns, the limit is {MOST_COLUMNS}"))
        for name in names:
            types.setdefault(name, "double")
    types.pop("kind", None)
    return types


def _rows(log: RunLog, kind: str, names: Iterable[str]) -> Iterator[list[Any]]:
    for row in log.rows(kind):
        yield list(map(row.get, names))


def _parquet(types: Mapping[str, str], rows: Sequence[Sequence[Any]]) -> bytes:
    import pyarrow
    from pyarrow import parquet

    schema = pyarrow.schema([(name, pyarrow.type_for_alias(type_)) for name, type_ in types.items()])
    columns = zip(*rows, strict=True) if rows else ([] for _ in types)
    values = [list(map(utf8_text, column)) for column in columns]
    buffer = io.BytesIO()
    parquet.write_table(pyarrow.table(values, schema=schema), buffer)
    return buffer.getvalue()
