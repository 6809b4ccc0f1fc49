"""The base class of learning agents: the order of learning from a batch, and what is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from inspect import signature
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.func import functional_call
from typing_extensions import override

from baselines.parts.hooks import Hooks, PlasticityHooks
from baselines.parts.live_ids import only_live_ids
from baselines.parts.networks import Data, Items, TensorsByName
from baselines.parts.units import Activations, activations, hidden_layers
from baselines.update.compiled import compiled
from baselines.update.measured import finite_means, table_of
from baselines.update.update import take_step, update
from ctgraph_rl.batch.specs import TASK_NUMBER
from ctgraph_rl.checks import NamedValues, TakesNumbers, at_least_one, positive, require, true_or_false
from ctgraph_rl.core.region import Region

MOST_PASSES = 10**6  # over a batch, or gradient steps after it; more do not end


class Learner(TakesNumbers, nn.Module):
    """A module with an optimiser; the defaults are those of an agent without memory.

    Args:
        num_envs: environments that it learns from.
        num_steps: steps of each environment in a batch.
        max_grad_norm: gradients are scaled down to this norm.
        compile: run gradient steps through ``torch.compile``: faster for small networks and minibatches, after seconds
            of compiling. An agent with ``memory`` refuses it: an LSTM gains nothing.
    """

    memory: ClassVar[bool] = False
    """Whether earlier steps of an episode can change the action."""

    stackable: ClassVar[bool] = False
    """Whether `loss` and `outputs` can be vectorised over seeds, see `baselines.update.seeds`; with ``memory``, whether
    seeds can take turns. A subclass that overrides what seeds share, such as `learn`, must set it again."""

    needs_episodes: ClassVar[bool] = False
    """Whether it needs data that say where episodes end."""

    solves: ClassVar[str]
    """Which tasks it can solve in principle, in a few words."""

    output_keys: ClassVar[tuple[str, ...]]
    """The keys of `outputs` that the network computes."""

    policy: TensorDictModuleBase
    optimiser: torch.optim.Optimizer

    minibatch_size: int
    """Items of a minibatch, unless a block's end shortened the batch."""

    capturable: ClassVar[bool] = False
    """Whether a gradient step has no branch on data and keeps no new tensors, as CUDA graphs need."""

    def __init__(self, num_envs: int, num_steps: int, max_grad_norm: float, compile: bool = False) -> None:
        super().__init__()
        require(
            *at_least_one(num_envs=num_envs, num_steps=num_steps),
            *positive(max_grad_norm=max_grad_norm),
            *true_or_false(compile=compile),
        )
        require((not (compile and self.memory), "compile must be false for an agent with an LSTM, which gains nothing"))
        self.method = Hooks()
        self.plasticity = PlasticityHooks()
        self.region: Region | None = None
        self._takes_others = "others" in signature(self.loss).parameters
        self.compiled_step: Callable[..., TensorsByName] | None = compiled(update) if compile else None
        self.num_envs = num_envs
        self.num_steps = num_steps
        self.max_grad_norm = max_grad_norm

    def loss(self, batch: Data) -> TensorsByName:
        """Return the losses of a batch, as `ctgraph_rl.agent.Agent`."""
        raise NotImplementedError

    def losses(self, weights: Sequence[Tensor], batch: Data, others: Data) -> TensorsByName:
        """Return the agent's losses, and the penalties of plasticity and method.

        Args:
            weights: of the networks, by which the sum is differentiated.
            others: from `other_weights`, for a ``loss`` with an argument of this name.
        """
        own = self.loss(batch, others) if self._takes_others else self.loss(batch)  # type: ignore[call-arg]
        kept = self.plasticity.penalties(batch, weights)
        return {**own, **kept, **self.method.penalties(batch, weights)}

    def other_weights(self) -> TensorsByName:
        """Return the tensors that losses read in place of the learner's, by name: a target network's."""
        return {}

    def with_others(self, others: Data | None, function: Callable[..., Any], *given: Any) -> Any:
        """Return a function of this learner with other tensors by name; None: those of `other_weights`."""
        found = self.other_weights() if others is None else others
        return functional_call(self, dict(found), (function, *given), tie_weights=False)

    def forward(self, function: Callable[..., Any], *given: Any) -> Any:
        """Return a function of this learner with the tensors of `torch.func.functional_call`."""
        return function(self, *given)

    @property
    def weights(self) -> list[nn.Parameter]:
        """The parameters by which losses are differentiated, which the optimiser trains without a method."""
        return self.method.network_weights(self.trainable)

    @property
    def trainable(self) -> list[nn.Parameter]:
        """The optimiser's parameters: the weights, unless a method trains others."""
        return self.optimiser.param_groups[0]["params"]

    def replace_optimiser(self, parameters: Sequence[nn.Parameter]) -> None:
        """Replace the optimiser by a new one of its kind for these parameters."""
        self.optimiser = type(self.optimiser)(parameters, **self.optimiser.defaults)
        self.region = None

    def clear_optimiser_state(self, parameters: Iterable[nn.Parameter]) -> None:
        """Set the optimiser's state of these parameters to zero."""
        for parameter in parameters:
            for value in self.optimiser.state.get(parameter, {}).values():
                value.zero_()

    def reset_parameters(self) -> None:
        """Draw all weights as at construction; layers need ``reset_parameters``."""
        self.policy.apply(reset_layer)

    def weights_changed(self) -> None:
        """Called after weights were changed other than by learning."""

    def network_changed(self) -> None:
        """Called after layers were added to the policy."""

    @override
    def get_extra_state(self) -> NamedValues:
        saved = self.optimiser.state_dict()
        states = saved["state"].items()  # detached, tensors lack the marks of ``torch.compile``, which are not plain
        saved["state"] = {place: {key: value.detach() for key, value in state.items()} for place, state in states}
        return {"optimiser": saved}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        self.optimiser.load_state_dict(state["optimiser"])
        self.region = None

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch by a gradient step on each minibatch; return the mean measurements.

        Raises:
            FloatingPointError: names the first number that is not finite, or the largest weight.
        """
        self.plasticity.on_batch(batch)
        steps = []
        shown = self.shown_ids(batch)
        with nullcontext() if shown is None else only_live_ids(self, shown):
            for minibatch in self.minibatches(batch):
                measured = self.gradient_step(minibatch)
                steps.append(self.after_update(measured))
            return self.after_batch(self.means(list(steps[0]), table_of(steps))) if steps else {}

    def shown_ids(self, batch: TensorDictBase) -> Tensor | None:
        """Return the numbers of all task ids that it reads while it learns from a batch, int64 [n]; None: reads none.

        Numbers can be repeated, and -1 is none.
        """
        if TASK_NUMBER not in self.policy.in_keys:
            return None
        return torch.cat([batch[TASK_NUMBER].flatten(), batch["next", TASK_NUMBER].flatten()])

    def minibatches(self, batch: TensorDictBase) -> Iterator[Items]:
        """Yield minibatches, each for one gradient step, which is taken before the next is made."""
        raise NotImplementedError

    def gradient_step(self, batch: Data) -> TensorsByName:
        """Minimise the sum of a minibatch's losses by one step; return losses and ``grad_norm``."""
        batch = self.plasticity.transform_minibatch(self.method.transform_minibatch(batch))
        return self.plasticity.after_step(batch, take_step(self, batch))

    def after_update(self, measured: TensorsByName) -> TensorsByName:
        """Called after a gradient step with its measurements; return those to log."""
        return measured

    def means(self, names: Sequence[str], table: Tensor) -> dict[str, float]:
        """Return the means of measurements, [names, gradient steps]."""
        return finite_means(names, table, torch.stack(torch._foreach_norm(list(self.parameters()), torch.inf)).max())

    def after_batch(self, measurements: dict[str, float]) -> dict[str, float]:
        """Called after a batch with the mean measurements; return those to log."""
        return measurements

    def outputs(self, data: Data) -> TensorsByName:
        """Return the network's outputs at steps, [..., n] each.

        These are ``log_probs`` of all actions, and those of `output_keys`: ``state_value`` or ``action_value``.
        """
        raise NotImplementedError

    @property
    def tells_units(self) -> bool:
        """Whether its hidden layers are known."""
        return bool(hidden_layers(self.policy))

    def activations(self, data: Data) -> Activations:
        """Return the hidden units' activations for one step of all rows, as `baselines.parts.units.activations`."""
        sequences = {key: value.unsqueeze(1) for key, value in data.items()} if self.memory else data
        return activations(self.policy, sequences)

    @property
    def needs_weights(self) -> bool:
        """Whether `after_update` reads the weights after the next gradient step."""
        return False

    def num_learnt(self, batch: TensorDictBase) -> int:
        """Return how many frames of a batch one pass learns from."""
        return batch.numel()

    @property
    def unwrapped(self) -> Learner:
        """The agent without a method around it."""
        return self

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return an empty recurrent state."""
        return TensorDict(batch_size=[num_envs])

    def policy_for(self, task: int) -> TensorDictModuleBase:
        """Return the policy, the same for all tasks."""
        return self.policy

    def start_task(self, task: int | None = None) -> None:
        """Do nothing."""

    def end_task(self) -> None:
        """Do nothing."""


def reset_layer(module: nn.Module) -> None:
    """Draw a layer's weights, if any, as PyTorch does at construction."""
    if list(module.parameters(recurse=False)):
        module.reset_parameters()  # type: ignore[operator]
