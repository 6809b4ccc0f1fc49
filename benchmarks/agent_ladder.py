"""How fast agents learn on one device: ``python -m benchmarks.agents --device cuda``.

PPO and LSTM-PPO learn as in a run: step by step, captured, and PPO compiled. Many seeds learn as one job, with stacked
weights. The yardstick is the environment with given actions, on the same device in the same run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml

from baselines.parts.policy_gradient import PolicyGradient
from baselines.update.captured import CapturedGroup
from benchmarks.environment_ladder import WAYS, Rung, TimedRun
from ctgraph_rl.batch.specs import make_specs
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.packages import class_named, conf_dir
from ctgraph_rl.tasks.configurations import ct_fo_b1, ct_su_b1
from ctgraph_rl.tasks.task import Task

ENVIRONMENT = "environment only"

TASKS = {
    "ppo": ("CT-FO-B1", ct_fo_b1((1, 2))),
    "ppo_published": ("CT-FO-B1", ct_fo_b1((1, 2))),
    "lstm_ppo": ("CT-SU-B1", ct_su_b1((1, 2))),
}

GOALS = {"ppo": 10e6, "lstm_ppo": 1e6}
"""Environment steps a second for one agent to learn from."""

MAIN_JOB = 4 * 204_800

SEEDS_GOAL = 1024 * MAIN_JOB / (15 * 60)
"""Environment steps a second for 1,024 seeds of the main job in 15 minutes."""

ENDLESS = 10**6


def rungs(device: torch.device, num_rows: Sequence[int], num_seeds: Sequence[int]) -> Iterator[Rung]:
    """Yield what is measured, in the order of the table.

    Args:
        num_rows: environments of one agent, of those with a goal.
        num_seeds: agents of one job, each with its yaml file's environments.
    """
    for name, (label, task) in TASKS.items():
        ways: dict[str, dict[str, bool]] = {"step by step": {"captured": False}, "captured": {}}
        ways |= {"compiled and captured": {"compile": True}} if name == "ppo" else {}
        for n in num_rows if name in GOALS else ():
            yield Rung(ENVIRONMENT, label, n, partial(WAYS["rollout, captured"], [task] * n, device))
            for way, how in ways.items():
                yield Rung(f"{name}, {way}", label, n, partial(learning, name, task, n, device, **how), GOALS[name])
        for count in num_seeds:
            n = count * settings(name)["num_envs"]
            goal = SEEDS_GOAL if name == "lstm_ppo" else 0.0
            yield Rung(f"{name}, {count:,} seeds as one job", label, n, partial(seeds, name, task, count, device), goal)


def settings(name: str) -> dict[str, Any]:
    """Return an agent's yaml file with those that it starts from."""
    own = yaml.safe_load(Path(conf_dir(), "agent", f"{name}.yaml").read_text(encoding="utf-8"))
    before = [settings(other) for other in own.pop("defaults", []) if other != "_self_"]
    return {key: value for each in (*before, own) for key, value in each.items()}


def built(name: str, task: Task, **changes: Any) -> PolicyGradient:
    """Return an agent on the CPU, with its yaml file's hyperparameters and changes."""
    values = {**settings(name), **changes}
    module, _, of_class = values.pop("_target_").rpartition(".")
    kind: Any = class_named(module, of_class)
    return kind(*make_specs([task]), **values)


def learning(
    name: str, task: Task, num_envs: int, device: torch.device, captured: bool = True, compile: bool = False
) -> TimedRun:
    """Return a run in which an agent learns from a batch."""
    changes = {"num_envs": num_envs, **({"compile": True} if compile else {})}
    agent = built(name, task, **changes).to(device)
    agent.capturable = agent.policy.capturable = captured  # type: ignore[misc]
    env = CTGraphEnv([task] * num_envs, device=device, check_actions=False, info=False)
    agent.start_task()
    frames = ENDLESS * num_envs * agent.num_steps
    collected = collect(env, agent.policy, frames, agent.num_steps, agent.initial_state)

    def run() -> int:
        batch = next(collected)
        agent.learn(batch)
        return batch.numel()

    return run


def seeds(name: str, task: Task, num_seeds: int, device: torch.device) -> TimedRun:
    """Return a run of many seeds, as of ``together=true``, each learning from its batch."""
    agents = [built(name, task).to(device) for _ in range(num_seeds)]
    generators = [torch.Generator(device="cpu").manual_seed(seed) for seed in range(num_seeds)]
    group = CapturedGroup(agents, generators)
    num_envs = agents[0].num_envs
    num_steps = agents[0].num_steps
    env = CTGraphEnv([task] * num_seeds * num_envs, device=device, check_actions=False, info=False)
    row = torch.arange(num_seeds * num_envs, device=device)
    env.rows.set_streams(row // num_envs, row % num_envs)
    frames = ENDLESS * env.numel() * num_steps
    collected = collect(env, group.policy, frames, num_steps, agents[0].initial_state)

    def run() -> int:
        batch = next(collected)
        group.learn(batch)
        return batch.numel()

    return run
