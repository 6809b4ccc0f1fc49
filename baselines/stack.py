"""Tensors of several learners of equal structure, stacked: one forward pass and one gradient step for all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torch.func import vmap
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx

from baselines.learner import Learner, total_loss
from baselines.methods.method import Method
from baselines.optimisers import StackedOptimiser, stacked, unstacked


class _Place(NamedTuple):
    """Where a module has a tensor."""

    module: nn.Module
    name: str


def _places(learner: Learner) -> list[_Place]:
    """Return where a learner has its parameters and buffers, in an order that depends on its structure alone."""
    modules = [module for module in learner.modules() if not isinstance(module, TensorDictParams)]
    return [
        _Place(module, name)
        for module in modules
        for kind in (module._parameters, module._buffers)
        for name, value in kind.items()
        if value is not None
    ]


class Template:
    """A copy of a learner with no tensors of its own: it computes with those that are bound to it.

    Args:
        learner: what is copied.
    """

    def __init__(self, learner: Learner) -> None:
        learner.weights  # noqa: B018, a cached property that the copy shall have
        self.learner = deepcopy(learner)
        found = _places(self.learner)
        tensors = [getattr(place.module, place.name) for place in found]
        first = {id(tensor): number for number, tensor in reversed(list(enumerate(tensors)))}
        self.numbers = [first[id(tensor)] for tensor in tensors]
        """For each place the first one with the same tensor."""

        self.weights = [first[id(tensor)] for tensor in self.learner.weights]
        self.trained = [first[id(tensor)] for tensor in self.learner.trainable]
        self.places = found
        for place in found:
            place.module._parameters.pop(place.name, None)
            place.module._buffers.pop(place.name, None)

    def bind(self, tensors: Sequence[Tensor], others: Mapping[str, Tensor]) -> Learner:
        """Give the copy its tensors, one for each place, and the learner's other weights; return it."""
        for place, tensor in zip(self.places, tensors, strict=True):
            place.module.__dict__[place.name] = tensor
        weights = [tensors[number] for number in self.weights]
        self.learner.__dict__ |= {"weights": weights, "other_weights": lambda: others}
        if isinstance(self.learner.method, Method):
            self.learner.method.weights.parameters = weights
        return self.learner


class Stack:
    """The tensors of several learners, [seeds, ...] each, and their gradient step.

    Matrices are kept as [seeds, inputs, outputs], in which their gradients come out of the backward pass.

    Args:
        template: a copy of one of the learners.
        learners: whose tensors are read, and written by `write`.
    """

    def __init__(self, template: Template, learners: Sequence[Learner]) -> None:
        self.template, self.learners = template, learners
        self.members = [[getattr(*place) for place in _places(learner)] for learner in learners]
        self.learned = {*template.weights, *template.trained}
        self.kept: dict[int, Tensor] = {}
        self.parameters: set[int] = set()
        for number in dict.fromkeys(template.numbers):
            tensors = [each[number].detach() for each in self.members]
            if isinstance(self.members[0][number], nn.Parameter):
                self.parameters.add(number)
            join = stacked if number in self.parameters else torch.stack
            self.kept[number] = join(tensors).requires_grad_(number in self.learned)
        self.read_others()
        optimisers = [learner.optimiser for learner in learners]
        self.optimiser = StackedOptimiser(optimisers, [self.kept[number] for number in template.trained])

    @property
    def _tensors(self) -> list[Tensor]:
        """The tensors of all places, [seeds, ...] each."""
        seen = {number: unstacked(each) if number in self.parameters else each for number, each in self.kept.items()}
        return [seen[number] for number in self.template.numbers]

    def read_others(self) -> None:
        """Read the learners' other weights."""
        others = [learner.other_weights() for learner in self.learners]
        self.others = {key: torch.stack([each[key].detach() for each in others]) for key in others[0]}

    @torch.no_grad()
    def write(self) -> None:
        """Write the weights and the optimiser's state to the learners."""
        for number in self.learned:
            for tensors, value in zip(self.members, unstacked(self.kept[number]), strict=True):
                tensors[number].copy_(value)
        self.optimiser.write()

    def outputs(self, data: dict[Any, Tensor]) -> dict[str, Tensor]:
        """Compute the outputs of all networks for one step of all rows, [seeds, num_envs, n] each."""
        bind = self.template.bind
        return vmap(lambda *given: bind(given[0], given[1]).outputs(given[2]))(self._tensors, self.others, data)

    def acting_inputs(self, data: dict[Any, Tensor]) -> list[Tensor]:
        """Return the tensors that `outputs` reads, in one order."""
        return [*(tensor.detach() for tensor in self.kept.values()), *self.others.values(), *data.values()]

    def traced_outputs(self, data: dict[Any, Tensor]) -> GraphModule:
        """Return `outputs` as a graph of operations, a function of `acting_inputs`."""

        def outputs(*given: Tensor) -> dict[str, Tensor]:
            left, other = iter(given), copy(self)
            other.kept = {number: next(left) for number in self.kept}
            other.others = {key: next(left) for key in self.others}
            return other.outputs({key: next(left) for key in data})

        return make_fx(outputs, tracing_mode="fake")(*self.acting_inputs(data))

    def one_step(self, data: dict[Any, Tensor]) -> dict[Any, Tensor]:
        """Compute `Learner.one_step` of all learners, [seeds, num_envs, ...] each."""
        bind = self.template.bind
        return vmap(lambda *given: bind(given[0], given[1]).one_step(given[2]))(self._tensors, self.others, data)

    def losses(self, batch: dict[Any, Tensor]) -> tuple[dict[str, Tensor], list[Tensor]]:
        """Compute the losses of all learners from minibatches, [seeds, items, ...].

        Returns:
            The losses, [seeds] each, and their gradients by the weights, [seeds, ...] each.
        """
        bind = self.template.bind
        losses = vmap(lambda *given: bind(given[0], given[1]).losses(given[2]))(self._tensors, self.others, batch)
        weights = [self.kept[number] for number in self.template.weights]
        gradients = torch.autograd.grad(total_loss(losses).sum(), weights)
        return {key: value.detach() for key, value in losses.items()}, list(map(unstacked, gradients))

    def gradient_step(self, batch: dict[Any, Tensor]) -> dict[str, Tensor]:
        """Take `Learner.gradient_step` of all learners; return losses and gradient norms, [seeds] each."""
        losses, gradients = self.losses(batch)
        learner = self.template.bind(self._tensors, self.others)
        changed = learner.method.transform_gradients(gradients)
        norm = self.optimiser.step(map(unstacked, changed), learner.max_grad_norm)
        learner.method.after_step()
        return {**losses, "grad_norm": norm}

    def inputs(self, batch: dict[Any, Tensor]) -> list[Tensor]:
        """Return the tensors that `gradient_step` reads or updates, in one order."""
        return [*self.kept.values(), *self.optimiser.tensors, *self.others.values(), *batch.values()]

    def traced(self, batch: dict[Any, Tensor]) -> GraphModule:
        """Return `gradient_step` as a graph of operations, a function of `inputs`."""

        def step(*given: Tensor) -> dict[str, Tensor]:
            left = iter(given)
            other = copy(self)
            other.kept = {number: next(left).detach().requires_grad_(number in self.learned) for number in self.kept}
            parameters = [other.kept[number] for number in self.template.trained]
            other.optimiser = self.optimiser.functional(parameters, [next(left) for _ in self.optimiser.tensors])
            other.others = {key: next(left) for key in self.others}
            return other.gradient_step({key: next(left) for key in batch})

        return make_fx(step, tracing_mode="fake")(*(tensor.detach() for tensor in self.inputs(batch)))
