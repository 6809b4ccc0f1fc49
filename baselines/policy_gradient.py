"""What agents that follow a policy's gradient share: networks, advantages, epochs of minibatches."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from baselines.learner import OPTIMISERS, Learner, make_optimiser, mean_measurements, one_of, true_or_false
from baselines.networks import STATE_KEYS, actor, critic, encoder, recurrent, zero_state
from ctgraph_rl.checks import at_least_one, fraction, is_real, positive, require

ACTED_KEYS = ("action", "action_log_prob", "state_value")


class PolicyGradient(Learner):
    """An actor and a critic on one trunk, which ends in an LSTM if the class has ``memory``.

    A class that derives from it sets ``objective``, a TorchRL loss of the two heads, and hands all arguments here that
    are not its own. With memory,
    whole rows of a batch are the minibatches, so the trunk sees sequences in order, and its state starts anew wherever
    ``is_init`` is set; without, the frames of all rows are shuffled.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        num_envs: rows that it learns from.
        num_steps: steps of each row in a batch.
        hidden_size: width of all layers.
        num_layers: layers before the heads, or before the LSTM.
        optimiser: ``adam`` or ``rmsprop``.
        learning_rate: of the optimiser.
        gamma: discount factor.
        normalize_advantage: give the advantages of a batch mean 0 and standard deviation 1.
        max_grad_norm: gradients are scaled down to this norm.
        gae_lambda: lambda of the generalised advantage estimate (Schulman et al. 2016, arXiv 1506.02438); 1: returns
            of up to ``num_steps`` steps.
    """

    loss_keys: ClassVar[tuple[str, ...]] = ("loss_objective", "loss_critic", "loss_entropy", "entropy")
    objective: nn.Module
    num_epochs = num_minibatches = 1

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        num_envs: int,
        num_steps: int,
        hidden_size: int,
        num_layers: int,
        optimiser: str,
        learning_rate: float,
        gamma: float,
        normalize_advantage: bool,
        max_grad_norm: float,
        gae_lambda: float = 1.0,
    ) -> None:
        super().__init__(num_envs, num_steps, max_grad_norm)
        require(
            *at_least_one(hidden_size=hidden_size, num_layers=num_layers),
            *one_of(OPTIMISERS, optimiser=optimiser),
            *positive(learning_rate=learning_rate, gamma=gamma, gae_lambda=gae_lambda),
            *fraction(gamma=gamma, gae_lambda=gae_lambda),
            *true_or_false(normalize_advantage=normalize_advantage),
        )
        self.gamma, self.gae_lambda, self.normalize_advantage = gamma, gae_lambda, normalize_advantage
        self.trunk = self.make_trunk(observation_spec, action_spec, hidden_size, num_layers)
        self.features = "memory" if self.memory else "features"
        self.actor = actor(self.features, hidden_size, action_spec)
        self.critic = critic(self.features, hidden_size)
        state = [("next", key) for key in STATE_KEYS if self.memory]
        self.policy = TensorDictSequential(self.trunk, self.actor, self.critic, selected_out_keys=[*ACTED_KEYS, *state])
        self.optimiser = make_optimiser(optimiser, self.parameters(), learning_rate)

    def make_trunk(
        self, observation_spec: Composite, action_spec: TensorSpec, hidden_size: int, num_layers: int
    ) -> TensorDictModuleBase:
        """What comes before the heads; with memory, it ends in an LSTM."""
        make = recurrent if self.memory else encoder
        return make(observation_spec, hidden_size, num_layers)

    def initial_state(self, num_envs: int) -> TensorDict:
        """Zeros for the LSTM's state; empty without memory."""
        return zero_state(self.trunk, num_envs) if self.memory else super().initial_state(num_envs)

    def loss(self, batch: TensorDictBase) -> TensorDictBase:
        """The objective's losses of data with advantages; the trunk runs once for actor and critic."""
        with set_recurrent_mode(True):
            features = self.trunk(batch.select(*self.trunk.in_keys))[self.features]
        return self.objective(batch.set(self.features, features)).select(*self.loss_keys)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Some epochs over a batch; returns mean losses, entropy and gradient norm."""
        batch = self._with_advantage(batch)
        batch = batch if self.memory else batch.reshape(-1)
        minibatches = (rows for _ in range(self.num_epochs) for rows in self._minibatches(batch))
        return mean_measurements([self.gradient_step(batch[rows]) for rows in minibatches])

    def reward(self, batch: TensorDictBase) -> Tensor:
        """What is maximised, float32 [num_envs, num_steps, 1]: the environment's reward."""
        return batch["next", "reward"]

    def _minibatches(self, batch: TensorDictBase) -> tuple[Tensor, ...]:
        """Item numbers of each minibatch of one pass."""
        return torch.randperm(batch.shape[0]).chunk(self.num_minibatches)

    @torch.no_grad()
    def _with_advantage(self, batch: TensorDictBase) -> TensorDictBase:
        """The batch with ``advantage`` and ``value_target`` from the values that were computed while acting."""
        after = batch["next"]
        return self._estimated(batch, self._next_values(batch), after["done"], after["terminated"])

    def _estimated(
        self, batch: TensorDictBase, next_values: Tensor, done: Tensor, terminated: Tensor
    ) -> TensorDictBase:
        """What is learned from: inputs, actions, advantages and targets; each argument is [num_envs, num_steps, 1]."""
        given = (batch["state_value"], next_values, self.reward(batch), done, terminated)
        advantage, target = vec_generalized_advantage_estimate(self.gamma, self.gae_lambda, *given)
        if self.normalize_advantage:
            advantage = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
        keys = (*self.trunk.in_keys, "action", "action_log_prob")
        return batch.select(*keys).set("advantage", advantage).set("value_target", target)

    def _next_values(self, batch: TensorDictBase) -> Tensor:
        """The value after each step: the next step's own, or that of another forward pass where there is none.

        There is none after the last step of the batch and where an episode was truncated. Where one has terminated,
        the value is not used.
        """
        values, after = batch["state_value"], batch["next"]
        cut = (after["done"] & ~after["terminated"]).squeeze(-1)
        cut[:, -1] = True
        next_values = values.roll(-1, dims=1)
        ends = after.select(*self.trunk.in_keys, strict=False)[cut]
        next_values[cut] = self.critic(self.trunk(ends))["state_value"]
        return next_values


def loss_weight(**values: object) -> list[tuple[bool, str]]:
    """Rules that each named value is a number >= 0."""
    return [(is_real(value, 0), f"{name} must be a number >= 0, got {value!r}") for name, value in values.items()]
