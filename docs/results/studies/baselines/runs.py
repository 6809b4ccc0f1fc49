"""Raw results of agents that each learned one task, and of the main job."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from studies.baselines import search
from studies.baselines.instances import INSTANCES, MEMORY
from studies.raw import Raw, groups, machine_of, write

if TYPE_CHECKING:
    from ctgraph_rl.runs.load import Trained

AGENTS = ("baselines_b1", "baselines_fo_b2", "depth_ladder")
"""Tables of agents that each learned one task."""

BY_FIVES = (INSTANCES, MEMORY)
"""Tables that only have cells of five seeds that finished, as they may be collected before all are run."""

REWARDS_MET = "rewards_met"

EPISODES = 1000
SEED = 2023
"""Of the episodes, the same for all agents."""


def collect(name: str, folders: Sequence[Path]) -> None:
    """Write the raw results of all runs under some folders.

    Tables of agents have a line for each run with what its trained agent gets on its task in `EPISODES` greedy and as
    many sampled episodes; a run that did not finish has its reason. ``rewards_met`` has how often a run met the goal's
    reward while learning.
    """
    from rich.progress import track

    if name == "main_job":
        return _collect_main_job(folders)
    if name == search.NAME:
        return write(name, search.collect(folders))
    logs = [path for folder in folders for path in folder.rglob("run.jsonl")]
    runs = sorted(path.parent for path in logs if "experts" not in path.parts)
    measure = rewards_met if name == REWARDS_MET else measured
    lines = [measure(run) for run in track(runs, f"{len(runs)} runs")]
    lines.sort(
        key=lambda line: [str(line[key]) for key in ("configuration", "depth", "task", "agent")] + [line["seed"]]
    )
    write(name, five_seeds(lines) if name in BY_FIVES else lines)


def five_seeds(lines: Raw) -> Raw:
    """Return the lines of cells of which five seeds finished."""
    done = groups([line for line in lines if not line["failed"]], "configuration", "task", "agent")
    return [line for cell in done.values() if len(cell) >= search.SEEDS for line in cell]


def who_learned(run_dir: Path, trained: Trained) -> dict[str, Any]:
    """The part of a line that says what was learned by whom."""
    from ctgraph_rl.tasks.task import ct_graphs

    (task,) = ct_graphs(trained.curriculum.tasks, "this study")
    about = trained.log.of_kind("run")[0]
    configured = about["config"]["curriculum"]
    return {
        "configuration": configured.get("configuration", trained.curriculum.name),
        "depth": task.graph.depth,
        "task": ".".join(map(str, task.goal)),
        "agent": run_dir.name.split("-seed")[0],
        "seed": trained.seed,
        "frames": trained.frames,
        "fingerprint": trained.curriculum.fingerprint,
        **machine_of(about),
    }


def rewards_met(run_dir: Path) -> dict[str, Any]:
    """One line: what was learned by whom, the finished episodes of training, and those that reached the goal."""
    from ctgraph_rl import load

    trained = load(run_dir)
    episodes, rates = trained.log.training("episodes"), trained.log.training("success_rate")
    goals = (episodes * rates.nan_to_num(0)).round().sum()
    return {**who_learned(run_dir, trained), "episodes": int(episodes.sum()), "rewards_met": int(goals)}


def measured(run_dir: Path) -> dict[str, Any]:
    """One line: what was learned by whom, and the mean return and success of the trained agent."""
    from ctgraph_rl import evaluate, load

    failed = run_dir / "failed.txt"
    trained = load(run_dir)
    from ctgraph_rl.tasks.task import ct_graphs

    (task,) = ct_graphs(trained.curriculum.tasks, "this study")
    line = who_learned(run_dir, trained)
    for way, greedy in (("greedy", True), ("sampled", False)):
        ends = evaluate(
            trained.policy_for(task),
            [task],
            EPISODES,
            seed=SEED,
            greedy=greedy,
            initial_state=trained.agent.initial_state,
            curriculum=trained.curriculum,
        )
        line[f"{way}_return"] = round(ends["episode_reward"].double().mean().item(), 6)
        line[f"{way}_success"] = (ends["outcome"] == 3).double().mean().item()
    finished = (run_dir / "metrics.json").exists()
    reason = failed.read_text(encoding="utf-8").strip() if failed.exists() else "not finished"
    return {**line, "failed": "" if finished else reason}


def _collect_main_job(folders: Sequence[Path]) -> None:
    """Write the evaluations of all runs of the main job under some folders."""
    from ctgraph_rl.log.files import LOG
    from ctgraph_rl.log.run_log import RunLog

    lines = []
    for run in sorted(path for folder in folders for path in folder.rglob("evaluations.csv")):
        kept, (about,) = (
            ("seed", "block", "frames", "label", "return_mean"),
            RunLog.read(run.parent / LOG).of_kind("run"),
        )
        with open(run, newline="", encoding="utf-8") as file:
            lines += [{**{key: line[key] for key in kept}, **machine_of(about)} for line in csv.DictReader(file)]
    write("main_job", lines)
