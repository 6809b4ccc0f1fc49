"""Records what l2metrics 3.1.0 says of runs: ``python record.py PYTHON [RUN]``, a Python that has l2metrics.

Writes one JSON file a case beside this file: the regimes, the experts, the settings, and l2metrics' lifetime metrics.
Regimes are made up, but for those of the run directory, where one is given.
Current NumPy has no ``np.NaN``, which l2metrics needs; the command below puts it back.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from ctgraph_rl.log.export import task_names, write_l2logger
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.metrics import Regime

PROGRAM = "import numpy, runpy; numpy.NaN = numpy.nan; runpy.run_module('l2metrics', run_name='__main__')"
LIFETIME = (
    *("perf_recovery", "avg_train_perf", "avg_eval_perf", "perf_maintenance_mrlep", "perf_maintenance_mrtlp"),
    *("forward_transfer_ratio", "forward_transfer_contrast", "backward_transfer_ratio", "backward_transfer_contrast"),
    *("ste_rel_perf", "sample_efficiency"),
)
UNSCALED = ["-n", "none", "-g", "none"]


def curve(rng: random.Random, length: int, start: float, end: float, zeros: float = 0.0) -> list[float]:
    """A noisy rise or fall; a share of the values is exactly 0."""
    line = [start + (end - start) * i / length + rng.uniform(-0.2, 0.2) for i in range(length)]
    return [0.0 if rng.random() < zeros else round(value, 4) for value in line]


def learned(rng: random.Random, order: str, lengths: list[int], initial: bool = True, zeros: float = 0.0) -> list:
    """Regimes of a run that trains tasks in order and evaluates all of them between."""
    tasks = sorted(set(order))
    regimes = []
    for i, task in enumerate(order if not initial else f" {order}"):
        if task != " ":
            length = lengths[(i - initial) % len(lengths)]
            regimes.append([task, True, curve(rng, length, rng.uniform(0, 0.4), rng.uniform(0.4, 1), zeros)])
        regimes += [[name, False, curve(rng, 1, rng.uniform(0.2, 1), 0, zeros)] for name in tasks]
    return regimes


def cases() -> dict[str, dict]:
    """Everything that a case needs, by its name."""
    rng = random.Random(8)
    three = learned(rng, "abc", [40])
    again = learned(rng, "abababb", [30, 25, 3])
    sparse = learned(rng, "abcab", [20], zeros=0.6)
    late = learned(rng, "aba", [130, 600], initial=False)
    flat = [[task, training, [0.5] * len(values) if task == "a" else values] for task, training, values in three]
    experts = {"a": [curve(rng, 40, 0.1, 0.9)], "b": [curve(rng, 30, 0.1, 1), curve(rng, 50, 0.3, 0.7)]}
    ranges = {"a": [0.0, 1.0], "b": [-0.5, 1.5], "c": [0.0, 2.0]}
    return {
        "in_order": {"regimes": three, "experts": experts},
        "in_order_with_ranges": {"regimes": three, "experts": experts, "ranges": ranges},
        "in_order_unscaled": {"regimes": three, "experts": experts, "settings": UNSCALED},
        "again": {"regimes": again, "experts": experts},
        "again_unscaled": {"regimes": again, "experts": experts, "settings": UNSCALED},
        "sparse_unscaled": {"regimes": sparse, "settings": UNSCALED},
        "sparse": {"regimes": sparse, "experts": experts},
        "no_initial_evaluation": {"regimes": late, "experts": experts},
        "constant_task": {"regimes": flat},
    }


def regime(task: str, training: bool, values: list[float]) -> Regime:
    """A regime of plain values."""
    return Regime(task, training, torch.tensor(values, dtype=torch.float64))


def measure(python: str, case: dict) -> dict[str, float | None]:
    """What l2metrics says of a case."""
    with tempfile.TemporaryDirectory() as scratch:
        return _measure(python, case, Path(scratch))


def _measure(python: str, case: dict, scratch: Path) -> dict[str, float | None]:
    regimes = [regime(*each) for each in case["regimes"]]
    names = task_names(regimes)
    write_l2logger(regimes, scratch / "run")
    environment = {**os.environ, "L2DATA": str(scratch / "l2data"), "MPLBACKEND": "agg"}
    command = [python, "-c", PROGRAM]
    for task, curves in case.get("experts", {}).items():
        for i, values in enumerate(curves):
            folder = scratch / f"expert_{task}_{i}"
            alone = [regime(task, True, values)]
            write_l2logger(alone, folder)
            log = next(folder.rglob("data-log.tsv"))
            log.write_text(log.read_text().replace(task_names(alone)[task], names[task]))
            subprocess.run([*command, "-s", "a", "-l", folder], env=environment, cwd=scratch, check=True)
    settings = case.get("settings", [])
    if "ranges" in case:
        (scratch / "ranges.json").write_text(
            json.dumps({names[task]: {"min": low, "max": high} for task, (low, high) in case["ranges"].items()})
        )
        settings = [*settings, "-d", scratch / "ranges.json"]
    both = ["-t", "both", "-m", "both", "--no-plot", "-O", scratch, "-o", "out"]
    subprocess.run([*command, "-l", scratch / "run", *both, *settings], env=environment, cwd=scratch, check=True)
    found = json.loads((scratch / "out_metrics.json").read_text())
    return {name: found.get(name) for name in LIFETIME}


def recorded(run: str) -> dict:
    """The case of a run directory, with the range that is known."""
    log = RunLog.read(Path(run) / "run.jsonl")
    blocks = range(len(log.ends()) - 1)
    regimes = [[each.task, each.training, each.values.tolist()] for each in log.regimes([[block] for block in blocks])]
    return {"regimes": regimes, "ranges": {task: [0.0, 1.0] for task, _, _ in regimes}}


def main(python: str, run: str | None = None) -> None:
    """Record all cases."""
    found = cases() if run is None else {**cases(), "recorded_run": recorded(run)}
    for name, case in found.items():
        content = {**case, "l2metrics": measure(python, case)}
        (Path(__file__).parent / f"{name}.json").write_text(json.dumps(content) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
