"""Runs that test sentences of the paper: claim_runs.csv, and effects in the direction of a sentence, one a seed."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ctgraph_rl.runs.read import MODIFIED
from studies.raw import Raw, grow, machine_of, merged, read

NAME = "claim_runs"
CONDITIONS = (
    "depth",
    "reward_fn",
    "reward_std",
    "goal_reward",
    "within",
    "group_size",
    "num_wait_images",
    "order",
    "agent",
    "cell",
    "learning_rate",
    "method",
    "frames",
)
"""What differs between the runs of a sentence; empty where a curriculum or an agent lacks it."""

OF_CURRICULUM = CONDITIONS[:7]
KEY = ("curriculum", *CONDITIONS, "seed")
METRICS = ("tasks_learned", "forgetting", "forward_transfer")


def collect(name: str, folders: Sequence[Path], add: bool) -> None:
    """Write a line for each finished run under some folders; experts of other runs are left out."""
    paths = [path.parent for folder in folders for path in folder.rglob("metrics.json")]
    new = [measured(path) for path in paths if path.parent.name != "experts"]
    lines = merged(name, new, KEY, add)
    grow({name: sorted(lines, key=lambda line: [str(line[column]).rjust(12) for column in KEY])}, [])


def measured(run: Path) -> dict[str, Any]:
    """Return the line of a run: means over its tasks in the last evaluation, metrics, and frames to a return of 0.9."""
    from ctgraph_rl.log.files import LOG
    from ctgraph_rl.log.run_log import RunLog
    from ctgraph_rl.metrics.curves import frames_to_mastery

    log = RunLog.read(run / LOG)
    about = log.of_kind("run")[0]
    config = about["config"]
    agent = config["agent"]
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    found = {
        "curriculum": about["curriculum"].removesuffix(MODIFIED),
        **{key: _setting(config["curriculum"].get(key)) for key in OF_CURRICULUM},
        "order": " ".join(about["tasks"]),
        "agent": _module(agent["_target_"]),
        "cell": cell_of(agent.get("cell")),
        "learning_rate": agent["learning_rate"],
        "method": _module(config["method"]["_target_"]),
        "frames": log.of_kind("evaluation")[-1]["frames"],
        "seed": config["seed"],
        "return": round(log.last("return_mean").mean().item(), 6),
        "success": round(log.last("success_rate").mean().item(), 6),
        "end_rate": round(log.last("end_rate").mean().item(), 6),
    }
    for key in METRICS:
        found[key] = _text(metrics[key]["value"])
    terms = frames_to_mastery(log.curves()).terms
    for task, frames in enumerate(terms or [], start=1):
        found[f"frames_{task}"] = _text(frames)
    return {**found, **machine_of(about)}


def _module(target: str) -> str:
    """Return the file of a class, such as ``ppo`` of ``baselines.ppo.PPO``."""
    return target.split(".")[-2]


def _setting(value: Any) -> str:
    """Return a setting as the table has it."""
    return "" if value is None else f"{value:g}" if isinstance(value, int | float) else str(value)


def cell_of(cell: dict[str, Any] | None) -> str:
    """Return the memory of an agent: its cell, and how its fast weights are modulated."""
    if cell is None:
        return ""
    name = _module(cell["_target_"])
    return f"{name}, {cell['modulation']}" if "modulation" in cell else name


def _text(value: float | None) -> str:
    """Return a value as the table has it: nothing where it is undefined."""
    return "" if value is None or math.isnan(value) else f"{value:.6g}"


def runs(curriculum: str, **conditions: str) -> Raw:
    """Return the lines of a curriculum under some conditions, by seed."""
    lines = [line for line in read(NAME) if line["curriculum"] == curriculum]
    found = [line for line in lines if all(line[key] == value for key, value in conditions.items())]
    return sorted(found, key=lambda line: int(line["seed"]))
