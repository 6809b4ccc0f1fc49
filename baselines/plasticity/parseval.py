"""Parseval regularisation: the rows of hidden layers' matrices stay orthogonal and of one length.

Chung et al. 2024 (NeurIPS, arXiv 2412.07224).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from typing_extensions import override

from baselines.parts.learner import Learner
from baselines.parts.networks import Data, TensorsByName
from baselines.plasticity.plasticity import Plasticity
from ctgraph_rl.checks import not_negative, positive, require


class Parseval(Plasticity):
    """Adds coeff * sum_l (64 / n_l)^2 |W_l W_l' - scale I|^2 to the losses, over hidden layers of n_l units.

    Heads and the gates of cells are left out. The norm is that of all entries.

    Args:
        coeff: lambda, >= 0.
        scale: s, the squared length of rows: the squared gain of orthogonal initial weights.
    """

    reads_units = True

    def __init__(self, coeff: float, scale: float) -> None:
        super().__init__()
        require(*not_negative(coeff=coeff), *positive(scale=scale))
        self.coeff = coeff
        self.scale = scale

    @override
    def setup(self, agent: Learner) -> None:
        hidden = {id(layer.linear.weight) for layer in self.layers}
        self.places = [place for place, weight in enumerate(agent.trainable) if id(weight) in hidden]

    @override
    def penalties(self, batch: Data, weights: Sequence[Tensor]) -> TensorsByName:
        parts = []
        for place in self.places:
            products = weights[place] @ weights[place].mT
            wanted = self.scale * torch.eye(len(products), dtype=products.dtype, device=products.device)
            parts.append((64 / len(products)) ** 2 * (products - wanted).square().sum())
        return {"loss_parseval": self.coeff * torch.stack(parts).sum()}
