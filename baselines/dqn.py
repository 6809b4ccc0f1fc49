"""DQN: double Q-learning with replay and epsilon-greedy exploration; without memory.

Mnih et al. 2015 and van Hasselt et al. 2016 (arXiv 1509.06461) on TorchRL's `QValueActor`, `EGreedyModule` and replay
buffer; with priorities as Schaul et al. 2016 (arXiv 1511.05952) where configured.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import QValueActor

from baselines.cells.cell import linear_layer
from baselines.parts.networks import Data, TensorsByName, num_actions_of, require_weights
from baselines.parts.networks import encoder as make_encoder
from baselines.parts.prioritized import LARGEST_ALPHA
from baselines.parts.q_learning import QLearner, require_replay
from ctgraph_rl.checks import at_least_one, at_most, fraction, not_negative, positive, require, true_or_false


class DQN(QLearner):
    """DQN for tasks that need no memory.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        hidden_size: width of the two hidden layers.
        learning_rate: of Adam.
        gamma: discount factor.
        double: let the online network choose the action of the target (double Q-learning).
        priority_alpha: how strongly the TD error decides what is replayed; 0 is uniform (Schaul et al. 2016, arXiv
            1511.05952).
        priority_beta: how much of that the loss corrects, in [0, 1].
        encoder: ``mlp``, or ``cnn`` with two convolutions before the first layer, for images.
        settings: the arguments of `QLearner`. Where different states show the same image, a one-step target is the
            same after every decision, so nothing is learned about decisions: ``n_steps`` helps.
    """

    stackable = True
    solves = "fully observable tasks (CT-FO)"

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        hidden_size: int,
        learning_rate: float,
        gamma: float,
        double: bool,
        priority_alpha: float,
        priority_beta: float,
        encoder: str = "mlp",
        **settings: Any,
    ) -> None:
        require(
            *at_least_one(hidden_size=hidden_size),
            *positive(learning_rate=learning_rate),
            *true_or_false(double=double),
            *fraction(priority_beta=priority_beta),
            *not_negative(priority_alpha=priority_alpha),
            *at_most(LARGEST_ALPHA, priority_alpha=priority_alpha),
        )
        num_actions = num_actions_of(action_spec)
        require_weights(observation_spec, hidden_size, 2, num_actions)
        require_replay(observation_spec, settings["buffer_size"], settings["batch_size"])
        self.priority_alpha = priority_alpha
        self.priority_beta = priority_beta
        self.gamma = gamma
        super().__init__(gamma=gamma, **settings)
        head = nn.Sequential(
            linear_layer(hidden_size, hidden_size),
            nn.ReLU(),
            linear_layer(hidden_size, num_actions),
        )
        values = TensorDictModule(head, in_keys=["features"], out_keys=["action_value"])
        features = make_encoder(observation_spec, hidden_size, kind=encoder)
        greedy = QValueActor(TensorDictSequential(features, values), in_keys=features.in_keys, spec=action_spec)
        self.is_double = double
        self.set_networks(greedy, action_spec, learning_rate)

    def experience(self, batch: TensorDictBase) -> TensorDictBase:
        """Return every step as a transition of up to ``n_steps`` steps."""
        seen = self.policy.in_keys
        after = [("next", key) for key in (*seen, "reward", "done", "terminated")]
        return batch.select(*seen, "action", *after, "steps_to_next_obs").reshape(-1)

    def loss(self, batch: Data, others: Data | None = None) -> TensorsByName:
        """Compute the loss of transitions, as TorchRL's ``DQNLoss`` does, and their squared errors, ``td_error``.

        The prediction is the value of the action taken; the target is the multi-step reward plus the discounted value
        of the best action after it, by the target network.

        Args:
            batch: transitions.
            others: the target network's weights, in place of the present ones: see `other_weights`.
        """
        after = {key: batch["next", key] for key in self.greedy.in_keys}
        predicted = self.values(batch).gather(-1, batch["action"].unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            later = self.with_others(others, type(self).values, after)
            best = (self.values(after) if self.is_double else later).argmax(dim=-1, keepdim=True)
            gamma = later.new_tensor(self.gamma) ** batch["steps_to_next_obs"].view_as(batch["next", "reward"])
            running = (~batch["next", "terminated"]).int()
            target = (batch["next", "reward"] + gamma * running * later.gather(-1, best)).squeeze(-1)
        squared = (predicted - target).square()
        weight = batch.get("priority_weight")
        mean = squared.mean() if weight is None else (squared * weight).sum() / weight.sum()
        return {"loss_value": mean, "td_error": squared.detach()}

    def values(self, data: Data) -> Tensor:
        """Compute the online network's action values."""
        trunk, head = self.greedy.module[0].module
        return head.module(trunk.over_time(data))
