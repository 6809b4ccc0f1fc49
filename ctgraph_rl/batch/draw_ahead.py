"""The small draws of a batch; small batches make those of many ticks in one call, as many calls would cost more."""

from __future__ import annotations

import torch
from torch import Tensor

from ctgraph_rl.core import dynamics
from ctgraph_rl.core.dynamics import Words
from ctgraph_rl.core.row_params import RowParams, Uses

MAX_WORDS = 2**14
"""Draws made at once, ticks times rows."""

MAX_TICKS = 256


class Draws:
    """The draws of the rows' present and next ticks, see `dynamics.Words`.

    Args:
        num_rows: N.
    """

    def __init__(self, num_rows: int) -> None:
        self._num_ticks = min(MAX_WORDS // num_rows, MAX_TICKS)
        self.forget()

    def forget(self) -> None:
        """Forget what was drawn ahead: streams, tasks or ticks are others now."""
        self.present: Words | None = None
        self._left = 0

    def now_and_next(self, tick: Tensor, params: RowParams, uses: Uses) -> tuple[Words, Words]:
        """Return the draws of the present ticks, int64 [N], and of the next ones."""
        now = self.at(tick, tick, params, uses) if self.present is None else self.present
        return now, self.at(tick + 1, tick, params, uses)

    def at(self, tick: Tensor, present: Tensor, params: RowParams, uses: Uses) -> Words:
        """Return the draws of ticks that are at most one ahead of the present ones, int64 [N] both."""
        if self._num_ticks < 2 or not (uses.draws or uses.reward_noise):
            return dynamics.words_of(tick, params, uses)
        if self._left == 0:
            self._draw(present, params, uses)
        self._left -= 1
        index = (tick - self._first) * len(tick) + self._place
        pairs = zip(self._words, self._used, strict=False)
        return tuple(word.take(index) if used else index for word, used in pairs)  # what has no use is any tensor

    def _draw(self, first: Tensor, params: RowParams, uses: Uses) -> None:
        """Make the draws of many ticks from the first ones on."""
        ticks = first + torch.arange(self._num_ticks, device=first.device).unsqueeze(-1)
        self._first, self._left = first, self._num_ticks - 1  # a call may be one tick ahead
        self._place = torch.arange(len(first), device=first.device)
        self._words = [word.flatten() for word in dynamics.words_of(ticks, params, uses)]
        self._used = (uses.waits, uses.waits, uses.drawn_ids, uses.views, uses.reward_noise)
