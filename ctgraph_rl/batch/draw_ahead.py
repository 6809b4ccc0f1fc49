"""A stock of random words: the small draws of small batches, made for many ticks at once."""

from __future__ import annotations

import torch
from torch import Tensor

from ctgraph_rl.core import dynamics
from ctgraph_rl.core.dynamics import RowParams, Uses, Words


class Stock:
    """The small draws of all rows for many ticks, drawn in one call: many small calls would cost more."""

    def __init__(self, params: RowParams, uses: Uses, tick: Tensor, num_ticks: int) -> None:
        num_rows = len(tick)
        self.left = num_ticks - 1
        self._tick = tick
        self._place = torch.arange(num_rows, device=tick.device)
        ticks = tick + torch.arange(num_ticks, device=tick.device).unsqueeze(-1)
        self._words = [word.flatten() for word in dynamics.words_of(ticks, params, uses)]
        self._used = (uses.waits, uses.waits, uses.drawn_ids, uses.views, uses.reward_noise)

    def at(self, tick: Tensor) -> Words:
        """The draws of ticks that are at most one ahead of those of the last call."""
        self.left -= 1
        index = (tick - self._tick) * len(tick) + self._place
        pairs = zip(self._words, self._used, strict=False)
        return tuple(word.take(index) if used else index for word, used in pairs)  # what has no use is any tensor
