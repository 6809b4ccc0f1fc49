"""GRU: a gated recurrent unit, a smaller rival of the LSTM.

Cho et al. 2014 (arXiv 1406.1078), with PyTorch's `torch.nn.GRU` of one layer.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.cells.cell import Cell, CellOutput, CellState
from baselines.cells.over_tree import GatedTree, GatesOverTree, GRUGates
from baselines.cells.packed import segments
from ctgraph_rl.core.kernel import is_traced
from ctgraph_rl.learn.histories import Tree


class GRU(Cell):
    """A GRU of one layer; arguments as in `Cell`."""

    state_keys = ("recurrent_state_h",)
    holds = "what its gates let in"

    def __init__(self, num_features: int, num_outputs: int, num_actions: int, **reads: bool) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        self.gru = nn.GRU(self.num_inputs, num_outputs, batch_first=True, dtype=torch.float32, device="cpu")

    @override
    def input_layers(self) -> list[tuple[Tensor, Tensor]]:
        of_inputs, _, bias, _ = self.gru.all_weights[0]
        return [(of_inputs, bias)]

    @override
    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        if is_traced():  # PyTorch's own cannot be vectorised over seeds
            after = gru_step(self.gru, gru_inputs(self.gru, inputs), state[0])
        else:
            output, _ = self.gru(inputs.unsqueeze(1), state[0].unsqueeze(0))
            after = (output.squeeze(1),)
        return after[0], after

    @override
    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        step = partial(gru_step, self.gru)
        return segments(starts).run(step, gru_inputs(self.gru, inputs), groups, state)

    @override
    def over_tree(self, tree: Tree, inputs: Tensor, groups: Tensor, state: CellState) -> Tensor:
        _, of_h, _, bias = self.gru.all_weights[0]
        given = gru_inputs(self.gru, inputs)
        return GatesOverTree.apply(GatedTree(GRUGates, tree, groups), given, of_h, bias, *state)


def gru_inputs(gru: nn.GRU, features: Tensor) -> Tensor:
    """Return what features add to r, z and n of a one-layer GRU, [..., 3 * hidden_size]."""
    of_features, _, bias, _ = gru.all_weights[0]
    return nn.functional.linear(features, of_features, bias)


def gru_step(gru: nn.GRU, given: Tensor, h: Tensor) -> CellState:
    """Return the next state, [rows, hidden_size], from `gru_inputs` and the present one."""
    _, of_h, _, bias = gru.all_weights[0]
    carried = torch.addmm(bias, h, of_h.t())
    width = 2 * h.shape[1]
    gates = (given[:, :width] + carried[:, :width]).sigmoid()
    r, z = gates.chunk(2, dim=1)
    n = torch.addcmul(given[:, width:], r, carried[:, width:]).tanh()
    return (torch.lerp(n, h, z),)
