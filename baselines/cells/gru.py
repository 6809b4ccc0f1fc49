"""GRU: a gated recurrent unit, a smaller rival of the LSTM.

Cho et al. 2014 (arXiv 1406.1078), with PyTorch's `torch.nn.GRU` of one layer.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.cells.cell import Cell, CellOutput, CellState
from baselines.cells.packed import segments
from ctgraph_rl.core.kernel import is_traced


class GRU(Cell):
    """A GRU of one layer; see `Cell` for the arguments."""

    state_keys = ("recurrent_state_h",)
    holds = "what its gates let in"

    def __init__(self, num_features: int, num_outputs: int, num_actions: int, **reads: bool) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        self.gru = nn.GRU(self.num_inputs, num_outputs, batch_first=True, dtype=torch.float32, device="cpu")

    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        """See `Cell`."""
        if is_traced():  # PyTorch's own cannot be vectorised over seeds
            num_rows = len(inputs)
            each = torch.arange(num_rows, device=inputs.device)
            output = packed_gru(
                self.gru, inputs, each, torch.tensor([num_rows], dtype=torch.int64, device="cpu"), state[0]
            )
        else:
            output = self.gru(inputs.unsqueeze(1), state[0].unsqueeze(0))[0].squeeze(1)
        return output, (output,)

    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        """See `Cell`; each segment between two resets is a sequence, and the GRU runs over all of them at once."""
        found = segments(starts)
        frames = groups.flatten()[found.frames]
        memory = packed_gru(self.gru, inputs, frames, found.sizes, found.initial(state[0]))
        return found.unpacked(memory).unflatten(0, starts.shape)


def packed_gru(gru: nn.GRU, features: Tensor, groups: Tensor, sizes: Tensor, h: Tensor) -> Tensor:
    """Run a GRU of one layer over packed sequences, with one product of features and weights for each group.

    PyTorch's own backward pass writes a tensor of all frames at each step.

    Args:
        gru: the GRU.
        features: of each group, [num_groups, num_features].
        groups: of each frame in packed order, int64 [num_frames].
        sizes: number of sequences at each step, int64 [num_steps] on the CPU.
        h: the initial states of the sequences, [num_sequences, hidden_size].

    Returns:
        The states at all frames in packed order, [num_frames, hidden_size].
    """
    of_features, of_h, bias, of_h_bias = gru.all_weights[0]
    given = nn.functional.linear(features, of_features, bias)
    memory = []
    for step in given.index_select(0, groups).split(sizes.tolist()):
        h = h[: len(step)]
        carried = torch.addmm(of_h_bias, h, of_h.t())
        width = h.shape[1]
        r, z = (step[:, : 2 * width] + carried[:, : 2 * width]).sigmoid().chunk(2, dim=1)
        n = torch.addcmul(step[:, 2 * width :], r, carried[:, 2 * width :]).tanh()
        h = torch.lerp(n, h, z)
        memory.append(h)
    return torch.cat(memory)
