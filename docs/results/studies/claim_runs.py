"""Runs that test sentences of the paper: claim_runs.csv, and what the page of sentences says of them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import Estimate
from ctgraph_rl.runs.read import MODIFIED
from studies.raw import Raw, groups, machine_of, numbers_in, read, write

NAME = "claim_runs"
CONDITIONS = ("depth", "reward_fn", "reward_std", "within")
"""Settings of curricula that differ between the runs of a sentence; empty where a curriculum lacks one."""

METRICS = ("tasks_learned", "forgetting", "forward_transfer")
SHARES = (0.0, 1.0)


def collect(name: str, folders: Sequence[Path]) -> None:
    """Write a line for each finished run under some folders; experts of other runs are left out."""
    paths = [path.parent for folder in folders for path in folder.rglob("metrics.json")]
    lines = [measured(path) for path in paths if path.parent.name != "experts"]
    key = ("curriculum", *CONDITIONS, "seed")
    write(name, sorted(lines, key=lambda line: [str(line[column]).rjust(12) for column in key]))


def measured(run: Path) -> dict[str, Any]:
    """Return the line of a run: means over its tasks in the last evaluation, metrics, and frames to a return of 0.9."""
    from ctgraph_rl.log.files import LOG
    from ctgraph_rl.log.run_log import RunLog
    from ctgraph_rl.metrics.curves import frames_to_mastery

    log = RunLog.read(run / LOG)
    about = log.of_kind("run")[0]
    settings = about["config"]["curriculum"]
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    found = {
        "curriculum": about["curriculum"].removesuffix(MODIFIED),
        **{key: settings.get(key, "") for key in CONDITIONS},
        "agent": about["config"]["agent"]["_target_"].split(".")[1],
        "seed": about["config"]["seed"],
        "frames": log.of_kind("evaluation")[-1]["frames"],
        "success": round(log.last("success_rate").mean().item(), 6),
        "end_rate": round(log.last("end_rate").mean().item(), 6),
    }
    for key in METRICS:
        found[key] = _text(metrics[key]["value"])
    terms = frames_to_mastery(log.curves()).terms
    for task, frames in enumerate(terms or [], start=1):
        found[f"frames_{task}"] = _text(frames)
    return {**found, **machine_of(about)}


def _text(value: float | None) -> str:
    """Return a value as the table has it: nothing where it is undefined."""
    return "" if value is None or math.isnan(value) else f"{value:.6g}"


def runs(curriculum: str, **conditions: str) -> Raw:
    """Return the lines of a curriculum under some conditions."""
    lines = [line for line in read(NAME) if line["curriculum"] == curriculum]
    return [line for line in lines if all(line[key] == value for key, value in conditions.items())]


def difference(column: str, first: Raw, second: Raw) -> Estimate:
    """Return the mean difference of shares of two sets of runs, paired in their order."""
    return statistics.compare(numbers_in(first, column), numbers_in(second, column), bounds=SHARES).difference


def above(found: Estimate) -> bool:
    """Return whether a whole interval is above 0."""
    return found.low is not None and found.low > 0


def below(found: Estimate) -> bool:
    """Return whether a whole interval is below 0."""
    return found.high is not None and found.high < 0


def means(column: str, lines: Raw, key: str) -> str:
    """Return the mean of a share under each condition, such as ``1: 0.98, 2: 0.51``."""
    of = groups(lines, key)
    return ", ".join(f"{name}: {fmean(numbers_in(each, column)):.2f}" for (name,), each in of.items())


def of_gradient() -> Estimate:
    """Return the difference in success that a reward gradient makes on the large graphs."""
    return difference(
        "success", runs("large_gradient", reward_fn="gradient"), runs("large_gradient", reward_fn="needle")
    )


def of_noise(depth: str) -> Estimate:
    """Return the difference in success that noise of standard deviation 1 makes at a depth."""
    noisy = runs("stochastic_rewards", depth=depth, reward_std="1")
    return difference("success", noisy, runs("stochastic_rewards", depth=depth, reward_std="0"))


def of_negative() -> Estimate:
    """Return the difference in episodes that reach an end state which noise of standard deviation 2 makes."""
    noisy = runs("negative_rewards", reward_std="2")
    return difference("end_rate", noisy, runs("negative_rewards", reward_std="0"))


def of_groups() -> Estimate:
    """Return the difference in tasks learned that images make which are alike within a kind of state, of four tasks."""
    alike, apart = (numbers_in(runs("stochastic_grouped", within=within), "tasks_learned") for within in ("0.1", "0.3"))
    return statistics.compare(alike, apart, bounds=(0, 4)).difference


def of_dissimilar(metric: str, curriculum: str = "fo_b1_dissimilar") -> Estimate:
    """Return the mean of a metric on tasks without similarities, or on another curriculum."""
    return statistics.mean(numbers_in(runs(curriculum), metric))


def of_waiting() -> Estimate:
    """Return how many more frames later tasks need to a return of 0.9 than the first; without runs that stay below."""
    gained: list[float | None] = []
    for line in runs("su_b1_4tasks"):
        later = [line[f"frames_{task}"] for task in (2, 3, 4)]
        known = line["frames_1"] and all(later)
        gained.append(fmean(map(float, later)) - float(line["frames_1"]) if known else None)
    return statistics.mean(gained)
