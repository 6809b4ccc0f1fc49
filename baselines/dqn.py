"""DQN: double Q-learning with replay and epsilon-greedy exploration; without memory.

Mnih et al. 2015 and van Hasselt et al. 2016 (arXiv 1509.06461) on TorchRL's `QValueActor`, `EGreedyModule` and replay
buffer; with priorities as Schaul et al. 2016 (arXiv 1511.05952) where configured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import QValueActor
from typing_extensions import override

from baselines.cells.cell import linear_layer
from baselines.parts.networks import Data, TensorsByName, encoder, num_actions_of, require_weights
from baselines.parts.prioritized import LARGEST_ALPHA, PrioritySampler
from baselines.parts.q_learning import QLearner, QLearnerSettings, require_replay
from ctgraph_rl.checks import at_most, fraction, not_negative, require, true_or_false


@dataclass(frozen=True, kw_only=True)
class DQNSettings(QLearnerSettings):
    """The settings of `DQN`.

    Where states share an image, a one-step target is the same after every decision and teaches nothing about it:
    ``n_steps`` helps.
    """

    double: bool  # let the online network choose the action of the target (double Q-learning)
    priority_alpha: float  # how strongly the TD error decides what is replayed; 0 is uniform
    priority_beta: float  # how much of that the loss corrects, in [0, 1]

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            *true_or_false(double=self.double),
            *fraction(priority_beta=self.priority_beta),
            *not_negative(priority_alpha=self.priority_alpha),
            *at_most(LARGEST_ALPHA, priority_alpha=self.priority_alpha),
        )


class DQN(QLearner):
    """DQN for tasks that need no memory."""

    Settings = DQNSettings
    stackable = True
    solves = "fully observable tasks (CT-FO)"

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        super().__init__(observation_spec, action_spec, **settings)
        width = self.settings.hidden_size
        head = nn.Sequential(linear_layer(width, width), nn.ReLU(), linear_layer(width, num_actions_of(action_spec)))
        values = TensorDictModule(head, in_keys=["features"], out_keys=["action_value"])
        features = encoder(observation_spec, width, kind=self.settings.encoder)
        greedy = QValueActor(TensorDictSequential(features, values), in_keys=features.in_keys, spec=action_spec)
        self.set_networks(greedy, action_spec)

    @override
    def require_room(self, observation_spec: Composite, num_actions: int) -> None:
        require_weights(observation_spec, self.settings.hidden_size, 2, num_actions)
        require_replay(observation_spec, self.settings.buffer_size, self.settings.batch_size)

    @override
    def make_sampler(self, size: int) -> Any:
        alpha = self.settings.priority_alpha
        return PrioritySampler(size, alpha, self.settings.priority_beta) if alpha else super().make_sampler(size)

    @override
    def experience(self, batch: TensorDictBase) -> TensorDictBase:
        seen = self.policy.in_keys
        after = [("next", key) for key in (*seen, "reward", "done", "terminated")]
        return batch.select(*seen, "action", *after, "steps_to_next_obs").reshape(-1)

    def loss(self, batch: Data, others: Data | None = None) -> TensorsByName:
        """Return the loss of transitions, as TorchRL's ``DQNLoss``, and their squared errors, ``td_error``.

        The target is the multi-step reward plus the discounted value of the best action after it, by the target
        network.

        Args:
            others: the target network's weights; None: those of `other_weights`.
        """
        after = {key: batch["next", key] for key in self.greedy.in_keys}
        predicted = self.values(batch).gather(-1, batch["action"].unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            later = self.with_others(others, type(self).values, after)
            best = (self.values(after) if self.settings.double else later).argmax(dim=-1, keepdim=True)
            gamma = later.new_tensor(self.settings.gamma) ** batch["steps_to_next_obs"].view_as(batch["next", "reward"])
            running = (~batch["next", "terminated"]).int()
            target = (batch["next", "reward"] + gamma * running * later.gather(-1, best)).squeeze(-1)
        squared = (predicted - target).square()
        weight = batch.get("priority_weight")
        mean = squared.mean() if weight is None else (squared * weight).sum() / weight.sum()
        return {"loss_value": mean, "td_error": squared.detach()}

    @override
    def values(self, data: Data) -> Tensor:
        trunk, head = self.greedy.module[0].module
        return head.module(trunk.over_time(data))
