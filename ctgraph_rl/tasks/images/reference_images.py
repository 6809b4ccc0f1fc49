"""The image sets of the authors' implementation, pixel by pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from ctgraph_rl.checks import is_int, is_real, make_fields_plain, require, require_memory
from ctgraph_rl.tasks.images.generated import BLUEPRINT_SIZE
from ctgraph_rl.tasks.images.image_set import WHITE, SquareImages
from ctgraph_rl.tasks.images.one_hot import OneHot

MAX_SEED = 2**32 - 1
"""As ``numpy.random.RandomState`` has it."""

_ANGLES = 359

_PIXELS_PER_CELL = 3

_ROTATED_AT_ONCE = 256

_BYTES_OF_A_PIXEL = 12


@dataclass(frozen=True)
class ReferenceImages(SquareImages):
    """The image sets of the authors' implementation: 12 x 12 random blueprints at any angle, repeats kept.

    An image is 4 x 4 cells of {0, 1, 2}, each 3 x 3 pixels of that many halves of the brightest level, 254 - noise. It
    is rotated by 0..358 degrees (bilinear, black outside) and truncated to whole levels, equal to recorded sets. Longer
    sets begin with the shorter ones.

    Args:
        seed: the image seed, in [0, 2**32).
        noise: ``noise_on_read`` of the configuration file, in [0, 254]. It lowers the brightest level; its integer part
            is also ``read_noise`` of `Observations`.
    """

    num_images: int
    seed: int = 1
    noise: float = 0.0

    size = BLUEPRINT_SIZE * _PIXELS_PER_CELL

    def __post_init__(self) -> None:
        make_fields_plain(self)
        require(
            (is_int(self.num_images, 1), f"num_images must be an integer >= 1, got {self.num_images!r}"),
            (is_int(self.seed, 0, MAX_SEED), f"image seed must be in [0, 2**32), got {self.seed!r}"),
            (is_real(self.noise, 0, WHITE), f"noise must be a number in [0, {WHITE}], got {self.noise!r}"),
        )
        object.__setattr__(self, "noise", float(self.noise))

    @property
    def white(self) -> float:
        """The brightness of the goal's reward cue; its integer part is the brightest level."""
        return WHITE - self.noise

    @property
    def images(self) -> Tensor:
        """uint8 [num_images, 12, 12], before noise and rotation on read."""
        return _reference_images(self)

    @override
    def bank(self, read_rotation: int) -> Tensor:
        views = np.empty((self.num_images, read_rotation + 1, 1, self.size, self.size), dtype=np.uint8)
        images = self.images.numpy()
        for first in range(0, self.num_images, _ROTATED_AT_ONCE):
            part = images[first : first + _ROTATED_AT_ONCE].astype(np.float64)
            for angle in range(read_rotation + 1):
                views[first : first + len(part), angle, 0] = _rotate(part, angle)  # cut off to whole levels
        return torch.from_numpy(views).flatten(0, 1)


@dataclass(frozen=True)
class ReferenceOneHot(OneHot):
    """The 1D observations of the authors' implementation: 254 at the id's place, and a last element for the reward cue.

    Args:
        num_images: K, the number of ids; vectors have K + 1 elements.
    """

    white = WHITE
    cue_element = True

    @property
    def shape(self) -> tuple[int, ...]:
        """(K + 1,)."""
        return (self.num_images + 1,)

    def bank(self, read_rotation: int) -> Tensor:
        """uint8 [K, K + 1]: 254 times the identity, and a column of zeros."""
        return WHITE * torch.eye(self.num_images, self.num_images + 1, dtype=torch.uint8, device="cpu")


@lru_cache(maxsize=64)
def _reference_images(image_set: ReferenceImages) -> Tensor:
    needed = image_set.num_images * image_set.size**2 * _BYTES_OF_A_PIXEL
    require_memory(f"{image_set.num_images:,} images while they are made", needed, "images")
    blueprints, angles = _blueprints(image_set.seed, image_set.num_images)
    cells = blueprints * ((WHITE - image_set.noise) / 2)
    upright = cells.repeat(_PIXELS_PER_CELL, axis=1).repeat(_PIXELS_PER_CELL, axis=2)
    images = np.empty(upright.shape, dtype=np.uint8)
    for angle in np.unique(angles):
        chosen = angles == angle
        images[chosen] = _rotate(upright[chosen], int(angle)).astype(np.uint8)
    return torch.from_numpy(images)


def _blueprints(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Cells in {0, 1, 2}, int64 [count, 4, 4], and whole degrees, int64 [count], from NumPy's frozen generator."""
    generator = np.random.RandomState(seed)
    cells = np.empty((count, BLUEPRINT_SIZE, BLUEPRINT_SIZE), dtype=np.int64)
    angles = np.empty(count, dtype=np.int64)
    for i in range(count):
        cells[i] = generator.randint(0, 3, BLUEPRINT_SIZE**2, dtype=np.int64).reshape(cells[i].shape)
        angles[i] = generator.randint(0, _ANGLES, dtype=np.int64)
    return cells, angles


def _rotate(images: np.ndarray, degrees: int) -> np.ndarray:
    """Rotate as scikit-image does, counter-clockwise about the centre, bilinear, black outside; float64 [n, r, r].

    The order of operations is that of recorded sets: truncation shows the last bit of a sum.
    """
    y, x = _sources(images.shape[-1], degrees)
    border = images.shape[-1] // 2  # no pixel comes from farther outside
    padded = np.pad(images, ((0, 0), (border, border), (border, border)))
    above = np.floor(y).astype(np.int64)
    left = np.floor(x).astype(np.int64)
    down = y - above
    right = x - left
    rows = above + border
    columns = left + border
    upper, lower = (
        (1 - right) * padded[:, row, columns] + right * padded[:, row, columns + 1] for row in (rows, rows + 1)
    )
    rotated = (1 - down) * upper + down * lower
    # scikit-image stays within an image's levels, and black only counts as one where a pixel is fully outside
    lowest = np.where(rotated.min((1, 2)) > 0, images.min((1, 2)), 0)
    return np.clip(rotated, lowest[:, None, None], images.max((1, 2))[:, None, None])


@lru_cache(maxsize=_ANGLES)
def _sources(size: int, degrees: int) -> tuple[np.ndarray, np.ndarray]:
    angle = math.radians(degrees)
    centre = (size - 1) / 2
    cos = math.cos(angle)
    sin = math.sin(angle)
    y, x = np.mgrid[:size, :size].astype(np.float64)
    first_x = _fused(sin, centre, -cos * centre) + centre
    first_y = _fused(-cos, centre, -sin * centre) + centre
    return sin * x + cos * y + first_y, cos * x - sin * y + first_x


def _fused(a: float, b: float, c: float) -> float:
    return float(Fraction(a) * Fraction(b) + Fraction(c))
