"""L2 init: the weights are pulled to their initial values.

Kumar et al. 2023 (arXiv 2308.11958). The methods `L2` and `EWC` pull to the weights at the end of earlier tasks.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from typing_extensions import override

from baselines.methods.parts.weights import flat
from baselines.parts.learner import Learner
from baselines.parts.networks import Data, TensorsByName
from baselines.plasticity.plasticity import Plasticity
from ctgraph_rl.checks import not_negative, one_of, require


class L2Init(Plasticity):
    """Adds coeff * sum_i (w_i - w0_i)^2 over all weights and biases to the losses; w0 are their initial values.

    Args:
        coeff: lambda, >= 0.
        power: 2, or 1: the norm |w - w0| without its square, a pull of constant strength.
        reduction: ``sum``, or ``mean``: the mean of each tensor, added up.
    """

    initial: Tensor  # w0, float32 [P]

    def __init__(self, coeff: float, power: int = 2, reduction: str = "sum") -> None:
        super().__init__()
        require(
            *not_negative(coeff=coeff),
            (power in (1, 2), f"power must be 2 or 1, got {power!r}"),
            *one_of(("sum", "mean"), reduction=reduction),
            (power == 2 or reduction == "sum", "power=1 is the norm of all weights: set reduction=sum"),
        )
        self.coeff = coeff
        self.power = power
        self.reduction = reduction

    @override
    def setup(self, agent: Learner) -> None:
        self.register_buffer("initial", flat(agent.trainable).detach().clone())

    @override
    def penalties(self, batch: Data, weights: Sequence[Tensor]) -> TensorsByName:
        gap = flat(weights) - self.initial
        if self.power == 1:
            size = torch.linalg.vector_norm(gap)
        elif self.reduction == "sum":
            size = gap.square().sum()
        else:
            parts = gap.split([weight.numel() for weight in weights])
            size = torch.stack([part.square().mean() for part in parts]).sum()
        return {"loss_l2_init": self.coeff * size}
