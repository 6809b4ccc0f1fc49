"""Stable-Baselines3's agents with the hyperparameters of ours, for `benchmarks.agents`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import Env
from sb3_contrib import RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from ctgraph_rl import Task
from ctgraph_rl.gym import CTGraphGymEnv
from ctgraph_rl.sb3 import SB3VecEnv

DEFAULT_ROWS = 8

KINDS = {"a2c": A2C, "ppo": PPO, "dqn": DQN, "lstm_ppo": RecurrentPPO}

MakeEnv = Callable[[Task, int], VecEnv]


def single_envs(task: Task, num_rows: int) -> VecEnv:
    """Return Stable-Baselines3's batch of single environments, stepped in turn."""

    def make() -> Env:
        return CTGraphGymEnv(task)

    return make_vec_env(make, num_rows)


def batch(task: Task, num_rows: int) -> VecEnv:
    """Return a batch of this package."""
    return SB3VecEnv(num_rows, task)


def ways() -> dict[str, tuple[MakeEnv, bool]]:
    """Return the environments, and whether the hyperparameters are ours."""
    return {
        "SB3, 256 rows, SB3VecEnv": (batch, True),
        "SB3, 256 rows, make_vec_env": (single_envs, True),
        f"SB3, its defaults, {DEFAULT_ROWS} rows": (batch, False),
    }


class Stable:
    """An agent of Stable-Baselines3.

    Args:
        given: our hyperparameters.
        way: one of `ways`.
    """

    def __init__(self, name: str, given: Mapping[str, Any], task: Task, way: tuple[MakeEnv, bool], seed: int) -> None:
        make_env, like_ours = way
        self.task = task
        self.name = name
        num_rows = given["num_envs"] if like_ours else DEFAULT_ROWS
        policy = "MlpLstmPolicy" if name == "lstm_ppo" else "MlpPolicy"
        more = translated(name, given) if like_ours else {}
        self.model = KINDS[name](policy, make_env(task, num_rows), seed=seed, device="cpu", **more)
        if name == "dqn" and like_ours:
            first = given["eps_init"]
            last = given["eps_end"]
            frames = given["annealing_num_steps"]
            self.model.exploration_schedule = lambda _: max(
                last, first - (first - last) * self.model.num_timesteps / frames
            )
        self.frames = max(num_rows * getattr(self.model, "n_steps", given["num_steps"]), 1024)

    def learn(self) -> int:
        """Learn from one batch, or several small ones."""
        before = self.model.num_timesteps
        self.model.learn(self.frames, reset_num_timesteps=False)
        return self.model.num_timesteps - before

    def success(self) -> float:
        """Return the share of 100 greedy episodes that reach the goal."""
        envs = batch(self.task, 100)
        observation = envs.reset()
        state = None
        starts = np.ones(100, dtype=bool)
        open_ = np.ones(100, dtype=bool)
        outcomes = np.zeros(100)
        while open_.any():
            action, state = self.model.predict(observation, state=state, episode_start=starts, deterministic=True)
            observation, _, starts, infos = envs.step(action)
            for i in (starts & open_).nonzero()[0]:
                outcomes[i] = infos[i]["outcome"]
            open_ &= ~starts
        return float((outcomes == 3).mean())


def translated(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Translate our hyperparameters to Stable-Baselines3's."""
    same = {"learning_rate": given["learning_rate"], "gamma": given["gamma"], "max_grad_norm": given["max_grad_norm"]}
    width = given["hidden_size"]
    rows = given["num_envs"]
    steps = given["num_steps"]
    network: dict[str, Any] = {"activation_fn": nn.ReLU, "optimizer_class": torch.optim.Adam}
    network["net_arch"] = [] if name == "lstm_ppo" else [width, width]
    if name == "dqn":
        keys = ("n_steps", "buffer_size", "batch_size")
        replay = {key: given[key] for key in keys} | {"learning_starts": 0, "train_freq": steps}
        updates = given["num_updates"]
        frames = given["target_update_interval"] * steps * rows // updates
        replay |= {"gradient_steps": updates, "target_update_interval": frames}
        return {**same, **replay, "policy_kwargs": network}
    same |= {key: given[key] for key in ("gae_lambda", "normalize_advantage")}
    same |= {"n_steps": steps, "ent_coef": given["entropy_coeff"], "vf_coef": given["critic_coeff"]}
    if name == "a2c":
        return {**same, "use_rms_prop": False, "policy_kwargs": network}
    if name == "lstm_ppo":
        network |= {"lstm_hidden_size": width, "shared_lstm": True, "enable_critic_lstm": False}
    size = rows * steps // given["num_minibatches"]
    epochs = {"clip_range": given["clip_epsilon"], "n_epochs": given["num_epochs"], "batch_size": size}
    return {**same, **epochs, "policy_kwargs": network}
