"""The base class of policy-gradient agents: networks, advantages, epochs of minibatches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.objectives.value.functional import generalized_advantage_estimate, vec_generalized_advantage_estimate

from baselines.cells.cell import MakeCell
from baselines.cells.lstm import LSTM
from baselines.parts.learner import Learner
from baselines.parts.networks import (
    GROUP,
    ActorCritic,
    Data,
    Items,
    TensorsByName,
    actor,
    copied_action,
    critic,
    entropy,
    log_probabilities,
    make_orthogonal,
    num_actions_of,
    recurrent,
    require_weights,
    sequences_of,
)
from baselines.parts.networks import encoder as make_encoder
from baselines.update.update import OPTIMISERS, make_optimiser
from ctgraph_rl.checks import at_least_one, at_most, fraction, one_of, positive, require, true_or_false
from ctgraph_rl.core.device import torchs_defaults

MOST_LAYERS = 1000
"""Far beyond what trains."""

SMALLEST_DECAY = 1e-6
"""TorchRL's advantages leave out terms below 1e-7, and need at least one."""

ACTED_KEYS = ("action", "action_log_prob", "state_value")


class Seeds(NamedTuple):
    """Whose rows a batch has: those of one agent, or the same number of each of several."""

    count: int

    values: Callable[[Items], Tensor]
    """Computes the values, [n, 1], at n frames of all seeds, the same number of each."""

    orders: Callable[[int], Tensor]
    """Draws an order of so many items for each seed, int64 [seeds, items]; or for one, [items]."""


class PolicyGradient(Learner):
    """An actor and a critic on one trunk, which ends in a cell if the class has ``memory``.

    A class that derives from it defines the loss, and passes on all arguments that are not its own. With memory,
    minibatches are whole rows of a batch, so the trunk sees sequences in order, and its state is reset wherever
    ``is_init`` is set; without memory, the frames of all rows are shuffled.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        num_envs: environments that it learns from.
        num_steps: steps of each environment in a batch.
        hidden_size: width of all layers.
        num_layers: layers before the heads, or before the cell.
        optimiser: ``adam`` or ``rmsprop``.
        learning_rate: of the optimiser.
        gamma: discount factor.
        normalize_advantage: give the advantages of a batch mean 0 and standard deviation 1.
        max_grad_norm: gradients are scaled down to this norm.
        gae_lambda: lambda of the generalised advantage estimate (Schulman et al. 2016, arXiv 1506.02438); 1: returns
            of up to ``num_steps`` steps.
        compile: run gradient steps through ``torch.compile``; only without memory.
        orthogonal_init: initialise linear layers with orthogonal weights, those of the heads a thousand times smaller,
            and biases of 0, as in the code of Ben-Iwhiwhu et al. 2023; False: as PyTorch does.
        cell: what remembers, a class of `baselines.cells` or a partial of one; None: an LSTM. Only with memory.
        deduplicate: compute frames of a minibatch with the same inputs once, with memory those with the same history:
            faster on a CPU where observations have no pixel noise and minibatches are large. Sums are rounded in
            another order. A GPU computes all frames.
        encoder: ``mlp``, or ``cnn`` with two convolutions before the first layer, for images.
    """

    num_epochs = num_minibatches = 1
    output_keys = ("log_probs", "state_value")
    stackable = capturable = True

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
        compile: bool = False,
        orthogonal_init: bool = False,
        cell: MakeCell | None = None,
        deduplicate: bool = False,
        encoder: str = "mlp",
    ) -> None:
        super().__init__(num_envs, num_steps, max_grad_norm, compile)
        require(
            *at_least_one(hidden_size=hidden_size, num_layers=num_layers),
            *at_most(MOST_LAYERS, num_layers=num_layers),
            *one_of(OPTIMISERS, optimiser=optimiser),
            *positive(learning_rate=learning_rate, gamma=gamma, gae_lambda=gae_lambda),
            *fraction(gamma=gamma, gae_lambda=gae_lambda),
            *true_or_false(
                normalize_advantage=normalize_advantage, orthogonal_init=orthogonal_init, deduplicate=deduplicate
            ),
            (not (compile and deduplicate), "deduplicate must be false with compile=true, which needs fixed sizes"),
        )
        decay = gamma * gae_lambda
        rule = f"gamma * gae_lambda must be >= {SMALLEST_DECAY:g}, got {gamma!r} * {gae_lambda!r} = {decay:g}"
        require((decay >= SMALLEST_DECAY, f"{rule}; use a larger gae_lambda"))
        no_cell = f"{type(self).__name__} has no memory and takes no cell: use agent=lstm_ppo, or leave the cell out"
        require((self.memory or cell is None, no_cell))
        self.cell = LSTM if cell is None else cell
        self.deduplicate = deduplicate
        self.encoder = encoder
        require_weights(observation_spec, hidden_size, num_layers, num_actions_of(action_spec) + 1, self.memory)
        self.gamma = gamma
        self.gae_lambda = gae_lambda
        self.normalize_advantage = normalize_advantage
        self.trunk = self.make_trunk(observation_spec, action_spec, hidden_size, num_layers)
        self.features = "memory" if self.memory else "features"
        self.actor = actor(self.features, hidden_size, action_spec)
        self.critic = critic(self.features, hidden_size)
        self.orthogonal_init = orthogonal_init
        self._make_orthogonal()
        state = [key for key in self.trunk.out_keys if key != self.features]
        copied = copied_action(self.trunk.in_keys)
        keys = [*ACTED_KEYS, *state]
        for module in copied:
            keys += module.out_keys
        self.policy = ActorCritic(self.trunk, self.actor, self.critic, *copied, selected_out_keys=keys)
        self.optimiser = make_optimiser(optimiser, self.parameters(), learning_rate)

    @property
    def minibatch_size(self) -> int:  # type: ignore[override]
        """Frames, or with memory rows, of a minibatch."""
        return (self.num_envs if self.memory else self.num_envs * self.num_steps) // self.num_minibatches

    def make_trunk(
        self, observation_spec: Composite, action_spec: TensorSpec, hidden_size: int, num_layers: int
    ) -> TensorDictModuleBase:
        """Build the layers before the heads, which with memory end in a cell."""
        if not self.memory:
            return make_encoder(observation_spec, hidden_size, num_layers, kind=self.encoder)
        num_actions = num_actions_of(action_spec)
        return recurrent(observation_spec, hidden_size, num_layers, num_actions, make_cell=self.cell, kind=self.encoder)

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return zeros for the cell's state; an empty state without memory."""
        return self.trunk.zero_state(num_envs) if self.memory else super().initial_state(num_envs)

    def reset_parameters(self) -> None:
        """See `Learner`."""
        super().reset_parameters()
        self._make_orthogonal()

    def _make_orthogonal(self) -> None:
        if self.orthogonal_init:
            make_orthogonal(self.trunk)
            make_orthogonal(nn.ModuleList([self.actor, self.critic]), 0.001)

    def evaluate_actions(self, batch: Data) -> tuple[Tensor, Tensor, Tensor]:
        """Compute log-probabilities of all actions, those of the actions taken, and values, with the present networks.

        The trunk runs once for actor and critic, and with ``deduplicate`` once for frames that have the same features.
        """
        if GROUP in batch:
            features, which = self.trunk.of_distinct(batch)
            outputs = {key: value[which] for key, value in self._heads(features).items()}
        else:
            outputs = self.outputs(batch)
        log_probs = outputs["log_probs"]
        return log_probs, log_probs.gather(-1, batch["action"].unsqueeze(-1)), outputs["state_value"]

    def outputs(self, data: Data) -> TensorsByName:
        """Compute log-probabilities of all actions and the value; see `Learner`."""
        return self._heads(self.trunk.over_time(data))

    def _heads(self, features: Tensor) -> TensorsByName:
        return {"log_probs": log_probabilities(self.actor, features), "state_value": self.critic.module(features)}

    def one_step(self, data: Data) -> Items:
        """Compute `outputs` for one step of all rows, and with memory the next state; see `Learner`."""
        written = self.trunk.act(data)
        features = written.pop(self.features)
        return {**written, **self._heads(features)}

    def minibatches(self, batch: TensorDictBase) -> Iterator[Items]:
        """Yield the minibatches of all epochs, with advantages from the values that were computed while acting."""
        for minibatch in self.minibatches_of(batch, self.one_seed):
            yield {key: value[0] for key, value in minibatch.items()}

    def minibatches_of(self, batch: TensorDictBase, seeds: Seeds) -> Iterator[Items]:
        """Yield the minibatches of several seeds, [seeds, frames or rows, ...] each; ``batch`` has all their rows."""
        items = {}
        for key, value in self.with_advantage(batch, seeds).items():
            of_seeds = value.unflatten(0, (seeds.count, -1))
            items[key] = of_seeds if self.memory else of_seeds.flatten(1, 2)
        number = items["action"].shape[1]
        first = number * torch.arange(seeds.count, device=items["action"].device).unsqueeze(1)
        for _ in range(self.num_epochs):
            places = (first + seeds.orders(number)).flatten()
            parts = {}
            for key, value in items.items():
                shuffled = value.flatten(0, 1).index_select(0, places).view_as(value)
                parts[key] = shuffled.chunk(self.num_minibatches, dim=1)
            for part in range(len(parts["action"])):
                yield {key: value[part] for key, value in parts.items()}

    @property
    def one_seed(self) -> Seeds:
        """This agent, as the only seed."""
        device = self.critic.module.weight.device
        return Seeds(
            1,
            values=lambda data: self.one_step(data)["state_value"],
            orders=lambda count: torch.randperm(count, device=device),
        )

    def reward(self, batch: TensorDictBase) -> Tensor:
        """Return the reward to maximise, float32 [num_envs, num_steps, 1]: the environment's."""
        return batch["next", "reward"]

    @torch.no_grad()
    def with_advantage(self, batch: TensorDictBase, seeds: Seeds) -> TensorsByName:
        """Return inputs and actions of a batch, ``advantage`` and ``value_target``, [rows, steps, ...] each.

        The value after a step is the one that was computed while acting at the next step. After the last step of the
        batch, and where an episode was truncated, it is computed here. Where one has terminated, it is not used.
        """
        values = batch["state_value"]
        after = batch["next"]
        cut = (after["done"] & ~after["terminated"]).squeeze(-1)
        cut[:, -1] = True
        next_values = values.roll(-1, dims=1)
        if cut.is_cpu and seeds.count == 1:
            next_values[cut] = seeds.values({key: after[key][cut] for key in self.trunk.in_keys})
        else:  # a choice of frames would make the host wait for a GPU, and seeds differ in their number
            computed = seeds.values({key: after[key].flatten(0, 1) for key in self.trunk.in_keys})
            next_values = torch.where(cut.unsqueeze(-1), computed.view_as(values), next_values)
        return self.with_estimates(batch, next_values, after["done"], after["terminated"], seeds)

    def with_estimates(
        self, batch: TensorDictBase, next_values: Tensor, done: Tensor, terminated: Tensor, seeds: Seeds
    ) -> TensorsByName:
        """Return what `with_advantage` does; values and flags are [rows, steps, 1]."""
        advantage, target = self.advantages(batch, next_values, done, terminated)
        if self.normalize_advantage:
            of_seeds = advantage.unflatten(0, (seeds.count, -1))
            mean = of_seeds.mean(dim=(1, 2, 3), keepdim=True)
            deviation = of_seeds.std(dim=(1, 2, 3), correction=0, keepdim=True)
            advantage = ((of_seeds - mean) / (deviation + 1e-8)).flatten(0, 1)
        inputs = sequences_of(batch, [*self.trunk.in_keys, "action", "action_log_prob"])
        if self.deduplicate and advantage.is_cpu:
            inputs[GROUP] = self.trunk.groups(batch)
        return inputs | {"advantage": advantage, "value_target": target}

    def advantages(
        self, batch: TensorDictBase, next_values: Tensor, done: Tensor, terminated: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compute the advantages and the critic's targets; each argument and result is [rows, steps, 1]."""
        given = (batch["state_value"], next_values, self.reward(batch), done, terminated)
        return generalized_advantages(self.gamma, self.gae_lambda, *given)


def generalized_advantages(gamma: float, gae_lambda: float, *given: Tensor) -> tuple[Tensor, Tensor]:
    """Compute advantages and value targets; TorchRL's faster way makes the host wait for a GPU."""
    estimate = vec_generalized_advantage_estimate if given[0].is_cpu else generalized_advantage_estimate
    with torchs_defaults():  # TorchRL multiplies flags by numbers, which gives torch's default dtype
        return estimate(gamma, gae_lambda, *given)


def critic_loss(values: Tensor, batch: Data, weight: float) -> Tensor:
    """Compute the critic's weighted mean squared error."""
    return (weight * (values - batch["value_target"]).square()).mean()


def entropy_loss(log_probs: Tensor, weight: float) -> TensorsByName:
    """Return the negative weighted entropy of the policy as a loss, and the entropy."""
    entropies = entropy(log_probs)
    return {"loss_entropy": (-weight * entropies).mean(), "entropy": entropies.detach().mean()}
