"""A short run of each named curriculum that no other study is about: every_curriculum.csv, which the cards show."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any

from ctgraph_rl.log.files import LOG
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.runs.read import MODIFIED
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import are_graphs
from studies.raw import machine_of, write

NAME = "every_curriculum"

KEY = ("curriculum", "agent", "method", "seed")


def collect(folders: Sequence[Path]) -> None:
    """Write a line for each finished run under some folders."""
    paths = [path.parent for folder in folders for path in folder.rglob("metrics.json")]
    lines = [measured(path) for path in paths]
    write(NAME, sorted(lines, key=lambda line: [str(line[column]) for column in KEY]))


def measured(run: Path) -> dict[str, Any]:
    """Return the line of a run.

    ``before``, ``learned`` and ``end`` are means over tasks: before training, right after each task's own block, and
    after the last block. ``curve`` has the mean over tasks at each evaluation, ``at`` the frames until then.
    """
    log = RunLog.read(run / LOG)
    about = log.of_kind("run")[0]
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    config = about["config"]
    points = mean_returns(log)
    matrix = log.performance().tolist()
    own = [matrix[block][task - 1] for block, trained in enumerate(about["trained"], 1) for task in trained]
    return {
        "curriculum": about["curriculum"].removesuffix(MODIFIED),
        "agent": config["agent"]["_target_"].split(".")[1],
        "method": config["method"]["_target_"].split(".")[2],
        "task_id": config["protocol"]["task_id"] or "",
        "seed": config["seed"],
        "block_frames": config["curriculum"]["num_frames"],
        "frames": max(points),
        "before": _text(fmean(matrix[0])),
        "learned": _text(fmean(own)),
        "end": _text(fmean(matrix[-1])),
        "forgetting": _text(metrics["forgetting"]["value"]),
        **known_values(Curriculum.from_json(run / "curriculum.json")),
        "at": " ".join(map(str, points)),
        "curve": " ".join(map(_text, points.values())),
        **machine_of(about),
    }


def mean_returns(log: RunLog) -> dict[int, float]:
    """Return the mean return over the trained tasks at each evaluation, by the frames until then."""
    found: dict[int, list[float]] = {}
    for line in log.of_kind("evaluation"):
        if not line["held_out"]:
            found.setdefault(line["frames"], []).append(line["return_mean"])
    return {frames: fmean(returns) for frames, returns in found.items()}


@cache
def known_values(curriculum: Curriculum) -> dict[str, str]:
    """Return means over tasks: optimum, return of random actions, and bounds; nothing where they are not known."""
    tasks = curriculum.tasks
    if not are_graphs(tasks):
        return dict.fromkeys(("optimum", "random", "lowest", "highest"), "")
    bounds = [task.return_bounds for task in tasks]
    return {
        "optimum": _text(fmean(task.optimal_value(1.0) for task in tasks)),
        "random": _text(fmean(map(_random_value, tasks))),
        "lowest": _text(fmean(low for low, _ in bounds)),
        "highest": _text(fmean(high for _, high in bounds)),
    }


def _random_value(task: Any) -> float:
    """Return the exact mean return of an agent that takes each action of a task equally often."""
    import torch

    return float(task.policy_value(torch.full((task.images.num_images, task.num_actions), 1 / task.num_actions)))


def _text(value: float | None) -> str:
    """Return a number as the table has it: nothing where it is undefined."""
    return "" if value is None or value != value else f"{value:.4g}"
