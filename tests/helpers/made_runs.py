"""Runs that nobody ran: directories with the files of a run and made-up numbers, for tests of tables and reports."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from ctgraph_rl import RunLog, metrics
from ctgraph_rl.log.provenance import NUMBERS
from ctgraph_rl.log.sums import sum_of, sums_of, write_metrics
from ctgraph_rl.runs.read import find_runs

LABELS = ("goal1", "goal2")
FRAMES = 1000
"""Of each block."""


def write_run(
    path: Path,
    *,
    curriculum: tuple[str, str] = ("two", "f"),
    agent: str = "PPO",
    seed: int = 0,
    performance: Sequence[Sequence[float]] = ((0.0, 0.0), (1.0, 0.0), (0.5, 1.0)),
    labels: Sequence[str] = LABELS,
    intervals: int = 2,
    acted: Sequence[tuple[int, int, int]] = (),
    finished: bool = True,
) -> Path:
    """A run that trains each task in a block of its own.

    Args:
        path: a directory that does not exist.
        curriculum: name and fingerprint.
        agent: its class.
        seed: of the run.
        performance: mean return [blocks + 1][tasks].
        labels: of the tasks.
        intervals: of training in each block.
        acted: of each interval, in order, the label, whether it was learned and whether there is an alarm at its end.
        finished: whether it has metrics.
    """
    path.mkdir(parents=True)
    trained = [(task,) for task in range(len(labels))]
    log = RunLog(path / "run.jsonl")
    about = {"schema": 1, "curriculum": curriculum[0], "fingerprint": curriculum[1], "version": 1, "source": "a test"}
    system = {"versions": {"ctgraph_rl": "0.1.0"}, "numbers": NUMBERS, "machine": "x86_64", "num_threads": 1}
    config = {"agent": {"_target_": f"baselines.made.{agent}", "gamma": 0.9}, "seed": seed, "device": "cpu"}
    numbers = [[task + 1 for task in block] for block in trained]
    log.append("run", **about, **system, tasks=list(labels), trained=numbers, config=config)
    number = 0
    for block, row in enumerate(performance):
        for interval in range(intervals if block else 0):
            frames = (block - 1) * FRAMES + FRAMES * (interval + 1) // intervals
            given = dict(zip(("acted_label", "learned", "alarm"), acted[number] if acted else (), strict=False))
            log.append("training", block=block, frames=frames, episodes=8, return_mean=row[block - 1], **given)
            number += 1
        where = {"moment": "after" if block else "before", "block": block, "frames": block * FRAMES, "held_out": False}
        for task, (label, value) in enumerate(zip(labels, row, strict=True), 1):
            log.append("evaluation", **where, task=task, label=label, return_mean=value, success_rate=value)
    log.close()
    if finished:
        write_metrics(path / "metrics.json", metrics.of_matrix(log.performance(), trained))
    return path


def evaluate(log: RunLog, moment: str, block: int, frames: int, *returns: float, held_out: int = 0) -> None:
    """Evaluations of all tasks at one moment; the last ``held_out`` ones are held out."""
    for task, value in enumerate(returns, 1):
        where = {"block": block, "frames": frames, "task": task, "label": f"goal1.{task}"}
        log.append("evaluation", moment=moment, **where, held_out=task > len(returns) - held_out, return_mean=value)


def learned(log: RunLog, trained=((1,), (2,))) -> RunLog:
    """A whole run of two tasks, evaluated during blocks too, with a held-out third task."""
    log.append("run", schema=1, trained=trained)
    evaluate(log, "before", 0, 0, 0.0, 0.25, 0.5, held_out=1)
    for block, (middle, end) in enumerate((((0.5, 0.25), (1.0, 0.5)), ((1.0, 0.75), (0.75, 1.0))), 1):
        start = 100 * (block - 1)
        log.append("training", block=block, frames=start + 50, episodes=0, return_mean=float("nan"))
        evaluate(log, "during", block, start + 50, *middle, 0.0, held_out=1)
        log.append("training", block=block, frames=start + 100, episodes=4, return_mean=block / 4)
        evaluate(log, "after", block, start + 100, *end, 0.0, held_out=1)
    return log


def make_run(folder, seed: int, returns=(1.0, 0.5), finished: bool = True, curriculum: str = "two", **agent):
    """A run of two tasks that ends with the returns."""
    path = folder / f"{agent.get('name', 'ppo')}-{curriculum}-{seed}-{len(list(folder.iterdir()))}"
    path.mkdir()
    config = {"agent": {"_target_": f"baselines.{agent.pop('name', 'ppo')}.PPO", **agent}, "seed": seed}
    log = RunLog(path / "run.jsonl")
    log.append("run", schema=1, curriculum=curriculum, fingerprint="f", config=config, trained=[[1], [2]])
    for block, values in ((0, (0.0, 0.0)), (1, (1.0, 0.0)), (2, returns)):
        for task, value in enumerate(values, 1):
            log.append(
                *("evaluation",),
                **{"moment": "after" if block else "before", "block": block, "frames": block, "task": task},
                **{"label": f"goal{task}", "held_out": False, "return_mean": value, "success_rate": value},
            )
    log.close()
    if finished:
        write_metrics(path / "metrics.json", metrics.summary(log.performance(), [(0,), (1,)]))
    return path


def all_runs(paths):
    """All runs of folders that hold nothing else."""
    runs, problems = find_runs(paths)
    assert problems == []
    return runs


def line(rows, measure: str, agent: str = "PPO"):
    (found,) = [row for row in rows if (row.measure, row.agent) == (measure, agent)]
    return found


def sum_again(run_dir: Path) -> None:
    """Give a finished run whose files were changed the sums of these."""
    content = json.loads((run_dir / "metrics.json").read_text())
    content.pop("files", None)
    sums = {"run": "0", **sums_of(run_dir), "metrics.json": sum_of(json.dumps(content).encode())}
    (run_dir / "metrics.json").write_text(json.dumps({"files": sums, **content}))
