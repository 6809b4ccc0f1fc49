"""The separate process that learns runs again, from a configuration or by the code of others.

``python -m ctgraph_rl.board.relearn JOB.json [CODE ...]`` writes a run directory for each seed into the working
directory. Modules of others are looked for in the folders CODE, after all that are installed.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig

from ctgraph_rl.checks import ReadOnlyValues, require
from ctgraph_rl.runs import config
from ctgraph_rl.runs.job import run_as_one, run_job
from ctgraph_rl.runs.settings import with_added
from ctgraph_rl.tasks.curriculum import Curriculum


class Relearning(NamedTuple):
    """What a process learns, as plain values."""

    seeds: Sequence[int]  # several are trained as one batch
    config: ReadOnlyValues  # without the seed
    num_threads: int
    entry_point: str | None  # module:function of a learner that is not ours
    curriculum: str | None = None  # file of what it learns; None: what the configuration says


def run_dir_of(folder: Path, seed: int) -> Path:
    """Return the run directory of a seed within the folder of its process."""
    return folder / f"seed{seed}"


def learn_again(job: Relearning, folder: Path) -> None:
    """Learn every seed of a job into a run directory within a folder.

    Raises:
        ValueError: for a configuration or an entry point that cannot run here.
        RuntimeError: if stacked seeds failed.
    """
    run_dirs = [run_dir_of(folder, seed) for seed in job.seeds]
    if job.entry_point is not None:
        module, _, name = job.entry_point.partition(":")
        function = getattr(import_module(module), name, None)
        require((callable(function), f"entry_point {job.entry_point}: {module} has no function {name}"))
        torch.set_num_threads(job.num_threads)
        function(Curriculum.from_json(str(job.curriculum)), job.seeds[0], run_dirs[0])  # type: ignore[misc]
        return
    runs = []
    for seed, run_dir in zip(job.seeds, run_dirs, strict=True):
        run_dir.mkdir(exist_ok=True)
        settings = {**job.config, "seed": seed}
        if job.curriculum is not None:
            target = "ctgraph_rl.tasks.curriculum.Curriculum.from_json"
            settings["curriculum"] = {"_target_": target, "path_or_dict": job.curriculum}
        runs.append((configuration(settings), run_dir))
    if len(runs) > 1:
        run_as_one(runs)
    else:
        run_job(*runs[0])


def configuration(stored: ReadOnlyValues) -> DictConfig:
    """Return a run's stored settings as a configuration, with defaults for all that changes no result."""
    settings = dict(config.composed([]))
    settings |= {key: with_added(value) if isinstance(value, Mapping) else value for key, value in stored.items()}
    return DictConfig(settings)


if __name__ == "__main__":
    sys.path += sys.argv[2:]
    os.environ["PYTHONPATH"] = os.pathsep.join([os.environ.get("PYTHONPATH", ""), *sys.argv[2:]])
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    learn_again(Relearning(**job), Path.cwd())
