"""No memory: one more layer, to show what an agent loses."""

from __future__ import annotations

from torch import Tensor, nn
from typing_extensions import override

from baselines.cells.cell import Cell, CellOutput, CellState, Units, linear_layer, of_frames
from ctgraph_rl.learn.histories import Tree


class NoMemory(Cell):
    """A linear layer with ReLU of the present step; arguments as in `Cell`."""

    memory = False
    holds = "nothing"

    def __init__(self, num_features: int, num_outputs: int, num_actions: int, **reads: bool) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        self.linear = linear_layer(self.num_inputs, num_outputs)
        self.relu = nn.ReLU()

    @override
    def input_layers(self) -> list[tuple[Tensor, Tensor]]:
        return [(self.linear.weight, self.linear.bias)]

    @override
    def hidden_layers(self) -> list[Units]:
        return [Units("cell", self.linear, self.relu)]

    @override
    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        return self.relu(self.linear(inputs)), ()

    @override
    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        return of_frames(self.relu(self.linear(inputs)), groups)

    @override
    def over_tree(self, tree: Tree, inputs: Tensor, groups: Tensor, state: CellState) -> Tensor:
        return self.relu(self.linear(inputs)).index_select(0, groups)
