"""Continual backprop: in each gradient step a small share of the old units of least use is recycled.

Dohare et al. 2024 (Nature 632, 768), algorithm 1 and the authors' code.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from baselines.parts.learner import Learner
from baselines.parts.networks import Data, TensorsByName
from baselines.parts.units import HiddenLayer, activations
from baselines.plasticity.recycling import Recycling
from ctgraph_rl.checks import fraction, is_int, require


class ContinualBackprop(Recycling):
    """After each gradient step, with activations h of its minibatch, for each hidden unit:

        age <- age + 1,  f <- decay f + (1 - decay) E h,  u <- decay u + (1 - decay) mean|w_out| E|h|.

    w_out are its outgoing weights, in both heads where these read it. A layer recycles floor(rate * n) units in all,
    where n counts its units with age > maturity, added up over the steps: those of least u / (1 - decay^age). The
    biases of what reads them take over their mean activation, f / (1 - decay^age); then age, f and u start at 0.

    Args:
        rate: rho, in [0, 1].
        maturity: m, gradient steps without recycling.
        decay: of the running means, in [0, 1).
        settings: the arguments of `Recycling`.
    """

    age: Tensor  # int64 [U], as all layers' units one after the other
    mean: Tensor  # f, float32 [U]
    utility: Tensor  # u, float32 [U]
    eligible: Tensor  # n, int64 [layers]
    replaced: Tensor  # units so far, int64 [layers]

    def __init__(self, rate: float, maturity: int, decay: float, **settings: Any) -> None:
        super().__init__(**settings)
        require(
            *fraction(rate=rate, decay=decay),
            (decay < 1, f"decay must be below 1, got {decay!r}"),
            (is_int(maturity, 0), f"maturity must be an integer >= 0, got {maturity!r}"),
        )
        self.rate = rate
        self.maturity = maturity
        self.decay = decay

    @override
    def setup(self, agent: Learner) -> None:
        self.sizes = [layer.num_units for layer in self.layers]
        for name in ("age", "eligible", "replaced"):
            size = sum(self.sizes) if name == "age" else len(self.sizes)
            self.register_buffer(name, torch.zeros(size, dtype=torch.int64, device="cpu"))
        for name in ("mean", "utility"):
            self.register_buffer(name, torch.zeros(sum(self.sizes), dtype=torch.float32, device="cpu"))

    @override
    @torch.no_grad()
    def after_step(self, batch: Data, measured: TensorsByName) -> TensorsByName:
        found = activations(self.agent.policy, batch)
        mean = []
        utility = []
        for layer in self.layers:
            values, shares = found[layer.name]
            mean.append(shares @ values)
            utility.append(outgoing(layer) * (shares @ values.abs()))
        self.age += 1
        self.mean.lerp_(torch.cat(mean), 1 - self.decay)
        self.utility.lerp_(torch.cat(utility), 1 - self.decay)
        correction = 1 - self.decay**self.age
        chosen = self._least_useful(self.utility / correction)
        count = self.recycle(chosen.split(self.sizes), (self.mean / correction).split(self.sizes))
        for values in (self.age, self.mean, self.utility):
            values.masked_fill_(chosen, 0)
        return {**measured, "recycled": measured["grad_norm"].new_tensor(count)}

    def _least_useful(self, utility: Tensor) -> Tensor:
        mature = self.age > self.maturity
        chosen = torch.zeros_like(mature)
        parts = [each.split(self.sizes) for each in (mature, utility, chosen)]
        for number, (old, use, taken) in enumerate(zip(*parts, strict=True)):
            self.eligible[number] += old.sum()
            count = int(self.rate * int(self.eligible[number])) - int(self.replaced[number])
            taken[use.masked_fill(~old, torch.inf).topk(count, largest=False).indices] = True
            self.replaced[number] += count
        return chosen


def outgoing(layer: HiddenLayer) -> Tensor:
    """Return the mean size of each unit's outgoing weights, [units]."""
    sizes = [reader.weight[:, reader.columns].abs().transpose(0, 1).flatten(1) for reader in layer.readers]
    return torch.cat(sizes, dim=1).mean(dim=1)
