"""The tensor engine of a batch: the functions of `dynamics`, with draws made ahead; its twin is `native`."""

from __future__ import annotations

from torch import Tensor

from ctgraph_rl.batch.draw_ahead import DrawsAhead
from ctgraph_rl.batch.params import Tables
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.dynamics import RowState, StateAndShown
from ctgraph_rl.core.row_params import RowParams, Uses
from ctgraph_rl.core.tree import is_done


class TensorEngine:
    """Takes the steps of one batch on any device; every method returns the next states and what `Rows` shows of them.

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

    def reset(self, state: RowState, mask: Tensor) -> StateAndShown:
        """See `Rows.reset`."""
        words = self._draws.then(state.tick, mask)
        state, shown = dynamics.reset(state, mask, self.params, self.uses, words)
        self._draws.move(state.tick, words)
        return state, shown

    def step(self, state: RowState, action: Tensor) -> StateAndShown:
        """See `Rows.step`."""
        now = self._draws.now(state.tick)
        then = self._draws.then(state.tick, 1)
        state, shown = dynamics.step(state, action, self.params, self.uses, words=(now, then))
        self._draws.move(state.tick, then)
        return state, shown

    def act(self, state: RowState, action: Tensor) -> tuple[RowState, tuple[Tensor, Tensor]]:
        """See `Rows.act`."""
        now = self._draws.now(state.tick)
        then = self._draws.then(state.tick, 1)
        state = dynamics.advance(state, action, now, self.params, self.uses, absorbing=False)
        observation = dynamics.observe(state, then, self.params, self.uses)
        self._draws.move(state.tick, then)
        return state, (observation, is_done(state, self.params.tree))

    def step_or_reset(self, state: RowState, action: Tensor, mask: Tensor) -> StateAndShown:
        """See `Rows.step_or_reset`."""
        now = self._draws.now(state.tick)
        then = self._draws.then(state.tick, 1)
        state, shown = dynamics.step_or_reset(
            state, action, mask, params=self.params, uses=self.uses, words=(now, then)
        )
        self._draws.move(state.tick, then)
        return state, shown

    def restart(self, state: RowState, mask: Tensor | None, shown: Tensor | None) -> tuple[RowState, Tensor]:
        """See `Rows.restart`; what the rows observed last is not needed."""
        words = self._draws.then(state.tick, 1 if mask is None else mask)
        state, observation = dynamics.restart(state, mask, self.params, self.uses, words)
        self._draws.move(state.tick, words)
        return state, observation
