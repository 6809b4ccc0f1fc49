"""Success in each episode of a trial, which has one goal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from studies.raw import Raw, groups, machine_of

if TYPE_CHECKING:
    from ctgraph_rl.runs.load import Trained

NAME = "rl2_search"
TRIALS = 1000
SEED = 2023
"""Of the evaluation, the same for all runs."""

SEEDS = 5
SOLVED = 0.95
"""Share of the last episodes of trials that reach the goal, from which on a seed has learned to search."""


def collect(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Return a line for each episode of the trials of each run under some folders; only depths with five seeds."""
    from ctgraph_rl import load

    runs = [path.parent for folder in folders for path in sorted(folder.rglob("metrics.json"))]
    lines = [line for run in runs for line in searched(run, load(run))]
    return [line for of_depth in groups(lines, "depth").values() for line in whole(of_depth)]


def whole(lines: Raw) -> Raw:
    """Return lines of five seeds or none."""
    return lines if len({line["seed"] for line in lines}) >= SEEDS else []


def searched(run: Path, trained: Trained) -> list[dict[str, Any]]:
    """Return a line for each episode of a trial: how many of `TRIALS` trials reach the goal in it, greedy and sampled.

    The goals of the trials are uniform: as many trials of each task, and a trial has its task's goal.
    """
    from ctgraph_rl.tasks.task import ct_graphs

    tasks, about = trained.curriculum.tasks, trained.log.of_kind("run")[0]
    found = {way: successes(trained, greedy) for way, greedy in (("greedy", True), ("sampled", False))}
    common = {
        "depth": ct_graphs(tasks, "this study")[0].graph.depth,
        "agent": run.name.split("-seed")[0],
        "seed": trained.seed,
        "frames": trained.frames,
        "fingerprint": trained.curriculum.fingerprint,
        **machine_of(about),
    }
    shares = zip(found["greedy"], found["sampled"], strict=True)
    return [
        {**common, "episode": i, "greedy_success": greedy, "sampled_success": sampled}
        for i, (greedy, sampled) in enumerate(shares, 1)
    ]


def successes(trained: Trained, greedy: bool) -> list[float]:
    """Return the share of trials that reach the goal in each of their episodes."""
    from ctgraph_rl import evaluate

    tasks = trained.curriculum.tasks
    n = len(tasks)
    ends = evaluate(
        trained.policy_for(tasks[0]),
        tasks,
        TRIALS // n * n,
        seed=SEED,
        greedy=greedy,
        initial_state=trained.agent.initial_state,
        curriculum=trained.curriculum,
        episodes_per_row=n,
    )
    return (ends["outcome"] == 3).view(-1, n).double().mean(0).tolist()


def searching(lines: Raw) -> list[bool]:
    """Return for each seed whether it finds the goal by the last episode of a trial."""
    last = max(int(line["episode"]) for line in lines)
    return [float(line["greedy_success"]) >= SOLVED for line in lines if int(line["episode"]) == last]
