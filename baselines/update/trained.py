"""What updates, methods and checkpoints need of a learner: losses, weights and optimiser state."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from inspect import signature
from typing import Any, ClassVar

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.func import functional_call
from typing_extensions import override

from baselines.parts.hooks import Hooks, PlasticityHooks
from baselines.parts.networks import Data, TensorsByName
from ctgraph_rl.checks import NamedValues
from ctgraph_rl.core.region import Region


class Trained(nn.Module):
    """A module with losses and an optimiser, the base of `baselines.parts.learner.Learner`."""

    policy: TensorDictModuleBase
    optimiser: torch.optim.Optimizer
    max_grad_norm: float

    minibatch_size: int
    """Items of a minibatch, unless a block's end shortened the batch."""

    capturable: ClassVar[bool] = False
    """Whether a gradient step has no branch on data and keeps no new tensors, as CUDA graphs need."""

    compiled_step: Callable[..., TensorsByName] | None = None
    """`baselines.update.update.update`, compiled."""

    def __init__(self) -> None:
        super().__init__()
        self.method = Hooks()
        self.plasticity = PlasticityHooks()
        self.region: Region | None = None
        self._takes_others = "others" in signature(self.loss).parameters

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


def reset_layer(module: nn.Module) -> None:
    """Draw a layer's weights, if any, as PyTorch does at construction."""
    if list(module.parameters(recurse=False)):
        module.reset_parameters()  # type: ignore[operator]
