"""The base class of recurrent Q-learning agents: a cell, replayed sequences with stored states, double targets.

Sequences are the rows of collected batches, with the cell's stored state at their first step (Kapturowski et al. 2019,
R2D2); it resets at ``is_init``. One more step is kept to bootstrap from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase, pad
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import QValueActor
from typing_extensions import override

from baselines.cells.cell import MakeCell, linear_layer
from baselines.cells.lstm import LSTM
from baselines.parts.networks import Data, TensorsByName, num_actions_of, recurrent, require_weights, state_written
from baselines.parts.q_learning import QLearner, QLearnerSettings, require_replay
from ctgraph_rl.checks import require
from ctgraph_rl.learn.collect import UNSTORED


class Quantiles(nn.Module):
    """A linear layer with K outputs per action, whose mean is the action's value."""

    def __init__(self, num_features: int, num_actions: int, num_quantiles: int) -> None:
        super().__init__()
        self.shape = (num_actions, num_quantiles)
        self.linear = linear_layer(num_features, num_actions * num_quantiles)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Map float32 [..., num_features] to values [..., A] and quantiles [..., A, K]."""
        quantiles = self.linear(features).unflatten(-1, self.shape)
        return quantiles.mean(dim=-1), quantiles


def of_action(quantiles: Tensor, action: Tensor) -> Tensor:
    """Select the quantiles [B, L, K] of each step's action from [B, L, A, K] and [B, L]."""
    index = action[..., None, None].expand(*action.shape, 1, quantiles.shape[-1])
    return quantiles.gather(-2, index).squeeze(-2)


@dataclass(frozen=True, kw_only=True)
class RecurrentQSettings(QLearnerSettings):
    """The settings of `RecurrentQ`, for sequences of ``num_steps`` steps."""

    cell: MakeCell = LSTM  # what remembers, a class of `baselines.cells` or a partial of one

    def __post_init__(self) -> None:
        super().__post_init__()
        short = f"buffer_size must be an integer >= num_steps={self.num_steps!r}, got {self.buffer_size!r}"
        require((self.buffer_size >= self.num_steps, short))


class RecurrentQ(QLearner):
    """Q-learning with a cell; subclasses define the distance of predictions from targets."""

    Settings: ClassVar[Any] = RecurrentQSettings
    memory = True
    num_quantiles = 1

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        super().__init__(observation_spec, action_spec, **settings)
        given = self.settings
        width = given.hidden_size
        num_actions = num_actions_of(action_spec)
        self.trunk = recurrent(observation_spec, width, 1, num_actions, make_cell=given.cell, kind=given.encoder)
        stored = not any(key.startswith(UNSTORED) for key in self.trunk.state_keys)
        kind = type(self.trunk.module[1]).__name__
        message = f"{type(self).__name__} replays sequences, which need a cell whose state is stored, not {kind}"
        require((stored, f"{message}: use agent=lstm_ppo"))
        head = Quantiles(width, num_actions, self.num_quantiles)
        values = TensorDictModule(head, in_keys=["memory"], out_keys=["action_value", "quantiles"])
        greedy = QValueActor(TensorDictSequential(self.trunk, values), in_keys=self.trunk.in_keys, spec=action_spec)
        self.set_networks(greedy, action_spec, state_written(self.trunk))

    @override
    def require_room(self, observation_spec: Composite, num_actions: int) -> None:
        given = self.settings
        require_weights(observation_spec, given.hidden_size, 1, num_actions * self.num_quantiles, memory=True)
        pairs = given.num_steps * self.num_quantiles**2
        require_replay(observation_spec, given.buffer_size, given.batch_size, pairs)

    @override
    def values(self, data: Data) -> Tensor:
        return self.quantiles(data).mean(dim=-1)

    def quantiles(self, data: Data) -> Tensor:
        """Return the network's quantiles, [B, L, A, K]."""
        head = self.greedy.module[0].module[1]
        return head.module(self.trunk.over_time(data))[1]

    @override
    def num_items(self, num_steps: int) -> int:
        return num_steps // self.num_steps

    @override
    def initial_state(self, num_envs: int) -> TensorDict:
        return self.trunk.zero_state(num_envs)

    def experience(self, batch: TensorDictBase) -> TensorDictBase:
        """Return a sequence of ``num_steps + 1`` steps per row.

        ``learnt`` is False at the step added for bootstrapping, at padding, and where an episode was truncated, as the
        sequence does not hold what followed.
        """
        after = batch["next"]
        steps = batch.select("action", "gamma", "steps_to_next_obs", ("next", "reward"), ("next", "terminated"))
        steps["learnt"] = (~after["done"] | after["terminated"]).squeeze(-1)
        missing = self.num_steps - batch.shape[1]
        return pad(self._inputs(batch), [0, 0, 0, missing]).update(pad(steps, [0, 0, 0, missing + 1]))

    def _inputs(self, batch: TensorDictBase) -> TensorDictBase:
        keys = self.trunk.in_keys
        last = batch["next"][:, -1:].select(*keys)
        return torch.cat([batch.select(*keys), last], dim=1)

    def distance(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return the loss of every step, [B, L], from quantiles [B, L, K]."""
        raise NotImplementedError

    def loss(self, batch: Data, others: Data | None = None) -> TensorsByName:
        """Return the mean loss of the steps of sequences.

        The target is the multi-step reward plus the target network's quantiles of the online network's best action
        where the rewards end. It is unused where ``learnt`` is False.
        """
        online = self.quantiles(batch)
        with torch.no_grad():
            later = self.with_others(others, type(self).quantiles, batch)
        best = of_action(later, online.mean(dim=-1).argmax(dim=-1))
        steps = best.shape[1]
        positions = torch.arange(steps, device=best.device) + batch["steps_to_next_obs"]
        positions = positions.clamp(max=steps - 1).unsqueeze(-1).expand_as(best)
        bootstrap = batch["gamma"].unsqueeze(-1) * best.gather(1, positions)
        target = batch["next", "reward"] + torch.where(batch["next", "terminated"], 0.0, bootstrap)
        distance = self.distance(of_action(online, batch["action"]), target)
        learnt = batch["learnt"]
        return {"loss_value": (distance * learnt).sum() / learnt.sum().clamp(min=1)}
