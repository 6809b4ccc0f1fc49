"""LSTM: long short-term memory, the default cell.

Hochreiter and Schmidhuber 1997, with PyTorch's `torch.nn.LSTM` of one layer.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.cells.cell import Cell, CellOutput, CellState, of_frames, zeros_like_weights
from baselines.cells.over_tree import GatedTree, GatesOverTree, LSTMGates
from baselines.cells.packed import segments
from ctgraph_rl.learn.histories import Tree


class LSTM(Cell):
    """An LSTM of one layer; arguments as in `Cell`."""

    state_keys = ("recurrent_state_h", "recurrent_state_c")
    merges_rows = True
    holds = "what its gates let in, and the number of times that something was seen"

    def __init__(self, num_features: int, num_outputs: int, num_actions: int, **reads: bool) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        self.lstm = nn.LSTM(self.num_inputs, num_outputs, batch_first=True, dtype=torch.float32, device="cpu")

    def zeros(self, num_rows: int) -> CellState:
        """Return zeros, [num_rows, 1, num_outputs], for both parts of the state."""
        return tuple(zeros_like_weights(self, num_rows, 1, self.num_outputs) for _ in self.state_keys)

    @override
    def input_layers(self) -> list[tuple[Tensor, Tensor]]:
        of_inputs, _, bias, _ = self.lstm.all_weights[0]
        return [(of_inputs, bias)]

    @override
    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        given = lstm_inputs(self.lstm, inputs)
        h, c = lstm_step(self.lstm, given, state[0].squeeze(1), state[1].squeeze(1))
        return h, (h.unsqueeze(1), c.unsqueeze(1))

    @override
    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        if not starts[:, 1:].any():
            output, _ = self.lstm(
                of_frames(inputs, groups), tuple(value.transpose(0, 1).contiguous() for value in state)
            )
            return output
        step = partial(lstm_step, self.lstm)
        before = [value.squeeze(1) for value in state]
        return segments(starts).run(step, lstm_inputs(self.lstm, inputs), groups, before)

    @override
    def over_tree(self, tree: Tree, inputs: Tensor, groups: Tensor, state: CellState) -> Tensor:
        given = lstm_inputs(self.lstm, inputs)
        parts = [value.squeeze(1) for value in state]
        gated = GatedTree(LSTMGates, tree, groups)
        return GatesOverTree.apply(gated, given, self.lstm.all_weights[0][1], None, *parts)


def lstm_inputs(lstm: nn.LSTM, features: Tensor) -> Tensor:
    """Return what features add to the gates of a one-layer LSTM, [..., 4 * hidden_size]."""
    of_features, _, bias, other_bias = lstm.all_weights[0]
    return nn.functional.linear(features, of_features, bias + other_bias)


def lstm_step(lstm: nn.LSTM, given: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Return the next hidden and cell states, [rows, hidden_size], from `lstm_inputs` and the present ones."""
    of_h = lstm.all_weights[0][1]
    i, f, g, o = torch.addmm(given, h, of_h.t()).chunk(4, dim=1)
    c = torch.addcmul(f.sigmoid() * c, i.sigmoid(), g.tanh())
    h = o.sigmoid() * c.tanh()
    return h, c
