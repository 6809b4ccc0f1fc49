"""Sequences between resets, packed as PyTorch's recurrent layers read them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from baselines.cells.cell import CellState


class Segments(NamedTuple):
    """The sequences between two resets in [rows, steps], longest first."""

    frames: Tensor
    """The frames in packed order, all first steps, then all second ones; int64 [rows * steps], row by row."""

    sizes: Tensor
    rows: Tensor
    at_first: Tensor
    """Whether a sequence begins at the first step of its row, bool [num_sequences]."""

    def run(self, step: Callable[..., CellState], given: Tensor, groups: Tensor, state: Sequence[Tensor]) -> Tensor:
        """Run a recurrent layer over all sequences at once, with one product of features and weights for each group.

        Args:
            step: computes the next state from the products at a step and the parts of the present state.
            given: the product of each group, [num_groups, n].
            groups: the group of each frame, int64 [rows, steps].
            state: before each row's first step, [rows, n] for each part; a reset makes it 0.

        Returns:
            The first part of the state after each frame, [rows, steps, n].
        """
        at_first = self.at_first.unsqueeze(-1)
        state = [torch.where(at_first, value.index_select(0, self.rows), 0.0) for value in state]
        in_order = given.index_select(0, groups.flatten()[self.frames])
        memory = []
        for inputs in in_order.split(self.sizes.tolist()):
            before = [value[: len(inputs)] for value in state]
            state = step(inputs, *before)
            memory.append(state[0])
        places = torch.arange(len(self.frames), device=self.frames.device)
        place_of_frame = torch.empty_like(self.frames).scatter_(0, self.frames, places)
        return torch.cat(memory).index_select(0, place_of_frame).unflatten(0, groups.shape)


def segments(starts: Tensor) -> Segments:
    """Return the sequences that begin where an episode starts, bool [rows, steps], or at the first step."""
    steps = starts.shape[1]
    begins = starts.clone()
    begins[:, 0] = True
    first = begins.flatten().nonzero().squeeze(-1)
    end = first.new_tensor([starts.numel()])
    lengths, order = first.diff(append=end).sort(descending=True)
    first = first[order]
    time = torch.arange(int(lengths[0]), device=first.device).unsqueeze(-1)
    within = time < lengths
    return Segments(
        frames=(first + time)[within],
        sizes=within.sum(dim=1).cpu(),
        rows=first // steps,
        at_first=first % steps == 0,
    )
