"""A run's tables, or its log in another program's format.

l2metrics reads log format 1.1 of l2logger. A training interval, or an evaluation of a task, is one experience with its
mean return as reward. Time stamps count experiences, so equal runs give equal files.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path

from ctgraph_rl import parsers
from ctgraph_rl.checks import require
from ctgraph_rl.disk import write_whole
from ctgraph_rl.log.escape import refused_by
from ctgraph_rl.log.files import LOG, no_run
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.tables import write_tables
from ctgraph_rl.metrics import Regime

COLUMNS = (
    "block_num",
    "exp_num",
    "worker_id",
    "block_type",
    "block_subtype",
    "task_name",
    "task_params",
    "exp_status",
    "timestamp",
    "reward",
)
WORKER = "worker0"
START = datetime(2000, 1, 1)


def write_l2logger(regimes: Sequence[Regime], folder: Path | str) -> None:
    """Write regimes as a log of l2logger 1.1.

    Args:
        regimes: a run's, such as of `RunLog.regimes`, or an expert's.
        folder: new or empty; its name is the run's in l2metrics.

    Raises:
        ValueError: if the folder holds something.
    """
    folder = Path(folder)
    require((not folder.exists() or not any(folder.iterdir()), f"{folder} must be empty or new; choose another folder"))
    names = task_names(regimes)
    tables: dict[tuple[int, str], list[str]] = {}
    experience = 0
    for block, regime in numbered(regimes):
        kind = "train" if regime.training else "test"
        rows = tables.setdefault((block, kind), ["\t".join(COLUMNS)])
        for value in regime.values.tolist():
            stamp = (START + timedelta(seconds=experience)).strftime("%Y%m%dT%H%M%S.%f")
            what = (block, experience, WORKER, kind, "wake", names[regime.task], "{}", "complete", stamp, repr(value))
            rows.append("\t".join(map(str, what)))
            experience += 1
    for (block, kind), rows in tables.items():
        where = folder / WORKER / f"{block}-{kind}"
        where.mkdir(parents=True)
        write_whole(where / "data-log.tsv", "\n".join(rows) + "\n")
    about = {"metrics_columns": ["reward"], "log_format_version": "1.1"}
    scenario = {"complexity": "1-low", "difficulty": "1-easy", "scenario_type": "custom"}
    write_whole(folder / "logger_info.json", json.dumps(about) + "\n")
    write_whole(folder / "scenario_info.json", json.dumps(scenario) + "\n")


def numbered(regimes: Sequence[Regime]) -> Iterator[tuple[int, Regime]]:
    """Regimes with block numbers from 0: a block per training, and one for the evaluations of different tasks after it.

    Of two evaluations of a task in one block l2metrics would make one.
    """
    block = -1
    evaluated: set[str] | None = None
    for regime in regimes:
        if regime.training or evaluated is None or regime.task in evaluated:
            block = block + 1
            evaluated = None if regime.training else set()
        if evaluated is not None:
            evaluated.add(regime.task)
        yield block, regime


def task_names(regimes: Sequence[Regime]) -> dict[str, str]:
    """Names as l2logger wants them: ``ctgraph_1goal11`` for the first task, ``goal1.1``."""
    tasks = dict.fromkeys(regime.task for regime in regimes)
    return {task: f"ctgraph_{i}{re.sub('[^0-9a-z]', '', task.lower())}" for i, task in enumerate(tasks, 1)}


def main() -> None:
    """Export a run directory."""
    parser = parsers.export()
    arguments = parser.parse_args()
    with refused_by(parser):
        require(((arguments.run / LOG).is_file(), no_run(arguments.run, below=False)))
        log = RunLog.read(arguments.run / LOG)
        measured = any(measurement["kind"] != "run" for measurement in log.measurements)
        require((measured, f"{arguments.run} has no training and no evaluation yet: there is nothing to export"))
        if arguments.format == "l2logger":
            write_l2logger(log.regimes(), arguments.out)
        else:
            arguments.out.mkdir(parents=True, exist_ok=True)
            write_tables(log, arguments.out, parquet=arguments.format == "parquet")
    print(f"{arguments.format}: {arguments.out}")


if __name__ == "__main__":
    main()
