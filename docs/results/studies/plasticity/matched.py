"""The matched comparison: is it the start that slows a network down, or its weights?

A network has learned some tasks. Before the next one a fresh network is distilled to its policy and values on that
task's images. Then three learn the task, each with a fresh Adam: a fresh network, the distilled one, and the old one.
The distilled one starts as the old one does, with other weights.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ctgraph_rl import Task, learn_curriculum, make_agent
from ctgraph_rl.learn.exact import ShownTask
from ctgraph_rl.learn.unit_metrics import task_images
from ctgraph_rl.log.provenance import machine
from ctgraph_rl.tasks.protocol import Evaluation
from curricula.axes import sequence
from studies.plasticity.runs import NUM_ENVS, drawn, outcome

LARGEST_KL = 1e-3
"""Of any image."""

LARGEST_ERROR = 0.02
"""Of the value of any image."""

MOST_STEPS = 20_000

EXACT = Evaluation(greedy=False, every=2048, tasks="seen", exact=True)


def distil(student: Any, teacher: Any, task: Task) -> tuple[float, float, int]:
    """Train a learner to another's policy and values on a task's images; return KL, error and steps."""
    shape = tuple(task.observation_shape)
    data = ShownTask(task, shape, None).data(task_images(task, shape), True)
    with torch.no_grad():
        wanted = teacher.outputs(data)
    log_probs, values = wanted["log_probs"], wanted["state_value"]
    optimiser = torch.optim.Adam(student.policy.parameters(), lr=1e-3)
    step = 0
    while True:
        found = student.outputs(data)
        kl = _kl(log_probs, found["log_probs"])
        error = (found["state_value"] - values).squeeze(-1)
        close = kl.max() <= LARGEST_KL and error.abs().max() <= LARGEST_ERROR
        if close or step == MOST_STEPS:
            return kl.max().item(), error.abs().max().item(), step
        loss = kl.mean() + error.square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        step += 1


def _kl(wanted: Tensor, found: Tensor) -> Tensor:
    return (wanted.exp() * (wanted - found)).sum(dim=-1)


def compare(name: str, tasks: Sequence[Task], num_frames: int, seed: int) -> Iterator[dict[str, Any]]:
    """Yield a line for each of three networks that learn the last task after an old one has learned the others."""
    before = sequence(name, tasks[:-1], num_frames, evaluation=Evaluation(greedy=False, exact=True))
    last = sequence(name, tasks[-1:], num_frames, evaluation=EXACT)
    old = make_agent("ppo", before, seed, num_envs=NUM_ENVS)
    learn_curriculum(before, old, seed)
    weights = old.unwrapped.policy.state_dict()
    for network in ("fresh", "distilled", "old"):
        agent = make_agent("ppo", last, seed + 1000, num_envs=NUM_ENVS)  # the same fresh weights twice
        kl, error, steps = 0.0, 0.0, 0
        if network == "distilled":
            kl, error, steps = distil(agent.unwrapped, old.unwrapped, tasks[-1])
        if network == "old":
            agent.unwrapped.policy.load_state_dict(weights)
        torch.manual_seed(seed)
        found = outcome(learn_curriculum(last, agent, seed), 1)
        met = kl <= LARGEST_KL and error <= LARGEST_ERROR
        line = {"curriculum": name, "network": network, "seed": seed, "blocks_before": len(tasks) - 1, **found}
        yield line | {"kl": kl, "error": error, "steps": steps, "met": met, **machine()}


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("curriculum")
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", nargs=2, type=int, default=(0, 10))
    parser.add_argument("--before", type=int, default=1, help="tasks that the old network has learned")
    given = parser.parse_args()
    for seed in range(*given.seeds):
        curriculum = drawn(given.curriculum, given.before + 1, seed)
        for line in compare(given.curriculum, curriculum.tasks[:], curriculum.blocks[0].num_frames, seed):
            with given.out.open("a") as file:
                file.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    main()
