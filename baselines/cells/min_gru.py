"""minGRU: a GRU whose gate reads only the input, so that all steps are computed at once.

Feng et al. 2024 (arXiv 2410.01201): z = sigmoid(W_z x + b_z), h <- (1 - z) h + z (W_h x + b_h).
"""

from __future__ import annotations

import torch
from torch import Tensor
from typing_extensions import override

from baselines.cells.cell import Cell, CellOutput, CellState, linear_layer, of_frames
from baselines.cells.scan import linear_scan


class MinGRU(Cell):
    """A minGRU of one layer; arguments as in `Cell`."""

    state_keys = ("recurrent_state_h",)
    holds = "what its gate lets in, whatever it holds already"

    def __init__(self, num_features: int, num_outputs: int, num_actions: int, **reads: bool) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        self.gate = linear_layer(self.num_inputs, num_outputs)
        self.candidate = linear_layer(self.num_inputs, num_outputs)

    @override
    def input_layers(self) -> list[tuple[Tensor, Tensor]]:
        return [(self.gate.weight, self.gate.bias), (self.candidate.weight, self.candidate.bias)]

    @override
    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        carry, given = self._parts(inputs)
        output = carry * state[0] + given
        return output, (output,)

    @override
    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        carry, given = self._parts(inputs)
        carry = of_frames(carry, groups)
        given = of_frames(given, groups)
        first = given[:, :1] + carry[:, :1] * state[0].unsqueeze(1)
        goes_on = ~starts.unsqueeze(-1)
        return linear_scan(carry * goes_on, torch.cat([first, given[:, 1:]], dim=1))

    def _parts(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        gate = self.gate(inputs)
        return (-gate).sigmoid(), gate.sigmoid() * self.candidate(inputs)
