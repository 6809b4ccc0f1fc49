"""Stacked tensors of learners of equal structure: one forward pass and one update for all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx

from baselines.parts.learner import Learner
from baselines.parts.networks import Data, Items, TensorsByName
from baselines.update.update import Parts, UpdateState, over_seeds, parts_of, stacked, unstacked


def named_tensors(learner: Learner) -> TensorsByName:
    """Return a learner's parameters and buffers by name, without other weights, in the order of its structure."""
    others = {id(value) for value in learner.other_weights().values()}
    found = {}
    for path, module in learner.named_modules():
        for name, value in (*module._parameters.items(), *module._buffers.items()):
            if value is not None and id(value) not in others:
                found[f"{path}.{name}" if path else name] = value
    return found


class Stack:
    """The tensors of several learners, [seeds, ...] each, which stay in place in memory.

    Args:
        learners: whose tensors are read at construction and by `read`, and written by `write`.
    """

    def __init__(self, learners: Sequence[Learner]) -> None:
        self.learners = learners
        first = learners[0]
        names: dict[int, str] = {}
        turned = []
        self.first_name: dict[str, str] = {}
        for name, tensor in named_tensors(first).items():
            self.first_name[name] = names.setdefault(id(tensor), name)
            if isinstance(tensor, nn.Parameter) and tensor.ndim == 2:
                turned.append(name)
        self.turned = tuple(turned)
        self.weights = [names[id(tensor)] for tensor in first.weights]
        self.trained = [names[id(tensor)] for tensor in first.trainable]
        self.learned = {*self.weights, *self.trained}
        self.written = {*self.learned, *(f"method.{name}" for name in first.method.step_buffers)}
        self.kept: TensorsByName = {}
        self.moments: list[TensorsByName] = [{} for _ in self.trained]
        self.others: TensorsByName = {}
        self.read()
        for name in self.learned:
            self.kept[name].requires_grad_()

    @torch.no_grad()
    def read(self) -> None:
        """Read the learners' tensors."""
        members = [named_tensors(learner) for learner in self.learners]
        for name in dict.fromkeys(self.first_name.values()):
            join = stacked if name in self.turned else torch.stack
            _keep(self.kept, name, join([each[name] for each in members]))
        for number, states in enumerate(self._states()):
            for key in states[0]:
                values = [state[key] for state in states]
                joined = torch.stack(values).amax(dim=0) if key == "step" else stacked(values)  # 0 of one that failed
                _keep(self.moments[number], key, joined)
        self.read_others()

    @torch.no_grad()
    def read_others(self) -> None:
        """Read the learners' other weights."""
        others = [learner.other_weights() for learner in self.learners]
        for key in others[0]:
            _keep(self.others, key, torch.stack([each[key] for each in others]))

    @torch.no_grad()
    def write(self) -> None:
        """Write a step's changes to the learners: weights, buffers of methods, the optimiser's state."""
        members = [named_tensors(learner) for learner in self.learners]
        for name in self.written:
            value = self.kept[name]
            values = list((unstacked(value) if name in self.turned else value).unbind())
            torch._foreach_copy_([each[name] for each in members], values)
        for moments, states in zip(self.moments, self._states(), strict=True):
            for key, value in moments.items():
                values = [value] * len(states) if key == "step" else list(unstacked(value).unbind())
                torch._foreach_copy_([state[key] for state in states], values)

    def _states(self) -> list[list[TensorsByName]]:
        parts = [cast(Parts, parts_of(learner.optimiser)) for learner in self.learners]
        return [list(states) for states in zip(*(each.state for each in parts), strict=True)]

    @property
    def state(self) -> UpdateState:
        """What an update of all learners changes."""
        weights = [self.kept[name] for name in self.weights]
        own = cast(Parts, parts_of(self.learners[0].optimiser))
        optimiser = own._replace(parameters=[self.kept[name] for name in self.trained], state=self.moments)
        return UpdateState(
            weights,
            optimiser,
            self._named(self.kept),
            names=self.weights,
            turned=self.turned,
            others=self.others,
        )

    def _named(self, kept: TensorsByName) -> TensorsByName:
        return {name: kept[first] for name, first in self.first_name.items()}

    def acting_inputs(self, data: Items) -> list[Tensor]:
        """Return the tensors that `traced_outputs` reads, in a fixed order."""
        return [*(tensor.detach() for tensor in self.kept.values()), *data.values()]

    def traced_outputs(self, data: Items) -> GraphModule:
        """Return a graph of operations, a function of `acting_inputs`.

        It returns the outputs of all networks for one step of all rows, [seeds, num_envs, n] each.
        """
        state = self.state

        def outputs(*given: Tensor) -> TensorsByName:
            kept = dict(zip(self.kept, given, strict=False))
            its = dict(zip(data, given[len(kept) :], strict=True))
            return over_seeds(self.learners[0], _outputs, state._replace(tensors=self._named(kept)), its)

        return make_fx(outputs, tracing_mode="fake")(*self.acting_inputs(data))


def _keep(kept: TensorsByName, name: str, value: Tensor) -> None:
    if name in kept:
        kept[name].copy_(value)
    else:
        kept[name] = value


def _outputs(learner: Learner, weights: Sequence[Tensor], data: Data) -> TensorsByName:
    return learner.outputs(data)
