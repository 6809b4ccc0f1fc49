"""Finished runs as one tidy table: a row for each number that a run measured."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctgraph_rl.checks import require
from ctgraph_rl.report.style import require_packages
from ctgraph_rl.runs.read import FOLDER, NO_METHOD, Run, Value, called, find_runs, grouped, present

if TYPE_CHECKING:
    import pandas


COLUMNS = (
    *("run", "agent", "method", "settings", "learner"),
    *("curriculum", "fingerprint", "numbers_version", "seed"),
    *Value._fields,
)
"""A run, and one of its numbers."""

DTYPES = {
    **dict.fromkeys(COLUMNS, "category"),
    **dict.fromkeys(("numbers_version", "seed"), "int64"),
    **dict.fromkeys(("block", "frames", "episode"), "Int64"),
    "held_out": "boolean",
    "value": "float64",
}


def results(paths: Path | str | Sequence[Path | str], tuning: bool = False) -> pandas.DataFrame:
    """Return every number of finished runs as a row of one tidy table.

    The columns are:

    - ``run``, ``agent``, ``method``, ``settings``, ``learner``, ``curriculum``, ``fingerprint``: category. ``settings``
      is JSON. ``learner`` is the agent's name in ``ctgraph-rl results``; ``method`` is ``Finetune`` for none.
    - ``numbers_version``, ``seed``: int64.
    - ``task``: category, its label; ``held_out``: boolean, whether no block trains it.
    - ``block``: Int64, 0 before any training; ``moment``: category, ``before``, ``during`` or ``after`` the block.
    - ``frames``: Int64, learned so far; ``episode``: Int64, of a row that adapts, from 1.
    - ``metric``: category; ``value``: float64, NaN where a metric is undefined.

    Metrics of evaluations are ``return_mean`` and ``success_rate``; those of training intervals begin with
    ``training_`` and have no task, those of rows that adapt with ``adaptation_``. All others
    (``docs/reference/metrics.md``) are of the whole run and have neither task nor block.

    Args:
        paths: run directories, or folders that hold them. Single-task experts count only without other runs.
        tuning: also read tuning runs, those with ``objective_until``.

    Warns:
        UserWarning: for each run left out: unfinished, broken or a second copy.

    Raises:
        ModuleNotFoundError: without pandas; names the extra to install.
        ValueError: if no run is finished, or for paths of another type.

    Example:
        >>> frame = results("runs")  # doctest: +SKIP
        >>> last = frame[frame.metric == "average_performance"]  # doctest: +SKIP
        >>> last.groupby("learner").value.agg(["mean", "std", "count"])  # doctest: +SKIP
    """
    require_packages("results", "pandas")
    import pandas

    listed = [paths] if isinstance(paths, (str, Path)) else paths
    rule = f"paths must be a folder of runs or a list of them, such as 'runs/ct8', got {paths!r}"
    require((isinstance(listed, Iterable), rule))
    listed = list(listed)
    require((bool(listed) and all(isinstance(path, (str, Path)) for path in listed), rule))
    runs, problems = find_runs(listed, tuning=tuning)
    finished = [run for run in runs if run.reason is None]
    unfinished = [f"{run.path}: {run.reason}" for run in runs if run.reason is not None]
    left_out = [*(problem.reason for problem in problems), *unfinished]
    require((bool(finished), f"no run is finished: {'; '.join(left_out)}"))
    for reason in left_out:
        warnings.warn(f"left out: {reason}", stacklevel=2)
    return pandas.DataFrame(rows(finished), columns=COLUMNS).astype(DTYPES)


def rows(runs: Sequence[Run]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of runs, of `COLUMNS`, in the order of tables."""
    for (_, learner), by_seed in grouped(runs).items():
        for run in present(by_seed):
            config = run.about["config"]
            agent = called(config.get("agent")) or called(config.get("learner")) or Path(run.settings[FOLDER]).name
            settings = json.dumps(run.settings, sort_keys=True)
            names = (str(run.path), agent, called(config.get("method")) or NO_METHOD, settings, learner)
            number = (run.code["numbers version"], run.seed)
            for value in run.values:
                yield (*names, *run.curriculum, *number, *value)
