"""How fast agents learn on one device: ``python -m baselines.benchmark --device cuda``.

PPO and LSTM-PPO learn as in a run: step by step, captured, and PPO compiled as well. Many seeds learn as one job, with
stacked weights. The yardstick is the environment alone, with given actions, on the same device and in the same run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from tensordict import TensorDictBase
from torch import Tensor

from baselines.parts.networks import draw
from baselines.parts.policy_gradient import PolicyGradient, generalized_advantages
from baselines.update.stack import Stack
from baselines.update.update import update
from benchmarks.environment_ladder import WAYS, Run, Rung
from ctgraph_rl.batch.specs import specs_of
from ctgraph_rl.core.region import Region, captures
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.packages import class_named, conf_dir
from ctgraph_rl.tasks.configurations import ct_fo_b1, ct_su_b1
from ctgraph_rl.tasks.task import Task

ENVIRONMENT = "environment alone"

TASKS = {
    "ppo": ("CT-FO-B1", ct_fo_b1((1, 2))),
    "ppo_published": ("CT-FO-B1", ct_fo_b1((1, 2))),
    "lstm_ppo": ("CT-SU-B1", ct_su_b1((1, 2))),
}

GOALS = {"ppo": 10e6, "lstm_ppo": 1e6}
"""Environment steps a second that one agent shall learn from."""

MAIN_JOB = 4 * 204_800
"""Frames of a seed of the main job, LSTM-PPO on ``su_b1_4tasks``."""

SEEDS_GOAL = 1024 * MAIN_JOB / (15 * 60)
"""Environment steps a second of 1,024 seeds of the main job in 15 minutes."""

ENDLESS = 10**6
"""Batches; more than are measured."""


def rungs(device: torch.device, num_rows: Sequence[int], num_seeds: Sequence[int]) -> Iterator[Rung]:
    """Yield what is measured, in the order of the table.

    Args:
        device: where environment and agents live.
        num_rows: environments of one agent, of those with a goal.
        num_seeds: agents that learn as one job, each with the environments of its yaml file.
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
    """Return what an agent's yaml file says, over what the files say that it starts from."""
    own = yaml.safe_load(Path(conf_dir(), "agent", f"{name}.yaml").read_text(encoding="utf-8"))
    before = [settings(other) for other in own.pop("defaults", []) if other != "_self_"]
    return {key: value for each in (*before, own) for key, value in each.items()}


def built(name: str, task: Task, **changes: Any) -> PolicyGradient:
    """Return an agent on the CPU, with the hyperparameters of its yaml file and changes of them."""
    values = {**settings(name), **changes}
    module, _, of_class = values.pop("_target_").rpartition(".")
    kind: Any = class_named(module, of_class)
    return kind(*specs_of([task]), **values)


def learning(
    name: str, task: Task, num_envs: int, device: torch.device, captured: bool = True, compile: bool = False
) -> Run:
    """Return a run of one agent: it learns from a batch."""
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


def seeds(name: str, task: Task, num_seeds: int, device: torch.device) -> Run:
    """Return a run of many seeds of an agent: each learns from a batch of its own."""
    group = Seeds([built(name, task) for _ in range(num_seeds)], task, device)
    return lambda: group.learn(next(group.batches))


class Seeds:
    """Seeds of one agent on one device, whose networks act and learn as one stack.

    All draw from the device's generator, so their numbers are not those of seeds in `baselines.update.seeds.Group`,
    which have one generator each; the arithmetic is the same.

    Args:
        learners: one for each seed, on the CPU.
        task: what all learn.
        device: where they learn.
    """

    capturable = True

    def __init__(self, learners: Sequence[PolicyGradient], task: Task, device: torch.device) -> None:
        self.first, self.count = learners[0], len(learners)
        self.num_envs, self.num_steps = self.first.num_envs, self.first.num_steps
        learners = [learner.to(device) for learner in learners]
        self.stack = Stack(learners)
        num_rows = self.count * self.num_envs
        env = CTGraphEnv([task] * num_rows, device=device, check_actions=False, info=False)
        row = torch.arange(num_rows, device=device)
        env.rows.set_streams(row // self.num_envs, row % self.num_envs)
        frames = ENDLESS * num_rows * self.num_steps
        self.batches = collect(env, self, frames, self.num_steps, self.first.initial_state)
        self.update = Region(self.gradient_step) if captures(device) else self.gradient_step

    def __call__(self, data: TensorDictBase) -> TensorDictBase:
        """Write the actions of all seeds, [seeds * num_envs], and what they need to learn from them."""
        given = {key: data[key].unflatten(0, (self.count, -1)) for key in self.first.trunk.in_keys}
        written = self.stack.one_step(given)
        log_probs = written.pop("log_probs")
        action = draw(log_probs.softmax(dim=-1))
        written |= {"action": action, "action_log_prob": log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1)}
        for key, value in written.items():
            data.set(key, value.flatten(0, 1))
        return data

    def learn(self, batch: TensorDictBase) -> int:
        """Let all seeds learn from a batch, [seeds * num_envs, num_steps]; return its frames."""
        items = self._items(batch)
        size = items["action"].shape[1] // self.first.num_minibatches
        for _ in range(self.first.num_epochs):
            order = torch.rand(items["action"].shape[:2], device=batch.device, dtype=torch.float32).argsort(dim=1)
            for part in order.split(size, dim=1):
                self.update({key: _taken(value, part) for key, value in items.items()})
        return batch.numel()

    @torch.no_grad()
    def _items(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return what the seeds learn from, [seeds, items, ...] each: frames, or with memory rows."""
        after, values = batch["next"], batch["state_value"]
        last = {key: after[key][:, -1].unflatten(0, (self.count, -1)) for key in self.first.trunk.in_keys}
        of_last = self.stack.one_step(last)["state_value"].flatten(0, 1)
        following = torch.cat([values[:, 1:], of_last.unsqueeze(1)], dim=1)
        given = (values, following, after["reward"], after["done"], after["terminated"])
        advantage, target = generalized_advantages(self.first.gamma, self.first.gae_lambda, *given)
        keys = (*self.first.trunk.in_keys, "action", "action_log_prob")
        items = {key: batch[key] for key in keys} | {"advantage": advantage, "value_target": target}
        end = 0 if self.first.memory else 1
        return {key: value.unflatten(0, (self.count, -1)).flatten(1, 1 + end) for key, value in items.items()}

    def gradient_step(self, minibatch: dict[Any, Tensor]) -> dict[str, Tensor]:
        """Take a gradient step of all seeds on minibatches, [seeds, items, ...]; return losses and norms, [seeds]."""
        return update(self.first, self.stack.state, minibatch)


def _taken(value: Tensor, items: Tensor) -> Tensor:
    """Return items of each seed, int64 [seeds, n], of a tensor [seeds, items, ...]."""
    first = torch.arange(len(value), device=value.device).unsqueeze(1) * value.shape[1]
    return value.flatten(0, 1).index_select(0, (first + items).flatten()).unflatten(0, items.shape)
