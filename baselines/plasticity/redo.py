"""ReDo: units that are dormant on a minibatch are recycled.

Sokar et al. 2023 (ICML, arXiv 2302.12902), algorithm 1 and the authors' code in Dopamine.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor
from typing_extensions import override

from baselines.parts.networks import Data, TensorsByName
from baselines.parts.units import activations
from baselines.plasticity.recycling import Recycling
from ctgraph_rl.checks import at_least_one, not_negative, require


class ReDo(Recycling):
    """After every ``period``-th gradient step, units with s_i <= threshold are recycled.

    s_i = E|h_i| / (mean_k E|h_k| + 1e-9), with the mean over the layer's units k; E is over the step's minibatch, and
    over the places of a convolution.

    Args:
        threshold: tau, >= 0; 0: only units that are 0 on the whole minibatch.
        period: gradient steps.
        settings: the arguments of `Recycling`.
    """

    counts = ("num_steps",)

    def __init__(self, threshold: float, period: int, **settings: Any) -> None:
        super().__init__(**settings)
        require(*not_negative(threshold=threshold), *at_least_one(period=period))
        self.threshold = threshold
        self.period = period
        self.num_steps = 0

    @override
    def after_step(self, batch: Data, measured: TensorsByName) -> TensorsByName:
        self.num_steps += 1
        count = 0
        if self.num_steps % self.period == 0:
            found = activations(self.agent.policy, batch)
            count = self.recycle([dormancy(*found[layer.name]) <= self.threshold for layer in self.layers])
        return {**measured, "recycled": measured["grad_norm"].new_tensor(count)}


def dormancy(values: Tensor, shares: Tensor) -> Tensor:
    """Return s of each unit, [units], from activations, [n, units], and the share of frames of each row, [n]."""
    size = shares @ values.abs()
    return size / (size.mean() + 1e-9)
