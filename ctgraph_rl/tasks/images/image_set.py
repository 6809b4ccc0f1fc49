"""The protocol of image sets, and the base of sets of square images."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from ctgraph_rl.core.rotation import rotations

WHITE = 254
"""Brightest level of the generated sets, and the unit of distances."""


class ImageSet(Protocol):
    """The images behind the observation ids: a frozen dataclass, equal and hashable by value.

    Every observation shows one of an id's ``num_variants`` images, drawn uniformly with its rotation. Two attributes
    are optional: ``white``, the brightest level (254 if missing), and ``cue_element``, True for vectors whose last
    element is free to show the reward.
    """

    @property
    def num_images(self) -> int:
        """Number of ids."""
        ...

    @property
    def num_variants(self) -> int:
        """Images of each id."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one observation: (1, r, r) for images, (K,) for one-hot."""
        ...

    def bank(self, read_rotation: int) -> Tensor:
        """All images, uint8 [num_images * num_variants * (read_rotation + 1), *shape].

        Variant v of an id, rotated by a degrees, is row (id * num_variants + v) * (read_rotation + 1) + a.
        """
        ...


def has_cue_element(images: ImageSet) -> bool:
    """Whether observations are vectors whose last element shows the end's reward."""
    return getattr(images, "cue_element", False)


def white_level(images: ImageSet) -> float:
    """The brightest level of a set."""
    return getattr(images, "white", WHITE)


class SquareImages:
    """Base of sets of one square image per id; a subclass has ``size`` and ``images``."""

    size: int
    num_variants = 1

    @property
    def shape(self) -> tuple[int, ...]:
        """(1, r, r)."""
        return (1, self.size, self.size)

    @property
    def images(self) -> Tensor:
        """uint8 [num_images, r, r], before rotation and noise on read."""
        raise NotImplementedError

    def bank(self, read_rotation: int) -> Tensor:
        """Return each image's rotations by 0, 1, ... degrees in a row, uint8 [rows, 1, r, r]."""
        return rotations(self.images, read_rotation)


def resize(images: Tensor, size: int) -> Tensor:
    """Return images [n, r, r] with pixels repeated, or blocks averaged and rounded half up."""
    side = images.shape[-1]
    if size >= side:
        return images.repeat_interleave(size // side, dim=1).repeat_interleave(size // side, dim=2)
    block = side // size
    sums = images.view(-1, size, block, size, block).sum((2, 4), dtype=torch.int64)
    return ((2 * sums + block**2) // (2 * block**2)).to(torch.uint8)


def first_of_each(images: Tensor) -> Tensor:
    """Return the positions of images that repeat no earlier one, in order."""
    _, group = torch.unique(images.flatten(1), dim=0, return_inverse=True)
    positions = torch.arange(len(images), device="cpu")
    none = torch.full_like(group[: int(group.max()) + 1], len(images))
    return none.scatter_reduce(0, group, positions, reduce="amin").sort().values
