"""Noise, late rotation and the reward cue on read, as pure tensor functions.

Shapes: N rows; every tensor is [N] unless said otherwise.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ctgraph_rl.core import kernel
from ctgraph_rl.core.philox import STREAM_NOISE, draw, splitmix64, splitmix64_at


def add_noise(images: Tensor, start: Tensor, read_noise: Tensor) -> Tensor:
    """Add to each pixel an independent integer drawn from 0..read_noise, saturating at 255.

    A pixel has 16 bits of its observation's SplitMix64 sequence: probabilities are off by less than 2**-16.

    Args:
        images: uint8 [N, 1, r, r].
        start: int64, random, per observation.
        read_noise: largest addition per row, 0..255.

    Returns:
        uint8 [N, 1, r, r].
    """
    if not torch.compiler.is_compiling():
        return _add_noise(images, start, read_noise)
    if images.is_cuda:
        return by_pixel(images, start, read_noise)
    return _opaque(images, start, read_noise)


_NOISE_ROWS = 4096  # as many rows at once keep the work in the cache


def _add_noise(images: Tensor, start: Tensor, read_noise: Tensor) -> Tensor:
    fits = images.dtype == torch.uint8 and start.shape == read_noise.shape == images.shape[:1]
    if fits and kernel.takes(images, start, read_noise):
        return kernel.add_noise(images, start, read_noise)
    if images.is_cpu:
        return by_parts(images, start, read_noise)
    return noisy(images, start, read_noise)


def by_parts(images: Tensor, start: Tensor, read_noise: Tensor) -> Tensor:
    """`add_noise` on CPUs without C code."""
    if len(images) <= _NOISE_ROWS:
        return noisy(images, start, read_noise)
    parts = map(noisy, images.split(_NOISE_ROWS), start.split(_NOISE_ROWS), read_noise.split(_NOISE_ROWS))
    return torch.cat(list(parts))


def noisy(images: Tensor, start: Tensor, read_noise: Tensor) -> Tensor:
    """`add_noise` in one piece."""
    pixels = images[0].numel()
    high = (read_noise + 1).to(torch.int32).unsqueeze(-1)
    words = splitmix64(start, (pixels + 3) // 4).view(torch.uint16)  # four of each number
    noise = words[:, :pixels].to(torch.int32)
    noise.mul_(high).bitwise_right_shift_(16)
    noise = noise.to(torch.uint8)
    return add_saturating(images, noise.view_as(images))


def by_pixel(images: Tensor, start: Tensor, read_noise: Tensor) -> Tensor:
    """`add_noise` where each pixel draws separately: more arithmetic, one kernel if compiled."""
    start = start.unsqueeze(-1)
    high = (read_noise + 1).long().unsqueeze(-1)
    pixel = torch.arange(images[0].numel(), device=images.device) + (start & 0)  # [N, pixels]: a faster kernel
    numbers = splitmix64_at(start, pixel // 4)
    words = (numbers >> pixel % 4 * 16) & 0xFFFF
    noise = (words * high >> 16).to(torch.uint8)
    return add_saturating(images, noise.view_as(images))


# Inductor of torch 2.13 writes beyond its buffers on a CPU when it fuses `noisy` with what comes before it, and in C++
# numbers of `by_pixel` may not leave the range of int64. As its own operator the noise stays whole there.
_opaque = torch.library.custom_op("ctgraph_rl::add_noise", _add_noise, mutates_args=())
_opaque.register_fake(lambda images, start, read_noise: torch.empty_like(images))


def noise_bank(levels: tuple[int, ...], size: int, shape: tuple[int, ...]) -> Tensor:
    """Noise drawn in advance, by largest addition: uint8 [levels * size, *shape]."""
    numbers = torch.arange(len(levels) * size, device="cpu")
    zero = numbers.new_tensor(0)
    upper, lower, *_ = draw(zero, numbers, zero, STREAM_NOISE)
    start = (upper << 32) | lower
    black = torch.zeros(len(numbers), *shape, dtype=torch.uint8, device="cpu")
    read_noise = numbers.new_tensor(levels).repeat_interleave(size)
    return add_noise(black, start, read_noise)


def add_saturating(images: Tensor, noise: Tensor) -> Tensor:
    """The sum of two uint8 tensors, at most 255."""
    return images + torch.minimum(noise, 255 - images)


def cue_level(share: Tensor, white: Tensor, wraps: Tensor) -> Tensor:
    """The brightness of a reward: white for the goal's, 0 for none, truncated; uint8.

    Args:
        share: float64, the reward as a share of the goal's.
        white: float64.
        wraps: bool, rows where levels are taken modulo 256 instead of saturating.
    """
    level = (share * white).trunc()
    saturated = torch.minimum(level.clamp_min(0), white.trunc())
    return torch.where(wraps, level.remainder(256), saturated).to(torch.uint8)


def add_cue(images: Tensor, level: Tensor, shows: Tensor, element: Tensor) -> Tensor:
    """Show a brightness as a square in the middle half of images, or as an element of vectors.

    Args:
        images: uint8 [N, 1, r, r] or [N, K].
        level: uint8.
        shows: bool, the rows that show it.
        element: int64, which element of a vector shows it.

    Returns:
        uint8 of the shape of ``images``.
    """
    size = images.shape[-1]
    ones = (1,) * (images.ndim - 1)
    place = torch.arange(size, device=images.device)
    if images.ndim == 2:
        inside = place == element.unsqueeze(-1)
    else:
        middle = (place >= size // 4) & (place < size - size // 4)
        inside = middle & middle.unsqueeze(-1)
    return torch.where(shows.view(-1, *ones) & inside, level.view(-1, *ones), images)


def turn(images: Tensor, angle: Tensor, taps: tuple[Tensor, Tensor]) -> Tensor:
    """Rotate each image by its angle, as `rotation.rotate`.

    Args:
        images: uint8 [N, 1, r, r].
        angle: int64, whole degrees in [0, A).
        taps: `rotation.compute_taps` A angles, int64 [A, r * r, 4] each.

    Returns:
        uint8 [N, 1, r, r].
    """
    index = taps[0][angle]
    weight = taps[1][angle]
    pixels = images.flatten(1).to(torch.int64)
    sources = pixels.gather(1, index.flatten(1)).view(index.shape)
    sums = (sources * weight).sum(-1)
    rounded = (sums + (1 << 15)) >> 16
    return rounded.to(torch.uint8).view(images.shape)
