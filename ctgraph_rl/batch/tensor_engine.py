"""The tensor engine of a batch: the functions of `dynamics` with draws made ahead; its twin is `native`.

Small batches draw for many ticks in one call.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ctgraph_rl.batch.native import Observed
from ctgraph_rl.batch.params import Tables
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.dynamics import RowState, StateAndShown, Words
from ctgraph_rl.core.row_params import RowParams, Uses
from ctgraph_rl.core.tree import is_done

MAX_WORDS = 2**14
"""Draws made at once, ticks times rows."""

MAX_TICKS = 256


class DrawsAhead:
    """The draws of rows, `dynamics.Words`, for their present and following ticks.

    A compiled step makes its draws itself: a table would need a graph for each tick of it.
    """

    def __init__(self, params: RowParams, uses: Uses) -> None:
        self._params = params
        self._uses = uses
        self._num_ticks = min(MAX_WORDS // len(params.row), MAX_TICKS)
        self._draws_ahead = self._num_ticks > 1 and (uses.draws or uses.reward_noise)
        self._left = 0
        self._tick: Tensor | None = None

    def serve(self, params: RowParams, uses: Uses) -> bool:
        """Return whether rows with other parameters have the same draws."""
        own = self._params
        return params.seed is own.seed and params.row is own.row and uses is self._uses

    def move(self, tick: Tensor, words: Words) -> None:
        """Advance to ticks, int64 [N], at most one ahead, with their draws."""
        self._tick = tick
        self._now = words

    def now(self, tick: Tensor) -> Words:
        """Return the draws of the rows' present ticks."""
        if tick is not self._tick:  # they were moved by others
            self._left = 0
            self.move(tick, self._at(tick, tick))
        return self._now

    def then(self, tick: Tensor, ahead: Tensor | int) -> Words:
        """Return the draws of ticks that are 0 or 1 ahead of the rows'."""
        if tick is not self._tick:
            self._tick = None
            self._left = 0
        return self._at(tick + ahead, tick)

    def _at(self, tick: Tensor, present: Tensor) -> Words:
        if not self._draws_ahead or torch.compiler.is_compiling():  # compiled: the step makes its own draws
            self._left = 0
            return dynamics.words_of(tick, self._params, self._uses)
        if self._left == 0:
            self._draw(present)
        self._left -= 1
        index = (tick - self._first) * len(tick) + self._place
        pairs = zip(self._words, self._used, strict=False)
        return tuple(word.take(index) if used else index for word, used in pairs)  # what has no use is any tensor

    def _draw(self, first: Tensor) -> None:
        uses = self._uses
        ticks = first + torch.arange(self._num_ticks, device=first.device).unsqueeze(-1)
        self._first = first
        self._left = self._num_ticks - 1  # each call is at most one tick ahead of the last
        self._place = torch.arange(len(first), device=first.device)
        self._words = [word.flatten() for word in dynamics.words_of(ticks, self._params, uses)]
        self._used = (uses.waits, uses.waits, uses.drawn_ids, uses.views, uses.reward_noise)


class TensorEngine:
    """Takes the steps of a batch on any device; methods return the next states and what rows show.

    Bind parameters before the first step.
    """

    params: RowParams
    uses: Uses
    _draws: DrawsAhead

    def bind(self, params: RowParams, tables: Tables) -> None:
        """Take parameters; draws made ahead stay while they fit the rows' streams and uses."""
        draws = getattr(self, "_draws", None)
        if draws is None or not draws.serve(params, tables.uses):
            self._draws = DrawsAhead(params, tables.uses)
        self.params = params
        self.uses = tables.uses

    def take(
        self, state: RowState, action: Tensor | None, mask: Tensor | None, shown: Tensor | None = None
    ) -> StateAndShown:
        """Take a step as `Native.take`; ``shown`` is not needed."""
        if action is None:
            assert mask is not None
            then = self._draws.then(state.tick, mask)
            state, made = dynamics.reset(state, mask, self.params, self.uses, then)
        else:
            now = self._draws.now(state.tick)
            then = self._draws.then(state.tick, 1)
            words = (now, then)
            if mask is None:
                state, made = dynamics.step(state, action, self.params, self.uses, words)
            else:
                state, made = dynamics.step_or_reset(state, action, mask, self.params, self.uses, words=words)
        self._draws.move(state.tick, then)
        return state, made

    def observe(
        self, state: RowState, action: Tensor | None, mask: Tensor | None, shown: Tensor | None = None
    ) -> tuple[RowState, Observed]:
        """Return observations only, as `Native.observe`."""
        if action is None:
            words = self._draws.then(state.tick, 1 if mask is None else mask)
            state, observation = dynamics.restart(state, mask, self.params, self.uses, words)
        else:
            now = self._draws.now(state.tick)
            words = self._draws.then(state.tick, 1)
            state = dynamics.advance(state, action, now, self.params, self.uses, absorbing=False)
            observation = dynamics.observe(state, words, self.params, self.uses)
        self._draws.move(state.tick, words)
        done = None if action is None else is_done(state, self.params.tree)
        return state, (observation, done)
