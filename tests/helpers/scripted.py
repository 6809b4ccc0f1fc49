"""Tasks of depth one, short curricula of them, and agents that follow a script."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDict

from baselines.ppo import PPO
from ctgraph_rl import Block, CTGraph, Curriculum, Evaluation, Observations, OneHot, Protocol, RunLog, Task
from helpers.paths import CHECKOUT

DECISION_ID = 2

OBSERVATIONS = Observations(decision_ids=(2, 2), wait_ids=(3, 3), end_ids=(4, 4))


def task(goal=(1,), wait_prob: float = 0.0) -> Task:
    return Task(CTGraph(2, len(goal), wait_prob), goal, OBSERVATIONS, OneHot(5))


ONE, TWO = task((1,)), task((2,))
"""Depth 1: an optimal episode takes four steps."""


def decide(decision):
    """A policy that waits where it should and takes one decision, or the decision that a function gives per row."""

    def policy(data):
        deciding = data["observation"][..., DECISION_ID].long()
        return data.set("action", deciding * (decision(data) if callable(decision) else decision))

    return policy


def random_decision(data):
    return torch.randint(1, 3, data.batch_size)


class Scripted:
    """An agent that learns nothing and keeps what happens to it."""

    def __init__(self, policy=None, num_envs: int = 4, num_steps: int = 3) -> None:
        self.num_envs, self.num_steps = num_envs, num_steps
        self.policy = decide(1) if policy is None else policy
        self.events, self.batches, self.rng_states = [], [], []

    def initial_state(self, num_envs: int) -> TensorDict:
        return TensorDict(batch_size=[num_envs])

    def start_task(self, task=None) -> None:
        self.events.append("start")

    def end_task(self) -> None:
        self.events.append("end")

    def learn(self, batch):
        self.events.append(("learn", *batch.batch_size))
        self.batches.append(batch.clone())
        self.rng_states.append(torch.get_rng_state())
        return {"loss_value": 0.5}


def curriculum(*blocks: Block, num_episodes: int = 5, greedy: bool = True) -> Curriculum:
    return Curriculum("scripted", 1, "here", blocks, Evaluation(num_episodes, greedy))


def counting(data):
    """A recurrent policy: its memory counts the steps of the episode."""
    memory = data["memory"].masked_fill(data["is_init"], 0) + 1
    return decide(1)(data).set(("next", "memory"), memory)


THREE = task((2,), wait_prob=0.5)

MIDDLE = Evaluation(4, every=96, greedy=False)


def of(*blocks: Block, evaluation: Evaluation = MIDDLE, **protocol: Any) -> Curriculum:
    return Curriculum("resumed", 1, "here", blocks, evaluation, Protocol(**protocol))


def sequence(*blocks: Block, **parts: Any) -> Curriculum:
    return Curriculum("told", 1, "here", blocks or (Block(ONE, 20), Block(TWO, 28)), **parts)


class Told(Scripted):
    """A scripted agent that keeps what it is told."""

    def start_task(self, task=None) -> None:
        self.events.append(("start", task))

    def policy_for(self, task: int):
        return self.policy


class ScriptedGroup:
    """Agents that act by a script, and keep the batches that each is given."""

    def __init__(self, count: int, policy) -> None:
        self.agents = [Told(policy, num_envs=8, num_steps=4) for _ in range(count)]
        self.generators = []
        self.device_generators = self.greedy_policy = None
        self.policy = policy

    def start_task(self, task=None) -> None:
        pass

    end_task = start_task

    def learn(self, batch):
        return [agent.learn(part) for agent, part in zip(self.agents, batch.chunk(len(self.agents)), strict=True)]


def lines(log: RunLog) -> list[dict[str, Any]]:
    return [{key: value for key, value in line.items() if key != "seconds"} for line in log.measurements]


def first_training(log: RunLog) -> dict[str, float]:
    first = next(line for line in lines(log) if line["kind"] == "training")
    return {key: value for key, value in first.items() if key != "kind"}


PEAK = """
from pathlib import Path

def peak():
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
"""
"""Code of the most bytes that its process has held; those of `resource.getrusage` include its parent's, before exec."""

BARE = ("-c", "import os, torch, torchrl; os._exit(0)")
RUN = ("-m", "ctgraph_rl.run", "agent=ppo", "curriculum=ct2_interfering", f"agent._target_={__name__}.UntilFirstStep")


class UntilFirstStep(PPO):
    """An agent that ends the process when it is asked for its first actions."""

    def __init__(self, *specs: Any, **settings: Any) -> None:
        super().__init__(*specs, **settings)
        self.policy.register_forward_pre_hook(lambda *_: os._exit(0))


def seconds(arguments: Sequence[str]) -> float:
    """Return the processor time of a Python process with these arguments, in an empty directory."""
    before = _processor_time()
    with TemporaryDirectory() as folder:
        path = os.pathsep.join([str(CHECKOUT), str(Path(__file__).parents[1])])
        subprocess.run([sys.executable, *arguments], cwd=folder, check=True, env={**os.environ, "PYTHONPATH": path})
    return _processor_time() - before


def _processor_time() -> float:
    """Return the seconds of all processes that this one has waited for."""
    times = os.times()
    return times.children_user + times.children_system
