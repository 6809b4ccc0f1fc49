"""Whether seeds that are trained together learn as single runs do: what docs/how-to/seeds_together.md says."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import NormalDist, fmean
from typing import Any

from ctgraph_rl.report import statistics
from studies.raw import groups, machine_of, read, write

NAME = "together_fo_b1"
WAYS = ("alone", "together")
MEASURES = ("frames_to_90", "final_return")
WINDOW = 5
"""Batches over which the mean return of training is taken."""

POWER = 0.9
"""With which a difference is found that is as large as the table says."""


def measured(run: Path, way: str) -> dict[str, Any]:
    """Return the line of a run: the mean return of the last `WINDOW` batches, and frames to 90 % of it."""
    from ctgraph_rl import load

    trained = load(run)
    lines = [line for line in trained.log.of_kind("training") if line["return_mean"] is not None]
    frames, returns = [line["frames"] for line in lines], [line["return_mean"] for line in lines]
    means = [fmean(returns[end - WINDOW : end]) for end in range(WINDOW, len(returns) + 1)]
    reached = (at for at, mean in zip(frames[WINDOW - 1 :], means, strict=True) if mean >= 0.9 * means[-1])
    about = trained.log.of_kind("run")[0]
    return {
        "agent": run.name.split("-seed")[0],
        "seed": trained.seed,
        "way": way,
        "group_size": len(about.get("together") or [trained.seed]),
        "frames_to_90": next(reached),
        "final_return": round(means[-1], 6),
        **machine_of(about),
    }


def collect(name: str, folders: Sequence[Path]) -> None:
    """Write the raw results of the runs under two folders: of ``together=false``, and of ``together=true``.

    Raises:
        ValueError: for another number of folders.
    """
    if len(folders) != len(WAYS):
        raise ValueError(f"{name} needs two folders, of the runs alone and of those together, got {len(folders)}")
    of_way = dict(zip(WAYS, folders, strict=True))
    found = [(path.parent, way) for way, folder in of_way.items() for path in sorted(folder.rglob("metrics.json"))]
    write(name, sorted((measured(*run) for run in found), key=lambda line: (line["agent"], line["way"], line["seed"])))


def comparisons() -> dict[tuple[str, str], tuple[statistics.Comparison, list[float], list[float]]]:
    """Return the paired comparison of each agent and measure, with the values alone and together, seed by seed."""
    of = groups(read(NAME), "agent", "way")
    found = {}
    for agent in dict.fromkeys(agent for agent, _ in of):
        for measure in MEASURES:
            alone, together = (
                [float(line[measure]) for line in sorted(of[agent, way], key=lambda line: int(line["seed"]))]
                for way in WAYS
            )
            found[agent, measure] = statistics.compare(together, alone), alone, together
    return found


def detectable(comparison: statistics.Comparison, num_seeds: int) -> float:
    """Return the difference of means that a paired t-test at 5 % finds with `POWER`, normally approximated."""
    normal = NormalDist()
    return (normal.inv_cdf(0.975) + normal.inv_cdf(POWER)) * (comparison.std or 0.0) / math.sqrt(num_seeds)
