"""A table of how often each pair of observation and reward followed an observation and an action."""

from __future__ import annotations

import torch
from torch import Tensor

from baselines.models.model import Symbols, Transitions


class TableModel:
    """Counts, in the end the exact model of a fully observable task; it sees one observation and action.

    After counts n(c, s) of a pair s in a context c, P(s | c) = (n(c, s) + P(s)) / (n(c) + 1), with the share of all
    steps P(s) = (n(s) + 1) / (n + S) over S pairs; a new context gives the frequencies.
    """

    def __init__(self, symbols: Symbols) -> None:
        self.counts = torch.zeros(symbols.num_contexts, symbols.num_pairs, dtype=torch.float64, device="cpu")

    def learn(self, transitions: Transitions) -> None:
        """Count transitions as a `Predictor`."""
        one = torch.ones_like(self.counts[0, 0])
        self.counts.index_put_((transitions.context, transitions.pair), one, accumulate=True)

    def bits(self, transitions: Transitions) -> Tensor:
        """Return bits as a `Predictor`."""
        context = transitions.context
        every = self.counts.sum(0) + 1
        share = (every / every.sum())[transitions.pair]
        found = self.counts[context, transitions.pair] + share
        return -(found / (self.counts.sum(1)[context] + 1)).log2()
