"""No memory: one more layer, to show what an agent loses."""

from __future__ import annotations

from torch import Tensor
from typing_extensions import override

from baselines.cells.cell import Cell, CellOutput, CellState, linear_layer, of_frames
from ctgraph_rl.learn.histories import Tree


class NoMemory(Cell):
    """A linear layer with ReLU of the present step; arguments as in `Cell`."""

    memory = False
    holds = "nothing"

    def __init__(self, num_features: int, num_outputs: int, num_actions: int, **reads: bool) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        self.linear = linear_layer(self.num_inputs, num_outputs)

    @override
    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        return self.linear(inputs).relu(), ()

    @override
    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        return of_frames(self.linear(inputs).relu(), groups)

    @override
    def over_tree(self, tree: Tree, inputs: Tensor, groups: Tensor, state: CellState) -> Tensor:
        return self.linear(inputs).relu().index_select(0, groups)
