"""The hidden units of a network: what writes them, what reads them, and their activations."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from baselines.cells.cell import Units
from baselines.parts.networks import HISTORY, Data, Encoder, RecurrentModule, trunk_of


class Reader(NamedTuple):
    """A layer that reads units."""

    weight: Tensor
    bias: Tensor
    num_units: int
    apart: int | None = None
    """Columns from one input of a unit to its next; None: it has one."""

    within: int | None = None
    """How many columns are inputs; None: all."""

    @property
    def columns(self) -> Tensor:
        """The inputs of each unit, int64 [units, k]: several for a channel, and for a unit read at several steps."""
        inputs = torch.arange(self.within or self.weight.shape[1], device=self.weight.device)
        return inputs.view(-1, self.apart or len(inputs))[:, : self.num_units].T


class HiddenLayer(NamedTuple):
    """A layer of units with all that reads them: heads of actor and critic both, the gates of a cell."""

    name: str
    linear: Any
    """The `torch.nn.Linear` of incoming weights and biases; None for the state of a cell, which no ReLU writes."""

    activation: Any
    """The module that writes the units, [..., units]; None likewise."""

    readers: list[Reader]

    @property
    def num_units(self) -> int:
        """Number of units."""
        return self.readers[0].num_units

    @property
    def norm(self) -> nn.LayerNorm | None:
        """The layer norm before the ReLU, if any."""
        parts = () if self.activation is None else self.activation.modules()
        return next((part for part in parts if isinstance(part, nn.LayerNorm)), None)


Activations = dict[str, tuple[Tensor, Tensor]]
"""By layer: activations, float32 [n, units], and the share of all frames that each row stands for, [n]."""


def hidden_layers(policy: nn.Module) -> list[HiddenLayer]:
    """Return the hidden layers of an agent's policy, from its inputs on; none where it has no `Encoder`."""
    trunk: Any = trunk_of(policy)
    recurrent = isinstance(trunk, RecurrentModule)
    encoder = trunk.encoder.module if recurrent else getattr(trunk, "module", None)
    if not isinstance(encoder, Encoder):
        return []
    heads = _heads(policy, trunk)
    of_heads = [_linear_layers(head)[0] for head in heads]
    into_heads = [(layer.weight, layer.bias) for layer in of_heads]
    found = []
    chain = encoder.hidden_layers()
    for units, after in pairwise(chain):
        is_channel = encoder.convolutions is not None and after.linear not in encoder.further
        apart = units.linear.out_features if is_channel else None
        within = encoder.linear.num_inputs if after.linear is encoder.linear else None
        found.append(_layer(units, [(after.linear.weight, after.linear.bias)], apart, within))
    if recurrent:
        found.append(_layer(chain[-1], trunk.cell.input_layers(), trunk.cell.num_inputs))
        inside = trunk.cell.hidden_layers()
        for units in inside:
            read = into_heads if units.reader is None else [(units.reader.weight, units.reader.bias)]
            found.append(_layer(units, read))
        if not inside or inside[-1].reader is not None:
            readers = [Reader(*each, trunk.cell.num_outputs) for each in into_heads]
            found.append(HiddenLayer("memory", None, None, readers))
    else:
        found.append(_layer(chain[-1], into_heads))
    for number, head in enumerate(heads, 1):
        layers = _linear_layers(head)
        if isinstance(head, nn.Sequential) and len(layers) == 2:
            units = Units(f"head.{number}", layers[0], head[1])
            found.append(_layer(units, [(layers[1].weight, layers[1].bias)]))
    return found


@torch.no_grad()
def activations(policy: nn.Module, data: Data) -> Activations:
    """Return the activations of each hidden layer for frames, those of equal histories once.

    Args:
        data: what the trunk reads, [frames, ...] each, with memory [rows, steps, ...]; and the numbers of inputs and
            histories, if there are any.
    """
    trunk: Any = trunk_of(policy)
    recurrent = isinstance(trunk, RecurrentModule)
    layers = hidden_layers(policy)
    written: dict[str, list[Tensor]] = {layer.name: [] for layer in layers}
    handles = []
    for layer in layers:
        if layer.activation is not None:
            handles.append(layer.activation.register_forward_hook(partial(_keep, written[layer.name])))
    try:
        if HISTORY in data:
            features, numbers = trunk.of_histories(data)
            of_histories = _shares(numbers)
        else:
            features = trunk.over_time(data).flatten(0, -2)
            of_histories = features.new_full([len(features)], 1 / len(features))
        if any(layer.name.startswith("head") for layer in layers):
            for head in _heads(policy, trunk):
                head(features)
    finally:
        for handle in handles:
            handle.remove()
    of_inputs = _shares(trunk.input_groups(data)) if recurrent else of_histories
    encoded = [units.name for units in (trunk.encoder.module if recurrent else trunk.module).hidden_layers()]
    if recurrent and not trunk.cell.memory:
        encoded.append("cell")
    found = {}
    for layer in layers:
        steps = written[layer.name] or [features]
        values = (steps[0] if len(steps) == 1 else torch.cat(steps)).flatten(0, -2)
        shares = of_inputs if layer.name in encoded else of_histories
        positions = len(values) // len(shares)
        if positions > 1:
            shares = (shares / positions).repeat_interleave(positions)
        found[layer.name] = values, shares
    return found


def _heads(policy: nn.Module, trunk: Any) -> list[nn.Module]:
    found: list[nn.Module] = []
    for part in policy.modules():
        if isinstance(part, TensorDictModule) and not isinstance(part, TensorDictSequential):
            reads = trunk.out_keys[0] in part.in_keys
            found += [part.module] * (reads and isinstance(part.module, nn.Module))
    return found


def _linear_layers(module: nn.Module) -> list[nn.Linear]:
    return [part for part in module.modules() if isinstance(part, nn.Linear)]


def _layer(
    units: Units, read: Sequence[tuple[Tensor, Tensor]], apart: int | None = None, within: int | None = None
) -> HiddenLayer:
    count = units.linear.out_features
    readers = [Reader(weight, bias, count, apart, within) for weight, bias in read]
    return HiddenLayer(units.name, units.linear, units.activation, readers)


def _keep(values: list[Tensor], module: nn.Module, arguments: Any, output: Tensor) -> None:
    values.append(output)


def _shares(numbers: Tensor) -> Tensor:
    counts = numbers.bincount()
    return counts.to(torch.float32) / counts.sum()
