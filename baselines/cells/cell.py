"""The base class of cells: a state, one step, and a sequence with resets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from ctgraph_rl.checks import TakesNumbers, require, true_or_false
from ctgraph_rl.core.dynamics import beside
from ctgraph_rl.learn.collect import PREVIOUS_ACTION
from ctgraph_rl.learn.histories import Tree

CellState = tuple[Tensor, ...]
"""The parts of a state, [rows, ...] each, in the order of ``state_keys``."""

CellOutput = tuple[Tensor, CellState]
"""The output of a step, and the next state."""

REWARD = "reward"


class Units(NamedTuple):
    """A hidden layer's units, without what reads them."""

    name: str
    linear: nn.Linear
    activation: nn.Module
    """What writes the units, [..., units]: a ReLU, or one behind a layer norm."""

    reader: nn.Linear | None = None
    """What reads the units; None: the next layer, or the heads."""


class Cell(TakesNumbers, nn.Module):
    """What an agent remembers with: it reads features at each step and writes what the heads read.

    Subclasses define `state_keys`, `zeros` and `step`, and `sequence` where there is a faster way. A parameter outside
    PyTorch's layers needs a ``reset_parameters``. A cell reads the observation's features and, if set, the last action
    and reward, never the time.

    Args:
        num_outputs: width of what it writes.
        reads_action: also read the last action, one-hot; zeros at the start of an episode.
        reads_reward: also read the last reward; 0 at the start of an episode.
    """

    state_keys: tuple[str, ...] = ()
    """Keys of its state in the data. Of a key that begins with `ctgraph_rl.learn.collect.UNSTORED` batches hold the
    value before their first step only, which is all that `sequence` needs.
    """

    memory: ClassVar[bool] = True
    """Whether it holds anything of earlier steps."""

    merges_rows: ClassVar[bool] = False
    """Whether a step takes longer than finding the rows with the same history, so that it pays to act once for them."""

    gains_together: ClassVar[bool] = True
    """Whether several seeds in one process take less CPU time than each by itself."""

    holds: ClassVar[str]
    """What it can hold, in a few words."""

    step_cost: float = 1.0
    """Time of a history in `over_tree`, relative to that of other cells."""

    def __init__(
        self,
        num_features: int,
        num_outputs: int,
        num_actions: int,
        reads_action: bool = False,
        reads_reward: bool = False,
    ) -> None:
        super().__init__()
        require(*true_or_false(reads_action=reads_action, reads_reward=reads_reward))
        self.own_keys = (PREVIOUS_ACTION,) * reads_action + (REWARD,) * reads_reward
        self.num_inputs = num_features + num_actions * reads_action + reads_reward
        self.num_outputs = num_outputs
        self.num_actions = num_actions

    def input_layers(self) -> list[tuple[Tensor, Tensor]]:
        """Return weights, [n, inputs], and biases, [n], of the layers that read the inputs, of one or several steps."""
        raise NotImplementedError

    def hidden_layers(self) -> list[Units]:
        """Return the layers with ReLU; units without a ``reader`` are the cell's outputs."""
        return []

    def zeros(self, num_rows: int) -> CellState:
        """Return the zero state at the start of an episode, here [num_rows, num_outputs] of each key."""
        return tuple(zeros_like_weights(self, num_rows, self.num_outputs) for _ in self.state_keys)

    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        """Return the outputs, [rows, num_outputs], and the next state from inputs, [rows, num_inputs], and a state."""
        raise NotImplementedError

    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        """Return the outputs at all steps, [rows, steps, num_outputs]; the state is zero where an episode starts.

        Args:
            inputs: [num_groups, num_inputs], one for all frames that have the same.
            groups: the group of each frame, int64 [rows, steps].
            starts: where an episode starts, bool [rows, steps].
            state: before the first step, already zero where an episode starts there.
        """
        outputs = []
        for group, start in zip(groups.unbind(1), starts.unbind(1), strict=True):
            output, state = self.step(inputs.index_select(0, group), reset(state, start))
            outputs.append(output)
        return torch.stack(outputs, dim=1)

    def over_tree(self, tree: Tree, inputs: Tensor, groups: Tensor, state: CellState) -> Tensor:
        """Return the outputs at the ends of different histories, [num_histories, num_outputs].

        Args:
            inputs: [num_groups, num_inputs].
            groups: the group of each history's last inputs, int64 [num_histories].
            state: what the histories of length 1 continue, from `Tree.initial`.
        """
        outputs = []
        first = 0
        num_before = tree.sizes[0]
        for shorter, group in zip(tree.shorter.split(tree.sizes), groups.split(tree.sizes), strict=True):
            before = tuple(value.index_select(0, shorter - first) for value in state)
            first += num_before
            num_before = len(group)
            output, state = self.step(inputs.index_select(0, group), before)
            outputs.append(output)
        return torch.cat(outputs)


MakeCell = Callable[..., Cell]
"""Return a cell for ``num_features``, ``num_outputs`` and ``num_actions``."""


def of_frames(values: Tensor, groups: Tensor) -> Tensor:
    """Return the values of groups, [num_groups, n], at each frame, [rows, steps, n]."""
    return values.index_select(0, groups.flatten()).unflatten(0, groups.shape)


def number_episodes(starts: Tensor) -> Tensor:
    """Number the episodes of rows from 0, int64 [rows, steps], by starts after the first step."""
    return torch.cat([starts[:, :1] & False, starts[:, 1:]], dim=1).cumsum(dim=1)


def reset(state: Sequence[Tensor], starts: Tensor) -> CellState:
    """Return a state that is zero in the rows where an episode starts, bool [rows]."""
    return tuple(torch.where(beside(starts, value), 0.0, value) for value in state)


def zeros_like_weights(cell: nn.Module, *shape: int) -> Tensor:
    """Return zeros with dtype and device of a cell's weights."""
    return next(cell.parameters()).new_zeros(shape)


def linear_layer(num_inputs: int, num_outputs: int) -> nn.Linear:
    """Return a float32 linear layer on the CPU, whatever torch's defaults are."""
    return nn.Linear(num_inputs, num_outputs, dtype=torch.float32, device="cpu")
