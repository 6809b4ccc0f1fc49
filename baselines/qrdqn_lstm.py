"""QR-DQN with an LSTM: the distribution of returns by quantile regression, with memory.

Dabney et al. 2018 (arXiv 1710.10044) on the recurrent parts of `baselines.parts.recurrent_q`.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import huber_loss
from torchrl.data import Composite, TensorSpec

from baselines.parts.recurrent_q import RecurrentQ


class QRDQNLSTM(RecurrentQ):
    """Recurrent Q-learning of K quantiles for each action.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        num_quantiles: quantiles of the return's distribution, K.
        settings: the arguments of `RecurrentQ`.
    """

    solves = "partially observable tasks too, if episodes are short enough to remember"

    def __init__(
        self, observation_spec: Composite, action_spec: TensorSpec, num_quantiles: int, **settings: Any
    ) -> None:
        self.num_quantiles = num_quantiles
        super().__init__(observation_spec, action_spec, **settings)

    def distance(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Compute the quantile Huber loss, eq. (10) of the paper with kappa = 1, summed over predicted quantiles."""
        predicted, target = torch.broadcast_tensors(predicted.unsqueeze(-1), target.unsqueeze(-2))
        count = predicted.shape[-2]
        numbers = torch.arange(count, dtype=torch.float32, device=predicted.device)
        fractions = ((numbers + 0.5) / count).unsqueeze(-1)
        weight = (fractions - (target < predicted).float()).abs()
        huber = huber_loss(predicted, target, reduction="none")
        return (weight * huber).mean(dim=-1).sum(dim=-1)
