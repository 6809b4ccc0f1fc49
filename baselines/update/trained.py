"""What updates, methods and checkpoints need of a learner: losses, weights and the state of its optimiser."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from inspect import signature
from typing import Any, ClassVar

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.func import functional_call
from typing_extensions import override

from baselines.parts.hooks import Hooks
from baselines.parts.networks import Data, TensorsByName
from ctgraph_rl.checks import NamedValues
from ctgraph_rl.core.region import Region


class Trained(nn.Module):
    """A module with losses and an optimiser; `baselines.parts.learner.Learner` derives from it."""

    policy: TensorDictModuleBase
    optimiser: torch.optim.Optimizer
    max_grad_norm: float

    minibatch_size: int
    """Items of a minibatch, unless the end of a block has shortened the batch."""

    capturable: ClassVar[bool] = False
    """Whether a gradient step has no branch on data and keeps no new tensors, so that a CUDA graph can replay it."""

    compiled_step: Callable[..., TensorsByName] | None = None
    """`baselines.update.update.update`, compiled."""

    def __init__(self) -> None:
        super().__init__()
        self.method = Hooks()
        self.region: Region | None = None
        self._takes_others = "others" in signature(self.loss).parameters

    def loss(self, batch: Data) -> TensorsByName:
        """Compute the losses of a batch; see `ctgraph_rl.agent.Agent`."""
        raise NotImplementedError

    def losses(self, batch: Data, weights: Sequence[Tensor], others: Data) -> TensorsByName:
        """Compute the agent's losses and the method's penalties.

        Args:
            batch: a minibatch.
            weights: by which the sum is differentiated; the networks have them.
            others: as `other_weights` returns them, for a ``loss`` with an argument of this name.
        """
        own = self.loss(batch, others) if self._takes_others else self.loss(batch)  # type: ignore[call-arg]
        return {**own, **self.method.penalties(batch, weights)}

    def other_weights(self) -> TensorsByName:
        """Return what the losses read in place of the learner's own tensors, by their names: a target network's."""
        return {}

    def with_others(self, others: Data | None, function: Callable[..., Any], *given: Any) -> Any:
        """Return a function of this learner with other tensors, by name; None: those of `other_weights`."""
        found = self.other_weights() if others is None else others
        return functional_call(self, dict(found), (function, *given), tie_weights=False)

    def forward(self, function: Callable[..., Any], *given: Any) -> Any:
        """Return a function of this learner: with the tensors that `torch.func.functional_call` gives it."""
        return function(self, *given)

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
        self.region = None

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


def reset_layer(module: nn.Module) -> None:
    """Draw the weights of a layer, if it has any, as PyTorch does at its construction."""
    if list(module.parameters(recurse=False)):
        module.reset_parameters()  # type: ignore[operator]
