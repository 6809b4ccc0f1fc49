"""The base class of learning agents: an optimiser, the gradient step, and a state dict with both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from inspect import signature
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.func import functional_call

from baselines.parts.hooks import Hooks
from baselines.parts.networks import Data, Items, TensorsByName
from baselines.update.compiled import compiled
from baselines.update.update import Update, UpdateState, parts_of, update
from ctgraph_rl.checks import NamedValues, TakesNumbers, at_least_one, positive, require, true_or_false
from ctgraph_rl.core.region import Region, captures

MOST_PASSES = 10**6
"""Passes over a batch, or gradient steps after it; more do not end."""

LARGEST_WEIGHT = 1e12
"""Beyond this a network has diverged, and its outputs soon overflow."""


class Learner(TakesNumbers, nn.Module):
    """A module with an optimiser, from which agents derive; the defaults are those of an agent without memory.

    Args:
        num_envs: environments that it learns from.
        num_steps: steps of each environment in a batch.
        max_grad_norm: gradients are scaled down to this norm.
        compile: run gradient steps of the usual size through ``torch.compile``: faster where networks and minibatches
            are small, after seconds of compiling. An agent with ``memory`` refuses it: an LSTM gains nothing.
    """

    memory: ClassVar[bool] = False
    """Whether earlier steps of an episode can change the action."""

    stackable: ClassVar[bool] = False
    """Whether `loss` and `outputs` can be vectorised over seeds, see `baselines.update.seeds`; not with ``memory``. A
    subclass that overrides what seeds share, such as `learn`, must set it again."""

    capturable: ClassVar[bool] = False
    """Whether a gradient step has no branch on data and keeps no new tensors, so that a CUDA graph can replay it."""

    solves: ClassVar[str]
    """Which tasks it can solve in principle, in a few words."""

    policy: TensorDictModuleBase
    optimiser: torch.optim.Optimizer

    output_keys: ClassVar[tuple[str, ...]]
    """The keys of `outputs` that the network computes itself."""

    minibatch_size: int
    """Items of a minibatch, unless the end of a block has shortened the batch."""

    def __init__(self, num_envs: int, num_steps: int, max_grad_norm: float, compile: bool = False) -> None:
        super().__init__()
        require(
            *at_least_one(num_envs=num_envs, num_steps=num_steps),
            *positive(max_grad_norm=max_grad_norm),
            *true_or_false(compile=compile),
        )
        require((not (compile and self.memory), "compile must be false for an agent with an LSTM, which gains nothing"))
        self.compiled_step: Update | None = compiled(update) if compile else None
        self._region: Region | None = None
        self._takes_others = "others" in signature(self.loss).parameters
        self.method = Hooks()
        self.num_envs = num_envs
        self.num_steps = num_steps
        self.max_grad_norm = max_grad_norm

    @property
    def unwrapped(self) -> Learner:
        """The agent itself: nothing is around it."""
        return self

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return an empty recurrent state."""
        return TensorDict(batch_size=[num_envs])

    def policy_for(self, task: int) -> TensorDictModuleBase:
        """Return the policy, which is the same for all tasks."""
        return self.policy

    def start_task(self, task: int | None = None) -> None:
        """Do nothing."""

    def end_task(self) -> None:
        """Do nothing."""

    def loss(self, batch: Data) -> TensorsByName:
        """Compute the losses of a batch; see `ctgraph_rl.agent.Agent`."""
        raise NotImplementedError

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch by gradient steps on its minibatches, if it has any; see `ctgraph_rl.agent.Agent`."""
        steps = [self.after_update(self.gradient_step(minibatch)) for minibatch in self.minibatches(batch)]
        return self.after_batch(self.mean_measurements(steps)) if steps else {}

    def minibatches(self, batch: TensorDictBase) -> Iterator[Items]:
        """Yield the minibatches of a batch, each for one gradient step, which is taken before the next is made."""
        raise NotImplementedError

    def after_update(self, measured: TensorsByName) -> TensorsByName:
        """Called after a gradient step with what was measured in it; return what is worth logging of that."""
        return measured

    def after_batch(self, measurements: dict[str, float]) -> dict[str, float]:
        """Called after the last gradient step of a batch with the mean measurements; return what is worth logging."""
        return measurements

    @property
    def needs_weights(self) -> bool:
        """Whether `after_update` reads the weights after the next gradient step."""
        return False

    def other_weights(self) -> TensorsByName:
        """Return what the losses read in place of the learner's own tensors, by their names: a target network's."""
        return {}

    def num_learnt(self, batch: TensorDictBase) -> int:
        """Return how many frames of a batch one pass learns from."""
        return batch.numel()

    def outputs(self, data: Data) -> TensorsByName:
        """Compute the network's outputs at any number of steps, [..., n] each.

        These are ``log_probs`` of all actions, and those of `output_keys`: ``state_value`` or ``action_value``.
        """
        raise NotImplementedError

    def one_step(self, data: Data) -> Items:
        """Compute `outputs` for one step of all rows, and with memory the next state under ``("next", key)``."""
        return dict(self.outputs(data))

    @property
    def weights(self) -> list[nn.Parameter]:
        """The parameters by which the losses are differentiated: what the optimiser trains without a method."""
        return self.method.network_weights(self.trainable)

    @property
    def trainable(self) -> list[nn.Parameter]:
        """The optimiser's parameters: the weights, unless a method trains others in their place."""
        return self.optimiser.param_groups[0]["params"]

    def replace_optimiser(self, parameters: Sequence[nn.Parameter]) -> None:
        """Replace the optimiser by a new one of the same kind for these parameters."""
        self.optimiser = type(self.optimiser)(parameters, **self.optimiser.defaults)
        self._region = None

    def clear_optimiser_state(self, parameters: Iterable[nn.Parameter]) -> None:
        """Set the optimiser's state of these parameters to zero."""
        for parameter in parameters:
            for value in self.optimiser.state.get(parameter, {}).values():
                value.zero_()

    def reset_parameters(self) -> None:
        """Draw all weights again as at construction; layers need ``reset_parameters``."""
        self.policy.apply(reset_layer)

    def weights_changed(self) -> None:
        """Called after weights were changed other than by learning; nothing else depends on them."""

    def losses(self, batch: Data, weights: Sequence[Tensor], others: Data) -> TensorsByName:
        """Compute the agent's losses and the method's penalties.

        Args:
            batch: a minibatch.
            weights: by which the sum is differentiated; the networks have them.
            others: as `other_weights` returns them, for a ``loss`` with an argument of this name.
        """
        own = self.loss(batch, others) if self._takes_others else self.loss(batch)  # type: ignore[call-arg]
        return {**own, **self.method.penalties(batch, weights)}

    def forward(self, function: Callable[..., Any], *given: Any) -> Any:
        """Return a function of this learner: with the tensors that `torch.func.functional_call` gives it."""
        return function(self, *given)

    def with_others(self, others: Data | None, function: Callable[..., Any], *given: Any) -> Any:
        """Return a function of this learner with other tensors, by name; None: those of `other_weights`."""
        found = self.other_weights() if others is None else others
        return functional_call(self, dict(found), (function, *given), tie_weights=False)

    def gradient_step(self, batch: Data) -> TensorsByName:
        """Minimise the sum of the losses of a batch by one step; return losses and gradient norm."""
        batch = self.method.transform_minibatch(batch)
        if len(batch["action"]) != self.minibatch_size or not self.optimiser.state:
            return update(self, self.update_state, batch)
        if not self.is_captured:
            return self._usual_update(batch)
        self._region = self._region or Region(self._usual_update)
        if not self._region.takes(batch):
            return update(self, self.update_state, batch)
        return self._region.copies(batch)

    def _usual_update(self, batch: Data) -> TensorsByName:
        """Take the step, compiled where the agent is."""
        return (self.compiled_step or update)(self, self.update_state, batch)

    @property
    def update_state(self) -> UpdateState:
        """What an update of this learner changes."""
        return UpdateState(self.weights, parts_of(self.optimiser), others=self.other_weights())

    @property
    def is_captured(self) -> bool:
        """Whether gradient steps of the usual size are captured as a CUDA graph: on GPUs, without a method."""
        return self.capturable and type(self.method) is Hooks and captures(next(self.parameters()).device)

    def mean_measurements(self, steps: list[TensorsByName]) -> dict[str, float]:
        """Return the mean of each measurement over gradient steps.

        Raises:
            FloatingPointError: names the first number that is not finite, or the largest weight.
        """
        return self.means(list(steps[0]), table_of(steps))

    def means(self, names: Sequence[str], table: Tensor) -> dict[str, float]:
        """Return the means of a table of measurements, [names, gradient steps]; see `mean_measurements`."""
        return finite_means(names, table, torch.stack(torch._foreach_norm(list(self.parameters()), torch.inf)).max())

    def get_extra_state(self) -> NamedValues:
        """Return the optimiser's state, so that `state_dict` is complete."""
        saved = self.optimiser.state_dict()
        states = saved["state"].items()  # detached, tensors lack the marks of ``torch.compile``, which are not plain
        saved["state"] = {place: {key: value.detach() for key, value in state.items()} for place, state in states}
        return {"optimiser": saved}

    def set_extra_state(self, state: NamedValues) -> None:
        """Restore what `get_extra_state` returned."""
        self.optimiser.load_state_dict(state["optimiser"])
        self._region = None


def reset_layer(module: nn.Module) -> None:
    """Draw the weights of a layer, if it has any, as PyTorch does at its construction."""
    if list(module.parameters(recurse=False)):
        module.reset_parameters()  # type: ignore[operator]


def table_of(steps: Sequence[TensorsByName]) -> Tensor:
    """Return what was measured in gradient steps, [...] each, as a table, [names, gradient steps, ...]."""
    return torch.stack([torch.stack(list(step.values())) for step in steps], dim=1)


def finite_means(names: Sequence[str], table: Tensor, largest_weight: Tensor) -> dict[str, float]:
    """Return the means of a table of measurements, [names, gradient steps].

    Raises:
        FloatingPointError: names the first number that is not finite, or the largest weight.
    """
    for wrong in (~table.isfinite()).any(dim=0).nonzero()[:1, 0]:
        for name, value in zip(names, table[:, wrong], strict=True):
            require_finite(name, value)
    require_finite("the largest weight", largest_weight, LARGEST_WEIGHT)
    return dict(zip(names, table.mean(dim=1).tolist(), strict=True))


def require_finite(name: str, value: Tensor, most: float = math.inf) -> None:
    """Check that a number is finite and at most ``most``.

    Raises:
        FloatingPointError: if it is not; names the number.
    """
    if not (value.isfinite() and value.abs() <= most):
        raise FloatingPointError(f"{name} is {value.item():g}")
