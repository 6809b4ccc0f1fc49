"""Frames with the same inputs and sequences with the same history, so that each is computed once.

In a task without pixel noise, the thousands of frames of a minibatch show a few images, and the sequences of an agent
with memory have a few histories: 21 in 2,048 frames of CT-SU-B1.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from baselines.cells.cell import Branches, CellState, can_branch
from baselines.cells.packed import segments


def distinct(inputs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Group frames with the same inputs.

    Args:
        inputs: tensors, [num_frames, ...] each.

    Returns:
        One frame of each group, int64 [num_groups], and the group of each frame, int64 [num_frames].
    """
    flat = [value.flatten(1) for value in inputs]
    frames = torch.arange(len(flat[0]), device=flat[0].device)
    if not can_branch(flat[0]):
        return frames, frames
    widths = [value.shape[1] for value in flat]
    weights = random_weights(sum(widths)).split(widths)
    parts = [value.float() @ weight for value, weight in zip(flat, weights, strict=True)]
    sums = torch.stack(parts).sum(dim=0)
    different, groups = sums.unique(return_inverse=True)
    examples = frames.new_empty(len(different)).scatter_(0, groups, frames)
    if len(examples) == len(frames):
        return examples, groups
    same = examples[groups]
    differ = any((value != value.index_select(0, same)).count_nonzero() for value in flat)  # despite equal sums
    return (frames, frames) if differ else (examples, groups)


def renumbered(groups: Tensor) -> tuple[Tensor, Tensor]:
    """Return what `distinct` does of some of its frames, from the groups that it gave them, int64 [num_frames]."""
    different, numbers = groups.unique(return_inverse=True)
    frames = torch.arange(len(groups), device="cpu")
    examples = torch.empty_like(different).scatter_(0, numbers, frames)
    return examples, numbers


@cache
def random_weights(count: int) -> Tensor:
    """Return random numbers, float32 [count], always the same."""
    generator = torch.Generator(device="cpu").manual_seed(0)
    return torch.randn(count, generator=generator, dtype=torch.float32, device="cpu")


class Histories(NamedTuple):
    """The different histories of sequences: a tree, in which each continues one that is a step shorter."""

    initial: CellState
    """The different states before a first step, [num_states, ...] each."""

    branches: Branches
    """The histories of each length; see `Cell.tree`."""

    of_frames: Tensor
    """The history of each frame, int64 [rows, steps]; the shortest have the first numbers."""


def histories(groups: Tensor, starts: Tensor, state: CellState) -> Histories:
    """Return the different histories of sequences, each from a reset or the first step on.

    Args:
        groups: the group of each frame's inputs, int64 [rows, steps].
        starts: where the state is reset to zero, bool [rows, steps].
        state: before the first step, already zero where it is reset there, [rows, ...] each.
    """
    found = segments(starts)
    flat = groups.flatten()
    num_groups = int(groups.max()) + 1
    states = [torch.cat([torch.zeros_like(value[:1]), value]) for value in state]
    none = torch.zeros(len(starts) + 1, dtype=torch.int64, device="cpu")
    examples, equal = distinct(states) if states else (none[:1], none)
    last = torch.where(found.at_first, equal[found.rows + 1], equal[0])
    of_frames = torch.empty_like(flat)
    branches = []
    count = 0
    for frames in found.frames.split(found.sizes.tolist()):
        longer = last[: len(frames)] * num_groups + flat[frames]
        different, places = longer.unique(return_inverse=True)
        shorter = different.div(num_groups, rounding_mode="floor")
        branches.append((shorter, different % num_groups))
        of_frames[frames] = places + count
        last = places
        count = count + len(different)
    initial = tuple(value.index_select(0, examples) for value in states)
    return Histories(initial, branches, of_frames.view_as(groups))
