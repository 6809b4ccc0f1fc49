"""Rotation of images about their centre, bilinear, in integer arithmetic: equal on every machine."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

_ROTATED_AT_ONCE = 256


def rotate(images: Tensor, degrees: int) -> Tensor:
    """Rotate images counter-clockwise about their centre, bilinear, black outside.

    Args:
        images: uint8 [n, r, r].

    Returns:
        uint8 [n, r, r], rounded; weights have 16 bits.
    """
    if degrees % 360 == 0:
        return images
    index, weight = compute_taps(images.shape[-1], degrees)
    pixels = images.flatten(1).to(torch.int64)
    sums = (pixels[:, index] * weight).sum(-1)
    rounded = (sums + (1 << 15)) >> 16
    return rounded.to(torch.uint8).view_as(images)


@lru_cache(maxsize=512)
def compute_taps(size: int, degrees: int) -> tuple[Tensor, Tensor]:
    """Each pixel's four source pixels and their weights * 2**16; int64 [r * r, 4] each."""
    angle = math.radians(degrees)
    centre = (size - 1) / 2
    grid = torch.arange(size, dtype=torch.float64, device="cpu") - centre
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    source_x = math.cos(angle) * x - math.sin(angle) * y + centre
    source_y = math.sin(angle) * x + math.cos(angle) * y + centre
    taps = []
    weights = []
    for step_y in (0, 1):
        for step_x in (0, 1):
            tap_y = source_y.floor() + step_y
            tap_x = source_x.floor() + step_x
            inside = (tap_y >= 0) & (tap_y < size) & (tap_x >= 0) & (tap_x < size)
            tap = tap_y * size + tap_x
            weight = (1 - (source_y - tap_y).abs()) * (1 - (source_x - tap_x).abs())
            weight = (weight * 2**16).round()
            taps.append(tap.where(inside, 0.0).long().flatten())
            weights.append(weight.where(inside, 0.0).long().flatten())
    return torch.stack(taps, -1), torch.stack(weights, -1)


def rotations(images: Tensor, read_rotation: int) -> Tensor:
    """uint8 [n * (read_rotation + 1), 1, r, r]: each image's rotations by 0, 1, ... degrees in a row."""
    views = images.new_empty(len(images), read_rotation + 1, 1, *images.shape[1:])
    for part, out in zip(images.split(_ROTATED_AT_ONCE), views.split(_ROTATED_AT_ONCE), strict=True):
        for angle in range(read_rotation + 1):
            out[:, angle, 0] = rotate(part, angle)
    return views.flatten(0, 1)
