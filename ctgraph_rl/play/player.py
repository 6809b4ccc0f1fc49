"""One row of an environment, step by step, whose states and end can be read."""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import TRIAL, InitialState, Policy, make_env
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import Task


class Player:
    """Plays a task in a separate environment; a policy draws from torch's global generator.

    Args:
        policy: acts where no action is given, as for `evaluate`; None: an action must be given.
        greedy: most likely actions; False samples and explores as in training.
        curriculum: whose task ids the policy sees, if its protocol shows them.
    """

    def __init__(
        self,
        task: Task,
        policy: Policy | None = None,
        initial_state: InitialState | None = None,
        seed: int = 0,
        greedy: bool = True,
        curriculum: Curriculum | None = None,
    ) -> None:
        self.task = task
        self.seed = seed
        self.env: EnvBase = CTGraphEnv([task], seed)
        if curriculum is not None:
            shown = replace(curriculum, protocol=replace(curriculum.protocol, episodes="shown"))
            self.env = make_env(shown, [task], seed)
        self.policy = policy(self.env) if isinstance(policy, type) else policy
        self.memory = TensorDict(batch_size=[1]) if initial_state is None else initial_state(1)
        self.exploration = ExplorationType.DETERMINISTIC if greedy else ExplorationType.RANDOM
        self.data: TensorDictBase = TensorDict(batch_size=[1])

    @torch.no_grad()
    def start(self) -> None:
        """Begin an episode; a trial continues, as in `evaluate`."""
        goes_on = TRIAL in self.memory.keys() and not self.data.is_empty()  # noqa: SIM118, it iterates over rows
        memory = self.data.select(*self.memory.keys()) if goes_on else self.memory
        self.data = self.env.reset().update(memory)

    @torch.no_grad()
    def step(self, action: int | None = None) -> bool:
        """Take a step with an action, or the policy's; True where the episode is over."""
        if action is not None:
            acted = self.data.set("action", torch.tensor([action], dtype=torch.int64, device="cpu"))
        else:
            assert self.policy is not None
            with set_exploration_type(self.exploration):
                acted = self.policy(self.data)
        self.action = int(acted["action"])
        self.data = step_mdp(self.env.step(acted), exclude_reward=False)
        return bool(self.data["done"])
