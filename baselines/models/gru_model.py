"""A GRU that predicts the next pair of observation and reward from all that came before."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from baselines.models.model import Symbols, Transitions
from baselines.update.update import minimise

WIDTH = 64

NUM_EPOCHS = 40


class GRUModel:
    """An embedding of observation and action, a GRU over the rows, and logits of all pairs.

    It does not reset at episodes' ends, which the home state shows. Learning minimises the mean bits by Adam.

    Args:
        seed: of the first weights and the order of rows.
    """

    def __init__(self, symbols: Symbols, seed: int = 0) -> None:
        self.generator = torch.Generator(device="cpu").manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.embedding = nn.Embedding(symbols.num_contexts, WIDTH, dtype=torch.float32, device="cpu")
            self.gru = nn.GRU(WIDTH, WIDTH, batch_first=True, dtype=torch.float32, device="cpu")
            self.head = nn.Linear(WIDTH, symbols.num_pairs, dtype=torch.float32, device="cpu")
        layers = nn.ModuleList([self.embedding, self.gru, self.head])
        self.optimiser = torch.optim.Adam(layers.parameters(), lr=0.01)

    def learn(self, transitions: Transitions) -> None:
        """Learn as a `Predictor`, in minibatches of 16 rows."""
        for _ in range(NUM_EPOCHS):
            order = torch.randperm(len(transitions.pair), generator=self.generator, device="cpu")
            for rows in order.split(16):
                batch = Transitions(*(each[rows] for each in transitions))
                minimise(self.optimiser, self._nats(batch).mean())

    @torch.no_grad()
    def bits(self, transitions: Transitions) -> Tensor:
        """Return bits as a `Predictor`."""
        return self._nats(transitions) / math.log(2)

    def _nats(self, transitions: Transitions) -> Tensor:
        memory, _ = self.gru(self.embedding(transitions.context))
        logits = self.head(memory).movedim(-1, 1)
        return cross_entropy(logits, transitions.pair, reduction="none")
