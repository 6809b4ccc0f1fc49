"""Distances between the images of a set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.tasks.images.image_set import WHITE


class Distances(NamedTuple):
    """Mean absolute pixel differences as a share of 254; nan without a pair."""

    within: float  # mean over all pairs of different images of one group
    between: float  # mean over all pairs of images of different groups
    matrix: Tensor  # float64 [G, G]: the mean over pairs for every two groups, and within each on the diagonal


def distances(images: Tensor, groups: Sequence[int]) -> Distances:
    """Return the distances of images within and between groups.

    Per pixel, the sum of |x - y| over the pairs of two groups is the sum over levels of A (m - B) + B (n - A), where A
    and B count each group's images up to the level and n and m count all.

    Args:
        images: uint8 [n, r, r].
        groups: the group of each image, from 0 without a gap.
    """
    numbers = sorted(set(groups))
    group_of = torch.tensor(groups, device=images.device, dtype=torch.int64)
    count = images[0].numel()
    counts = []
    for group in numbers:
        pixels = images[group_of == group].flatten(1).to(torch.int64)
        place = pixels + 256 * torch.arange(count, device=images.device)
        counts.append(torch.bincount(place.flatten(), minlength=256 * count).view(count, 256).cumsum(1).flatten())
    up_to = torch.stack(counts).to(torch.float64)
    sizes = torch.bincount(group_of).to(torch.float64)
    mixed = up_to.sum(1).unsqueeze(1) * sizes
    sums = (mixed + mixed.T - 2 * up_to @ up_to.T) / (count * WHITE)
    pairs = sizes.unsqueeze(1) * sizes - sizes.diag()  # of different images, in both orders
    same = torch.eye(len(numbers), dtype=torch.bool, device=images.device)

    def mean(where: Tensor) -> float:
        return (sums[where].sum() / pairs[where].sum()).item()

    return Distances(mean(same), mean(~same), sums / pairs)
