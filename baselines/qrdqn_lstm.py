"""QR-DQN with an LSTM: the distribution of returns by quantile regression, with memory.

Dabney et al. 2018 (arXiv 1710.10044) on the recurrent parts of `baselines.parts.recurrent_q`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from baselines.parts.recurrent_q import RecurrentQ, RecurrentQSettings
from ctgraph_rl.checks import at_least_one, require


@dataclass(frozen=True, kw_only=True)
class QRDQNLSTMSettings(RecurrentQSettings):
    """The settings of `QRDQNLSTM`."""

    num_quantiles: int  # quantiles of the return's distribution, K

    def __post_init__(self) -> None:
        super().__post_init__()
        require(*at_least_one(num_quantiles=self.num_quantiles))


class QRDQNLSTM(RecurrentQ):
    """Recurrent Q-learning of K quantiles for each action."""

    Settings = QRDQNLSTMSettings
    solves = "partially observable tasks too, if episodes are short enough to remember"

    @property
    def num_quantiles(self) -> int:  # type: ignore[override]
        """K."""
        return self.settings.num_quantiles

    def distance(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return the quantile Huber loss, eq. (10) of the paper with kappa = 1, summed over predicted quantiles."""
        predicted, target = torch.broadcast_tensors(predicted.unsqueeze(-1), target.unsqueeze(-2))
        count = predicted.shape[-2]
        numbers = torch.arange(count, dtype=torch.float32, device=predicted.device)
        fractions = ((numbers + 0.5) / count).unsqueeze(-1)
        weight = (fractions - (target < predicted).float()).abs()
        huber = huber_loss(predicted, target, reduction="none")
        return (weight * huber).mean(dim=-1).sum(dim=-1)
