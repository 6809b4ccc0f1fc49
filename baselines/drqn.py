"""DRQN: double Q-learning with an LSTM and replayed sequences.

Hausknecht and Stone 2015 (arXiv 1507.06527), with stored states and double targets: see `baselines.parts.recurrent_q`.
"""

from __future__ import annotations

from torch import Tensor
from typing_extensions import override

from baselines.parts.recurrent_q import RecurrentQ


class DRQN(RecurrentQ):
    """Deep recurrent Q-learning; arguments as in `RecurrentQ`."""

    solves = "partially observable tasks too, if episodes are short enough to remember"

    @override
    def distance(self, predicted: Tensor, target: Tensor) -> Tensor:
        return (predicted - target).square().squeeze(-1)
