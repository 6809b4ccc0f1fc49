"""LSTM: long short-term memory, the default cell.

Hochreiter and Schmidhuber 1997, with PyTorch's `torch.nn.LSTM` of one layer.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.cells.cell import Branches, Cell, CellOutput, CellState, can_branch, of_frames, zeros_like_weights
from baselines.cells.packed import segments


class LSTM(Cell):
    """An LSTM of one layer; see `Cell` for the arguments."""

    state_keys = ("recurrent_state_h", "recurrent_state_c")
    holds = "what its gates let in, and the number of times that something was seen"

    def __init__(self, num_features: int, num_outputs: int, num_actions: int, **reads: bool) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        self.lstm = nn.LSTM(self.num_inputs, num_outputs, batch_first=True, dtype=torch.float32, device="cpu")

    def zeros(self, num_rows: int) -> CellState:
        """Return zeros, [num_rows, 1, num_outputs], for both parts of the state."""
        return tuple(zeros_like_weights(self, num_rows, 1, self.num_outputs) for _ in self.state_keys)

    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        """See `Cell`."""
        if not can_branch(inputs):
            h, c = lstm_step(self.lstm, lstm_inputs(self.lstm, inputs), state[0].squeeze(1), state[1].squeeze(1))
            return h, (h.unsqueeze(1), c.unsqueeze(1))
        output, (h, c) = self.lstm(inputs.unsqueeze(1), _layer_first(state))
        return output.squeeze(1), (h.transpose(0, 1), c.transpose(0, 1))

    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        """See `Cell`; each segment between two resets is a sequence, and the LSTM runs over all of them at once."""
        if not starts[:, 1:].any():
            return self.lstm(of_frames(inputs, groups), _layer_first(state))[0]
        found = segments(starts)
        h, c = (found.initial(value.squeeze(1)).unsqueeze(0) for value in state)
        memory = packed_lstm(self.lstm, inputs, groups.flatten()[found.frames], found.sizes, (h, c))
        return found.unpacked(memory).unflatten(0, starts.shape)

    def tree(self, inputs: Tensor, branches: Branches, state: CellState) -> Tensor:
        """See `Cell`; with one product of features and weights for each group."""
        given = lstm_inputs(self.lstm, inputs)
        h = state[0].squeeze(1)
        c = state[1].squeeze(1)
        memory = []
        for shorter, groups in branches:
            step = given.index_select(0, groups)
            h, c = lstm_step(self.lstm, step, h.index_select(0, shorter), c.index_select(0, shorter))
            memory.append(h)
        return torch.cat(memory)


def _layer_first(state: CellState) -> CellState:
    """Return a state as PyTorch's LSTM takes it, [1, rows, num_outputs] each."""
    return tuple(value.transpose(0, 1).contiguous() for value in state)


def packed_lstm(lstm: nn.LSTM, features: Tensor, groups: Tensor, sizes: Tensor, state: CellState) -> Tensor:
    """Run an LSTM of one layer over packed sequences, with one product of features and weights for each group.

    PyTorch's own backward pass writes a tensor of all frames at each step.

    Args:
        lstm: the LSTM.
        features: of each group, [num_groups, num_features].
        groups: of each frame in packed order, int64 [num_frames].
        sizes: number of sequences at each step, int64 [num_steps] on the CPU.
        state: the initial hidden and cell states of the sequences, [1, num_sequences, hidden_size] each.

    Returns:
        The hidden states at all frames in packed order, [num_frames, hidden_size].
    """
    given = lstm_inputs(lstm, features)
    h = state[0][0]
    c = state[1][0]
    memory = []
    for step in given.index_select(0, groups).split(sizes.tolist()):
        h, c = lstm_step(lstm, step, h[: len(step)], c[: len(step)])
        memory.append(h)
    return torch.cat(memory)


def lstm_inputs(lstm: nn.LSTM, features: Tensor) -> Tensor:
    """Compute what features add to the gates of an LSTM of one layer, [..., 4 * hidden_size]."""
    of_features, _, bias, other_bias = lstm.all_weights[0]
    return nn.functional.linear(features, of_features, bias + other_bias)


def lstm_step(lstm: nn.LSTM, given: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the next hidden and cell states, [rows, hidden_size], from `lstm_inputs` and the present ones."""
    i, f, g, o = torch.addmm(given, h, lstm.all_weights[0][1].t()).chunk(4, dim=1)
    c = torch.addcmul(f.sigmoid() * c, i.sigmoid(), g.tanh())
    return o.sigmoid() * c.tanh(), c
