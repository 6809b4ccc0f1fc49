"""Learning with thousands of task ids, of which few are ever shown: without the weights of the others.

Adam and RMSprop change no weight whose gradients were all 0. So a step changes only the columns of ids that were
shown. A batch is learned with a matrix of these, which a step reads in a fraction of the time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from baselines.parts.hooks import Hooks, PlasticityHooks
from baselines.parts.networks import IdLinear, TensorsByName
from baselines.update.update import MOMENTS, has_parts

if TYPE_CHECKING:
    from baselines.parts.learner import Learner

MANY_IDS = 1024
"""Fewest ids of a layer from which it learns without those that were never shown."""


@contextmanager
def only_live_ids(learner: Learner, shown: Tensor) -> Iterator[None]:
    """Learn with the columns of ids that are shown or were; the layers have all columns before and after.

    On GPUs, compiled, with a method, a plasticity, weight decay or another optimiser they keep all columns, as these
    may change any.

    Args:
        shown: from `baselines.parts.learner.Learner.shown_ids`.
    """
    layers = _layers(learner) if _leaves_others(learner, shown) else []
    if not layers:
        yield
        return
    live = torch.zeros(layers[0].num_ids, dtype=torch.bool, device="cpu")
    live[shown.clamp(min=0)] = True
    tables = [_Table(layer, learner.optimiser) for layer in layers]
    names = {id(value): name for name, value in learner.other_weights().items()}
    for table in tables:
        squares = table.moments.get(MOMENTS[type(learner.optimiser)][-1])
        if squares is not None:
            live |= table.of_ids(squares).sum(dim=0) != 0
        if id(table.weight) in names:  # what a target has not yet copied
            online = learner.get_parameter(names[id(table.weight)]).data
            live |= (table.of_ids(table.all_columns) != table.of_ids(online)).any(dim=0)
    try:
        for table in tables:
            table.narrow(live.nonzero().squeeze(1))
        yield
    finally:
        for table in tables:
            table.widen()


def _leaves_others(learner: Learner, shown: Tensor) -> bool:
    is_plain = type(learner.method) is Hooks and type(learner.plasticity) is PlasticityHooks
    decays = any(group["weight_decay"] for group in learner.optimiser.param_groups)
    return shown.is_cpu and is_plain and learner.compiled_step is None and has_parts(learner.optimiser) and not decays


def _layers(learner: Learner) -> list[IdLinear]:
    found = []
    for module in learner.modules():
        if isinstance(module, IdLinear) and module.num_ids >= MANY_IDS:
            weight = module.weight
            if not weight.requires_grad or any(weight is other for other in learner.weights):
                found.append(module)
    return found


class _Table:
    def __init__(self, layer: IdLinear, optimiser: torch.optim.Optimizer) -> None:
        self.layer = layer
        self.weight = layer.weight
        self.all_columns = self.weight.data
        self.optimiser = optimiser
        self.moments = self._moments()

    def _moments(self) -> TensorsByName:
        state = self.optimiser.state.get(self.weight, {})
        return {key: value for key, value in state.items() if value.ndim == 2}

    def of_ids(self, matrix: Tensor) -> Tensor:
        """Return the columns of ids, [num_features, num_ids]."""
        return matrix.narrow(1, self.layer.num_inputs, self.layer.num_ids)

    def narrow(self, live: Tensor) -> None:
        """Leave only the columns of live ids, int64 [n] in rising order."""
        kept = torch.ones(self.weight.shape[1], dtype=torch.bool, device="cpu")
        kept.narrow(0, self.layer.num_inputs, self.layer.num_ids).zero_()
        kept[self.layer.num_inputs + live] = True
        self.columns = kept.nonzero().squeeze(1)
        self.weight.data = self.all_columns.index_select(1, self.columns)
        for key, value in self.moments.items():
            self.optimiser.state[self.weight][key] = value.index_select(1, self.columns)
        self.layer.live_ids = live

    def widen(self) -> None:
        """Put back all columns."""
        self.all_columns.index_copy_(1, self.columns, self.weight.data)
        self.weight.data = self.all_columns
        for key, value in self._moments().items():
            whole = self.moments[key] if key in self.moments else torch.zeros_like(self.all_columns)
            self.optimiser.state[self.weight][key] = whole.index_copy_(1, self.columns, value)
        self.layer.live_ids = None
