"""Runs of the study: ``python -m studies.plasticity.runs CURRICULUM OUT`` appends a line for each block of each run."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import curricula
from ctgraph_rl import learn_curriculum, make_agent
from ctgraph_rl.learn.unit_metrics import UnitMeter, weights_of
from ctgraph_rl.log.provenance import machine
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Curriculum

NUM_ENVS = 64

PLAIN = ("none", "fresh")
"""Conditions without a method: fine-tuning, and a network with new weights in each block."""

REACHED = 0.9


def drawn(name: str, num_tasks: int, seed: int) -> Curriculum:
    """Return a stream that a seed draws, evaluated exactly with sampled actions every 2,048 frames."""
    found = curricula.load(name, num_tasks=num_tasks).for_seed(seed)
    return replace(found, evaluation=replace(found.evaluation, greedy=False, every=2048))


def make(curriculum: Curriculum, condition: str, seed: int, settings: dict[str, Any]) -> Any:
    """Return the agent of a condition, which measures its units before each change of task."""
    if condition in PLAIN:
        return make_agent("ppo", curriculum, seed, num_envs=NUM_ENVS, **settings)
    return make_agent("ppo", curriculum, seed, plasticity=condition, plasticity_settings=settings, num_envs=NUM_ENVS)


def watch(agent: Any, at_change: Callable[[int], None]) -> None:
    """Call a function with the number of each block from the second on, before it starts."""
    start = agent.start_task
    started = 0

    def start_task(task: int | None = None) -> None:
        nonlocal started
        started += 1
        if started > 1:
            at_change(started)
        start(task)

    agent.start_task = start_task


def renew(agent: Any, condition: str) -> None:
    """Draw a fresh network's weights at a change of task."""
    learner = agent.unwrapped
    if condition == "fresh":
        learner.reset_parameters()
        learner.clear_optimiser_state(learner.trainable)


def run(curriculum: Curriculum, condition: str, seed: int, settings: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a line for each block of a run."""
    agent = make(curriculum, condition, seed, settings)
    units = RunLog()
    meter = UnitMeter(curriculum, agent, units, True)
    norms: dict[int, float] = {1: 0.0}

    def at_change(block: int) -> None:
        meter.measure(block, curriculum.ends[block - 2], "start")
        norms[block] = sum(float(each.square().sum()) for each in weights_of(agent)) ** 0.5
        renew(agent, condition)

    watch(agent, at_change)
    began = time.process_time()
    log = learn_curriculum(curriculum, agent, seed)
    seconds = time.process_time() - began
    for number in range(1, len(curriculum.blocks) + 1):
        line = {"curriculum": curriculum.name, "condition": condition, "settings": json.dumps(settings), "seed": seed}
        line |= {"block": number, **outcome(log, number), "norm_weights": norms[number]}
        for found in units.of_kind("units"):
            if found["block"] == number:
                measured = {key: value for key, value in found.items() if key.startswith(("dormant", "dead", "rank"))}
                line |= {f"{key}_{found['images']}": value for key, value in measured.items()}
        yield line | {"seconds": round(seconds, 2), **machine()}


def outcome(log: RunLog, block: int) -> dict[str, Any]:
    """Return the area under the present task's success over a block, and whether it reached `REACHED`."""
    curve = []
    for line in log.of_kind("evaluation"):
        if line["block"] == line["task"] == block:
            curve.append(line["success_rate"])
    return {"area": sum(curve) / len(curve), "reached": max(curve) >= REACHED, "end": curve[-1]}


def main() -> None:
    """Do what the command line says; a cell that has lines is not run again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("curriculum")
    parser.add_argument("out", type=Path)
    parser.add_argument("--conditions", nargs="+", default=PLAIN)
    parser.add_argument("--seeds", nargs=2, type=int, default=(0, 10))
    parser.add_argument("--tasks", type=int, default=2)
    parser.add_argument("--settings", type=Path, help="of conditions, as JSON: one of each, or a list to try")
    given = parser.parse_args()
    chosen = json.loads(given.settings.read_text()) if given.settings else {}
    done = set()
    if given.out.exists():
        lines = map(json.loads, given.out.read_text().splitlines())
        done = {(line["condition"], line["settings"], line["seed"]) for line in lines}
    for seed in range(*given.seeds):
        for condition in given.conditions:
            trials = chosen.get(condition, {})
            for settings in trials if isinstance(trials, list) else [trials]:
                if (condition, json.dumps(settings), seed) in done:
                    continue
                curriculum = drawn(given.curriculum, given.tasks, seed)
                try:
                    found = list(run(curriculum, condition, seed, settings))
                except FloatingPointError as error:
                    found = [
                        {"condition": condition, "settings": json.dumps(settings), "seed": seed, "error": str(error)}
                    ]
                with given.out.open("a") as file:
                    for line in found:
                        file.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    main()
