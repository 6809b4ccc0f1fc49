"""Sequences between resets, packed step by step as PyTorch's recurrent layers read them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Segments(NamedTuple):
    """The sequences between two resets in [rows, steps], longest first."""

    frames: Tensor
    """The frames in packed order: all first steps, then all second ones; int64 [rows * steps], row by row."""

    sizes: Tensor
    """Number of sequences at each step, int64 [longest] on the CPU."""

    rows: Tensor
    """The row of each sequence, int64 [num_sequences]."""

    at_first: Tensor
    """Whether a sequence begins at the first step of its row, bool [num_sequences]."""

    def initial(self, state: Tensor) -> Tensor:
        """Return the initial state of each sequence, [num_sequences, n], from that of each row; 0 after a reset."""
        return torch.where(self.at_first.unsqueeze(-1), state.index_select(0, self.rows), 0.0)

    def unpacked(self, values: Tensor) -> Tensor:
        """Return values in packed order, [rows * steps, n], in the order of the frames."""
        places = torch.arange(len(self.frames), device=self.frames.device)
        return values.index_select(0, torch.empty_like(self.frames).scatter_(0, self.frames, places))


def segments(starts: Tensor) -> Segments:
    """Return the sequences that begin where an episode starts, bool [rows, steps], or at the first step."""
    steps = starts.shape[1]
    begins = starts.clone()
    begins[:, 0] = True
    first = begins.flatten().nonzero().squeeze(-1)
    lengths, order = first.diff(append=first.new_tensor([starts.numel()])).sort(descending=True)
    first = first[order]
    time = torch.arange(int(lengths[0]), device=first.device).unsqueeze(-1)
    within = time < lengths
    return Segments((first + time)[within], within.sum(dim=1).cpu(), first // steps, first % steps == 0)
