"""The tensor engine of a batch: the functions of `dynamics`, with draws made ahead; its twin is `native`."""

from __future__ import annotations

from torch import Tensor

from ctgraph_rl.batch.draw_ahead import DrawsAhead
from ctgraph_rl.batch.native import Observed
from ctgraph_rl.batch.params import Tables
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.dynamics import RowState, StateAndShown
from ctgraph_rl.core.row_params import RowParams, Uses
from ctgraph_rl.core.tree import is_done


class TensorEngine:
    """Takes the steps of one batch on any device; a method returns the next states and what rows show.

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
        """See `Native.take`; ``shown`` is not needed."""
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
        """See `Native.observe`."""
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
