"""The base class of policy-gradient agents: settings, networks, advantages and minibatches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.objectives.value.functional import generalized_advantage_estimate, vec_generalized_advantage_estimate
from typing_extensions import override

from baselines.cells.cell import MakeCell
from baselines.cells.lstm import LSTM
from baselines.parts import networks
from baselines.parts.learner import Learner
from baselines.parts.merge import mean, merged_outputs, number_frames
from baselines.parts.networks import ActorCritic, Data, Items, TensorsByName
from baselines.update.update import OPTIMISERS, make_optimiser
from ctgraph_rl.checks import (
    at_least_one,
    at_most,
    fraction,
    make_fields_plain,
    one_of,
    positive,
    require,
    true_or_false,
)
from ctgraph_rl.core.device import torchs_defaults

MOST_LAYERS = 1000  # far beyond what trains
SMALLEST_DECAY = 1e-6  # TorchRL's advantages leave out terms below 1e-7, and need at least one


@dataclass(frozen=True, kw_only=True)
class PolicyGradientSettings:
    """The settings of `PolicyGradient`, which agents extend."""

    num_envs: int  # environments that it learns from
    num_steps: int  # steps of each environment in a batch
    hidden_size: int  # width of all layers
    num_layers: int  # layers before the heads, or before the cell
    optimiser: str  # adam or rmsprop
    learning_rate: float  # of the optimiser
    gamma: float  # discount factor
    normalize_advantage: bool  # give the advantages of a batch mean 0 and standard deviation 1
    max_grad_norm: float  # gradients are scaled down to this norm
    gae_lambda: float = 1.0  # lambda of the advantages; 1: returns of up to num_steps steps
    compile: bool = False  # run gradient steps through torch.compile; only without memory
    orthogonal_init: bool = False  # weights as in the code of Ben-Iwhiwhu et al. 2023, see `make_orthogonal`
    cell: MakeCell | None = None  # what remembers, of `baselines.cells`; None: an LSTM; only with memory
    encoder: str = "mlp"  # mlp, or cnn with two convolutions before the first layer, for images

    def __post_init__(self) -> None:
        make_fields_plain(self)
        require(
            *at_least_one(hidden_size=self.hidden_size, num_layers=self.num_layers),
            *at_most(MOST_LAYERS, num_layers=self.num_layers),
            *one_of(OPTIMISERS, optimiser=self.optimiser),
            *positive(learning_rate=self.learning_rate, gamma=self.gamma, gae_lambda=self.gae_lambda),
            *fraction(gamma=self.gamma, gae_lambda=self.gae_lambda),
            *true_or_false(normalize_advantage=self.normalize_advantage, orthogonal_init=self.orthogonal_init),
        )
        decay = self.gamma * self.gae_lambda
        rule = f"gamma * gae_lambda must be >= {SMALLEST_DECAY:g}, got {self.gamma!r} * {self.gae_lambda!r} = {decay:g}"
        require((decay >= SMALLEST_DECAY, f"{rule}; use a larger gae_lambda"))


class Seeds(NamedTuple):
    """Whose rows a batch has: one agent's, or equally many of several."""

    number: int
    values: Callable[[Items], Tensor]
    """Computes the values, [n, 1], at n frames of all seeds."""

    orders: Callable[[int], Tensor]
    """Draws an order of items for each seed, int64 [seeds, items]; for one, [items]."""


class PolicyGradient(Learner):
    """An actor and a critic on one trunk; subclasses define the loss.

    Without memory, minibatches are shuffled frames. With memory, the trunk ends in a cell that resets at ``is_init``,
    and minibatches are whole rows, so it sees sequences in order. Settings are the fields of the class's ``Settings``.
    """

    Settings: ClassVar[Any] = PolicyGradientSettings
    settings: Any
    num_epochs = num_minibatches = 1
    output_keys = ("log_probs", "state_value")
    stackable = capturable = True

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        self.settings = given = self.Settings(**settings)
        super().__init__(given.num_envs, given.num_steps, given.max_grad_norm, given.compile)
        no_cell = f"{type(self).__name__} has no memory and takes no cell: use agent=lstm_ppo, or leave the cell out"
        require((self.memory or given.cell is None, no_cell))
        num_outputs = networks.num_actions_of(action_spec) + 1
        networks.require_weights(observation_spec, given.hidden_size, given.num_layers, num_outputs, self.memory)
        self.trunk = self.make_trunk(observation_spec, action_spec)
        features = "memory" if self.memory else "features"
        self.actor = networks.actor(features, given.hidden_size, action_spec)
        self.critic = networks.critic(features, given.hidden_size)
        if given.orthogonal_init:
            networks.make_orthogonal(self.trunk, self.actor, self.critic)
        self.policy = ActorCritic(self.trunk, self.actor, self.critic)
        self.optimiser = make_optimiser(given.optimiser, self.parameters(), given.learning_rate)

    @property
    def minibatch_size(self) -> int:  # type: ignore[override]
        """Frames, or with memory rows, of a minibatch."""
        return (self.num_envs if self.memory else self.num_envs * self.num_steps) // self.num_minibatches

    def make_trunk(self, observation_spec: Composite, action_spec: TensorSpec, **extra: int) -> TensorDictModuleBase:
        """Build the layers before the heads, with memory ending in a cell; ``extra`` as in `networks.encoder`."""
        given = self.settings
        sizes = given.hidden_size, given.num_layers
        if not self.memory:
            return networks.encoder(observation_spec, *sizes, kind=given.encoder, **extra)
        num_actions = networks.num_actions_of(action_spec)
        cell = given.cell or LSTM
        return networks.recurrent(observation_spec, *sizes, num_actions, make_cell=cell, kind=given.encoder, **extra)

    @override
    def initial_state(self, num_envs: int) -> TensorDict:
        return self.trunk.zero_state(num_envs) if self.memory else super().initial_state(num_envs)

    @override
    def reset_parameters(self) -> None:
        super().reset_parameters()
        if self.settings.orthogonal_init:
            networks.make_orthogonal(self.trunk, self.actor, self.critic)

    def evaluate_actions(self, batch: Data) -> tuple[Data, Tensor, Tensor, Tensor]:
        """Return frames, log-probabilities of all actions, of the taken ones, and values, by the present weights.

        The frames are all of the batch, or one of each kind of `merge`.
        """
        frames, outputs = merged_outputs(self.policy, self.trunk, batch)
        log_probs = outputs["log_probs"]
        return frames, log_probs, log_probs.gather(-1, frames["action"].unsqueeze(-1)), outputs["state_value"]

    @override
    def outputs(self, data: Data) -> TensorsByName:
        return self.policy.outputs(data)

    def one_step(self, data: Data) -> Items:
        """Return `outputs` for one step of all rows, and with memory the next state under ``("next", key)``."""
        return self.policy.one_step(data)

    def minibatches(self, batch: TensorDictBase) -> Iterator[Items]:
        """Yield the minibatches of all epochs, with advantages from the values while acting."""
        for minibatch in self.minibatches_of(batch, self.one_seed):
            yield {key: value[0] for key, value in minibatch.items()}

    def minibatches_of(self, batch: TensorDictBase, seeds: Seeds) -> Iterator[Items]:
        """Yield minibatches of several seeds, [seeds, frames or rows, ...] each; ``batch`` has all their rows."""
        items = {}
        for key, value in self.with_advantage(batch, seeds).items():
            of_seeds = value.unflatten(0, (seeds.number, -1))
            items[key] = of_seeds if self.memory else of_seeds.flatten(1, 2)
        count = items["action"].shape[1]
        first = count * torch.arange(seeds.number, device=items["action"].device).unsqueeze(1)
        for _ in range(self.num_epochs):
            places = (first + seeds.orders(count)).flatten()
            parts = {}
            for key, value in items.items():
                shuffled = value.flatten(0, 1).index_select(0, places).view_as(value)
                parts[key] = shuffled.chunk(self.num_minibatches, dim=1)
            for part in range(len(parts["action"])):
                yield {key: value[part] for key, value in parts.items()}

    @property
    def one_seed(self) -> Seeds:
        """This agent as the only seed."""
        draw_order = partial(torch.randperm, device=self.critic.module.weight.device)
        return Seeds(1, lambda data: self.one_step(data)["state_value"], draw_order)

    def reward(self, batch: TensorDictBase) -> Tensor:
        """Return the environment's reward, to be maximised, float32 [num_envs, num_steps, 1]."""
        return batch["next", "reward"]

    @torch.no_grad()
    def with_advantage(self, batch: TensorDictBase, seeds: Seeds) -> TensorsByName:
        """Return inputs, actions, ``advantage`` and ``value_target`` of a batch, [rows, steps, ...] each.

        The value after a step is that of the next step while acting. It is computed here after the batch's last step
        and where an episode was truncated, and unused where one has terminated.
        """
        values = batch["state_value"]
        after = batch["next"]
        cut = (after["done"] & ~after["terminated"]).squeeze(-1)
        cut[:, -1] = True
        next_values = values.roll(-1, dims=1)
        if cut.is_cpu and seeds.number == 1:
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
        if self.settings.normalize_advantage:
            of_seeds = advantage.unflatten(0, (seeds.number, -1))
            centred = of_seeds - of_seeds.mean(dim=(1, 2, 3), keepdim=True)
            deviation = of_seeds.std(dim=(1, 2, 3), correction=0, keepdim=True)
            advantage = (centred / (deviation + 1e-8)).flatten(0, 1)
        states = self.trunk.state_keys if self.memory else ()
        items = networks.sequences_of(batch, [*self.trunk.in_keys, "action", "action_log_prob"], states)
        items |= {"advantage": advantage, "value_target": target}
        if seeds.number == 1 and self.compiled_step is None:
            items |= number_frames(self.trunk, items, self.num_minibatches)
        return items

    def advantages(
        self, batch: TensorDictBase, next_values: Tensor, done: Tensor, terminated: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return advantages and the critic's targets; all are [rows, steps, 1]."""
        given = (batch["state_value"], next_values, self.reward(batch), done, terminated)
        return generalized_advantages(self.settings.gamma, self.settings.gae_lambda, *given)


def generalized_advantages(gamma: float, gae_lambda: float, *given: Tensor) -> tuple[Tensor, Tensor]:
    """Return advantages and value targets; TorchRL's faster way makes the host wait for a GPU."""
    estimate = vec_generalized_advantage_estimate if given[0].is_cpu else generalized_advantage_estimate
    with torchs_defaults():  # TorchRL multiplies flags by numbers, which gives torch's default dtype
        return estimate(gamma, gae_lambda, *given)


def critic_loss(values: Tensor, frames: Data, weight: float) -> Tensor:
    """Return the critic's weighted mean squared error."""
    loss = mean(weight * (values - frames["value_target"]).square(), frames)
    spread = frames.get("spread")
    return loss if spread is None else loss + weight * spread


def entropy_loss(log_probs: Tensor, frames: Data, weight: float) -> TensorsByName:
    """Return the policy's negative weighted entropy as a loss, and its entropy."""
    entropies = networks.entropy(log_probs)
    return {"loss_entropy": mean(-weight * entropies, frames), "entropy": mean(entropies.detach(), frames)}
