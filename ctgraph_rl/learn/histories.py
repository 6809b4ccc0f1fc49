"""Histories: what an agent can have seen up to a frame, each found once in a batch.

Without noise on reading, the histories of an episode are few: 26 in 8,192 frames of CT-SU-B1. Equal numbers are equal
histories. A history continues one that is a step shorter, so they form a tree. One that an earlier batch began starts
from its row's stored state.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.core.kernel import is_traced

NUM_TRIED = 64
"""Spaced rows that are compared first, to see whether enough are equal."""


def can_branch(value: Tensor) -> bool:
    """Return whether code may branch on values: not on a GPU, which would wait, nor in a stack of seeds, which has
    many.
    """
    return value.is_cpu and not is_traced()


def distinct(values: Sequence[Tensor], most: float = 1.0) -> tuple[Tensor, Tensor]:
    """Group rows that are equal bit by bit.

    Args:
        values: tensors, [num_rows, ...] each.
        most: most groups for which it pays, as a share of the rows, at most 1.

    Returns:
        One row of each group, int64 [num_groups], and the group of each row, int64 [num_rows]. Each row is a group
        where more differ, as with noise on reading, and where code must not branch on values.
    """
    rows = torch.arange(len(values[0]), device=values[0].device)
    if not can_branch(values[0]) or not len(rows):
        return rows, rows
    distance = max(1, len(rows) // NUM_TRIED)
    tries = len(rows) > 2 * NUM_TRIED
    last = _flat(values[-1])[::distance, :1]
    if tries and len(last.unique()) >= most * len(last):
        return rows, rows
    words = _words(values)
    sums = _sums(words)
    if tries and len(sums[::distance].unique()) >= most * len(last):
        return rows, rows
    different, groups = sums.unique(return_inverse=True)
    if len(different) >= most * len(rows):
        return rows, rows
    examples = torch.empty_like(different).scatter_(0, groups, rows)
    equal = torch.equal(words, words.index_select(0, examples.index_select(0, groups)))
    return (examples, groups) if equal else (rows, rows)  # two groups may have one sum


def renumber(numbers: Tensor) -> tuple[Tensor, Tensor]:
    """Return what `distinct` does of rows with numbered groups, from 0, int64 [num_rows]."""
    present = numbers.bincount() > 0
    groups = present.cumsum(0).index_select(0, numbers) - 1
    rows = torch.arange(len(numbers), device="cpu")
    return rows.new_empty(int(present.count_nonzero())).scatter_(0, groups, rows), groups


def number_histories(inputs: Tensor, starts: Tensor, state: Sequence[Tensor]) -> Tensor:
    """Number the histories at the frames of a batch, int64 [rows, steps]; the shortest come first.

    Args:
        inputs: numbers of each frame's inputs, from 0, equal where they are, int64 [rows, steps].
        starts: where an episode starts, bool [rows, steps].
        state: of each row before its first step, [rows, ...] each; unused where an episode starts there.
    """
    flat = inputs.flatten()
    num_inputs = int(flat.max()) + 1
    last = torch.zeros_like(flat)
    if state:
        _, groups = distinct(state)
        last.view_as(inputs)[:, 0] = torch.where(starts[:, 0], 0, groups + 1)
    lengths = _lengths(starts)
    numbers = torch.empty_like(flat)
    count = 0
    for ends in lengths.argsort(stable=True).split(lengths.bincount().tolist()):
        before = last.index_select(0, ends) if count == 0 else numbers.index_select(0, ends - 1)
        different, groups = (before * num_inputs + flat.index_select(0, ends)).unique(return_inverse=True)
        numbers[ends] = groups + count
        count += len(different)
    return numbers.view_as(inputs)


class Tree(NamedTuple):
    """The different histories of some frames, the shortest first."""

    frames: Tensor
    """A frame at which each ends, int64 [num_histories]."""

    shorter: Tensor
    """What each continues: its place among the states of `initial`, followed by the histories; int64."""

    sizes: list[int]
    """Histories of each length."""

    of_frames: Tensor
    """The history of each frame, int64 [rows * steps]."""

    def initial(self, starts: Tensor, state: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the states that histories of length 1 continue; arguments as `number_histories`."""
        frames = self.frames[: self.sizes[0]]
        goes_on = ~starts.flatten().index_select(0, frames)
        rows = frames // starts.shape[1]
        parts = (value.index_select(0, rows) for value in state)
        return tuple(part * goes_on.view(-1, *[1] * (part.ndim - 1)) for part in parts)


def tree(numbers: Tensor, starts: Tensor) -> Tree:
    """Return the histories of a batch from the result of `number_histories`, int64 [rows, steps]."""
    frames, of_frames = renumber(numbers.flatten())
    sizes = _lengths(starts).index_select(0, frames).bincount().tolist()
    first = torch.arange(sizes[0], device="cpu")
    shorter = torch.cat([first, of_frames.index_select(0, frames[sizes[0] :] - 1) + sizes[0]])
    return Tree(frames, shorter, sizes, of_frames)


def _lengths(starts: Tensor) -> Tensor:
    time = torch.arange(starts.shape[1], device="cpu")
    return (time - torch.where(starts, time, 0).cummax(dim=1).values).flatten()


def _words(values: Sequence[Tensor]) -> Tensor:
    """Return all bits of rows of any dtypes, int64 [num_rows, n]."""
    parts = []
    for value in values:
        octets = _flat(value).contiguous().view(torch.uint8)
        missing = -octets.shape[1] % 8
        if missing:
            octets = torch.nn.functional.pad(octets, (0, missing))
        elif octets.storage_offset() % 8 or octets.stride(0) % 8:
            octets = octets.clone(memory_format=torch.contiguous_format)
        parts.append(octets.view(torch.int64))
    return torch.cat(parts, dim=1)


def _flat(value: Tensor) -> Tensor:
    return value.flatten(1) if value.ndim > 1 else value.unsqueeze(1)


def _sums(words: Tensor) -> Tensor:
    """Return a hash of each row, int64 [num_rows]."""
    return (words >> 32).bitwise_xor_(words).mv(_weights(words.shape[1]))


@cache
def _weights(count: int) -> Tensor:
    generator = torch.Generator(device="cpu").manual_seed(0)
    return torch.randint(-(2**62), 2**62, [count], generator=generator, dtype=torch.int64, device="cpu") | 1
