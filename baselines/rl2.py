"""RL^2: an LSTM that reads its last action and reward and keeps its state over the episodes of a trial.

Duan et al. 2016 (arXiv 1611.02779) and Wang et al. 2016 (arXiv 1611.05763), trained by PPO. A trial is a number of
episodes with one goal, such as 4 with ``goal_change=(4, 4)``. PPO maximises the trial's return, so an early episode may
search.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.data import Composite, TensorSpec
from typing_extensions import override

from baselines.parts.networks import HISTORY, INPUT, Data, Items, RecurrentModule, TensorsByName, num_actions_of
from baselines.parts.policy_gradient import Seeds
from baselines.ppo import PPO, PPOSettings
from ctgraph_rl.checks import at_least_one, require
from ctgraph_rl.core.dynamics import OUTCOME_GOAL

OWN_KEYS = ("trial", "previous_action", "reward")
"""The state beside the LSTM's: the episode's number in its trial, and the last action and reward."""


class TrialTrunk(TensorDictModuleBase):
    """A recurrent trunk whose state resets at the start of a trial, and which reads the last action and reward.

    Args:
        trunk: a `recurrent` trunk that also reads ``previous``, [num_actions + 1].
    """

    def __init__(self, trunk: RecurrentModule, num_actions: int, trial_episodes: int) -> None:
        super().__init__()
        self.trunk = trunk
        self.num_actions = num_actions
        self.trial_episodes = trial_episodes
        self.state_keys = trunk.state_keys
        self.in_keys = [*(key for key in trunk.in_keys if key != "previous"), *OWN_KEYS]
        self.out_keys = [*trunk.out_keys, ("next", "trial")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``memory``, the LSTM's next state and the episode's number in its trial, from 1."""
        return tensordict.update(self.act(tensordict))

    def act(self, data: Data) -> Items:
        """Return ``memory`` and the next state for one step of all rows."""
        inputs, episode = self._inputs(data)
        return {**self.trunk.act(inputs), ("next", "trial"): torch.where(inputs["is_init"], 1, episode)}

    def over_time(self, data: Data) -> Tensor:
        """Return ``memory`` at all steps of sequences [rows, steps]."""
        return self.trunk.over_time(self._inputs(data)[0])

    def number_histories(self, data: Data) -> Items:
        """Number the inputs and the histories of frames, int64 [rows, steps] each, as `RecurrentModule`."""
        return self.trunk.number_histories(self._inputs(data)[0])

    def of_histories(self, data: Data) -> tuple[Tensor, Tensor]:
        """Return ``memory`` of different histories, and the number of each frame's, as `RecurrentModule`."""
        return self.trunk.of_histories(self._inputs(data)[0])

    def _inputs(self, data: Data) -> tuple[TensorsByName, Tensor]:
        episode = data["trial"] + data["is_init"]
        fresh = data["is_init"] & ((episode == 1) | (episode > self.trial_episodes))
        inputs = {key: data[key] for key in (*self.trunk.in_keys, INPUT, HISTORY) if key != "previous" and key in data}
        action = one_hot(data["previous_action"], self.num_actions)
        previous = torch.cat([action, data["reward"]], dim=-1)
        return inputs | {"is_init": fresh, "previous": torch.where(fresh, 0.0, previous)}, episode


@dataclass(frozen=True, kw_only=True)
class RL2Settings(PPOSettings):
    """The settings of `RL2`."""

    trial_episodes: int  # episodes of a trial

    def __post_init__(self) -> None:
        super().__post_init__()
        require(*at_least_one(trial_episodes=self.trial_episodes))


class RL2(PPO):
    """PPO over trials of several episodes, over which the LSTM keeps its state."""

    Settings = RL2Settings
    memory = True
    needs_episodes = True
    solves = "tasks whose goal changes after a number of episodes: it searches for the goal, then returns to it"

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        found = "outcome" in observation_spec.keys()  # noqa: SIM118, a Composite is no dict
        needs = "RL2 needs CT-graphs that show the ends of episodes, which protocol.episodes=hidden hides"
        require((found, f"{needs}: set protocol.episodes=shown, or take agent=lstm_ppo"))
        super().__init__(observation_spec, action_spec, **settings)
        self.trial_episodes = self.settings.trial_episodes

    @override
    def make_trunk(self, observation_spec: Composite, action_spec: TensorSpec, **extra: int) -> TrialTrunk:
        num_actions = num_actions_of(action_spec)
        trunk = super().make_trunk(observation_spec, action_spec, previous=num_actions + 1)
        message = "reads_action and reads_reward must be false, as RL2 reads its last action and reward itself"
        require((not trunk.own_keys, message))
        return TrialTrunk(trunk, num_actions, self.settings.trial_episodes)

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return zeros before the first trial.

        The loop carries a state with the key ``trial`` over the ends of episodes; the trunk resets it.
        """
        state = self.trunk.trunk.zero_state(num_envs)
        device = next(self.parameters()).device
        state["trial"] = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)
        state["previous_action"] = torch.zeros(num_envs, dtype=torch.int64, device=device)
        return state.set("reward", torch.zeros(num_envs, 1, device=device, dtype=torch.float32))

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch; return mean losses and the success rates of the first and last episodes of trials.

        The last step of a batch only provides the value to bootstrap from.
        """
        losses = super().learn(batch) if batch.shape[1] > 1 else {}
        ends = batch["next"][batch["next", "done"].squeeze(-1)]
        found = (ends["outcome"] == OUTCOME_GOAL).float()
        for name, number in (("first", 1), ("last", self.trial_episodes)):
            episodes = found[ends["trial"] == number]
            if len(episodes):
                losses[f"success_of_{name}_episodes"] = episodes.mean().item()
        return losses

    @override
    def num_learnt(self, batch: TensorDictBase) -> int:
        return batch[:, :-1].numel()

    @torch.no_grad()
    def with_advantage(self, batch: TensorDictBase, seeds: Seeds) -> TensorsByName:
        """Return all steps but the last; only the end of a trial ends the return."""
        after = batch["next"]
        ends = (after["done"] & (after["trial"] == self.trial_episodes))[:, :-1]
        return self.with_estimates(batch[:, :-1], batch["state_value"][:, 1:], ends, ends, seeds)
