"""AMRL: an LSTM half of whose outputs are aggregated over the episode, by the maximum or the mean.

Beck et al. 2020 (ICLR, Aggregated Memory for Reinforcement Learning): m_t = max(m_{t-1}, x_t) with m_0 = 0, or m_t =
(x_1 + ... + x_t) / t; a layer reads m_t and the other half y_t.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.cells.cell import Cell, CellOutput, CellState, Units, linear_layer, zeros_like_weights
from baselines.cells.lstm import LSTM
from baselines.cells.scan import linear_scan, max_scan
from ctgraph_rl.checks import one_of, require, true_or_false

AGGREGATORS = ("max", "mean")


class AMRL(Cell):
    """Aggregated memory behind an LSTM.

    Args:
        num_outputs: width of the LSTM and the output; even.
        aggregator: ``max`` or ``mean``, which divides by the steps since the start.
        straight_through: the gradient of the aggregate by each input is 1, as in the paper, though it can explode (Beck
            et al. 2024, arXiv 2403.03020); False: that of the maximum or the mean.
    """

    merges_rows = True
    holds = "whether something was seen in an episode, for any time; and what its LSTM holds"

    def __init__(
        self,
        num_features: int,
        num_outputs: int,
        num_actions: int,
        aggregator: str,
        straight_through: bool,
        **reads: bool,
    ) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        even = f"hidden_size must be even, as AMRL aggregates one half of its LSTM, got {num_outputs}"
        require(
            *one_of(AGGREGATORS, aggregator=aggregator),
            *true_or_false(straight_through=straight_through),
            (num_outputs % 2 == 0, f"{even}: use {num_outputs + 1}"),
        )
        self.inner = LSTM(num_features, num_outputs, num_actions, **reads)
        self.linear = linear_layer(num_outputs, num_outputs)
        self.relu = nn.ReLU()
        self.is_max = aggregator == "max"
        self.straight_through = straight_through
        own = ("recurrent_state_max",) if self.is_max else ("recurrent_state_sum", "recurrent_state_count")
        self.state_keys = (*LSTM.state_keys, *own)

    def zeros(self, num_rows: int) -> CellState:
        """Return zeros of the LSTM, and the maxima, [num_rows, num_outputs // 2], or sums and a count."""
        aggregated = zeros_like_weights(self, num_rows, self.num_outputs // 2)
        zeros = (*self.inner.zeros(num_rows), aggregated)
        return zeros if self.is_max else (*zeros, zeros_like_weights(self, num_rows, 1))

    @override
    def input_layers(self) -> list[tuple[Tensor, Tensor]]:
        return self.inner.input_layers()

    @override
    def hidden_layers(self) -> list[Units]:
        return [Units("cell", self.linear, self.relu)]

    @override
    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        memory, inner = self.inner.step(inputs, state[:2])
        x, y = memory.chunk(2, dim=-1)
        starts = x.new_zeros(len(x), 1, dtype=torch.bool)
        m, after = self._aggregate(x.unsqueeze(1), starts, state[2:])
        return self._output(m[:, 0], y), (*inner, *after)

    @override
    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        memory = self.inner.sequence(inputs, groups, starts, state[:2])
        x, y = memory.chunk(2, dim=-1)
        m, _ = self._aggregate(x, starts, state[2:])
        return self._output(m, y)

    def _aggregate(self, x: Tensor, starts: Tensor, state: CellState) -> CellOutput:
        if self.is_max:
            first = torch.maximum(state[0].unsqueeze(1), x[:, :1])
            m = max_scan(torch.cat([first, x[:, 1:].relu()], dim=1), starts)
        else:
            sums = _sums(x, starts, state[0])
            counts = _sums(torch.ones_like(x[..., :1]), starts, state[1])
            m = sums / counts
        if self.straight_through:
            straight = _sums(x, starts, state[0]) if self.is_max else sums
            m = m.detach() + (straight - straight.detach())
        after = (m,) if self.is_max else (sums, counts)
        return m, tuple(value[:, -1] for value in after)

    def _output(self, m: Tensor, y: Tensor) -> Tensor:
        return self.relu(self.linear(torch.cat([y, m], dim=-1)))


def _sums(inputs: Tensor, starts: Tensor, state: Tensor) -> Tensor:
    first = state.unsqueeze(1) + inputs[:, :1]
    carry = (~starts).unsqueeze(-1).to(inputs.dtype)
    return linear_scan(carry, torch.cat([first, inputs[:, 1:]], dim=1))
