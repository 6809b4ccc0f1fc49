"""Image sets generated from a seed: the paper's, and groups of images of a chosen similarity."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from ctgraph_rl.checks import (
    Rule,
    are_ints,
    at_least_one,
    is_int,
    is_real,
    make_fields_plain,
    require,
    require_memory,
)
from ctgraph_rl.core.philox import STREAM_IMAGES, draw, randint
from ctgraph_rl.core.rotation import rotate
from ctgraph_rl.tasks.images.image_set import WHITE, SquareImages, first_of_each, resize

BLUEPRINT_SIZE = 4
BLUEPRINT_LEVELS = (0, 127, WHITE)
BLUEPRINT_ANGLES = (0, 30, 60)

UNRELATED = (WHITE + 2) / (3 * (WHITE + 1))
"""256/765: expected distance of two images with independent cells, uniform over 0..254."""

_ROTATED_AT_ONCE = 4096

_BYTES_OF_A_PIXEL, _BYTES_OF_A_BLUEPRINT, _BYTES_OF_A_CELL = 8, 800, 64

_GROUPED_BLOCK = 1 << 27  # the upper half of the image stream's blocks; `PaperImages` uses block 0


@dataclass(frozen=True)
class PaperImages(SquareImages):
    """The paper's image sets: random blueprints, upscaled and rotated, no image twice.

    A blueprint has 4x4 cells of {0, 1, 2}, shown as 0, 127 and 254, and is rotated by 0, 30 or 60 degrees. Longer sets
    of a seed begin with the shorter ones.

    Args:
        seed: the image seed, in [0, 2**63).
        size: r, side of an image in pixels; a multiple of 4.
    """

    num_images: int
    seed: int = 1
    size: int = 12

    def __post_init__(self) -> None:
        make_fields_plain(self)
        most = len(BLUEPRINT_LEVELS) ** (BLUEPRINT_SIZE**2)
        require(
            (is_int(self.num_images, 1, most), f"num_images must be in 1..{most} (3**16), got {self.num_images!r}"),
            _seed_rule(self.seed),
            _size_rule(self.size, BLUEPRINT_SIZE),
        )

    @property
    def images(self) -> Tensor:
        """uint8 [num_images, r, r], before rotation and noise on read."""
        return _paper_images(self)


@dataclass(frozen=True)
class GroupedImages(SquareImages):
    """Random images with a chosen similarity within groups, such as the decision images, and between groups.

    Ids follow the groups: ``groups=(1, 1, 4, 8)`` makes id 0 the first group, id 1 the second, ids 2..5 the third. The
    distance of two images is their mean absolute pixel difference as a share of 254. An image has c x c cells, each
    uniform over 0..254. A group's blueprint is a common blueprint with a share s_g of its cells redrawn; an image is
    its group's blueprint with a share s_i redrawn. Cells that are not shared differ by D = 256/765 on average, hence

        within = D (1 - (1 - s_i)^2),    between = D (1 - (1 - s_i)^2 (1 - s_g)^2)

    are the expected distances within and between groups; more cells come closer. A share s of n cells is s n, rounded
    up or down at random; so the least ``within`` is D (1 - (1 - 1 / c^2)^2), for one cell. No image occurs twice.
    Longer groups begin with the shorter ones.

    Args:
        groups: number of images of each group.
        within: expected distance of two images of one group.
        between: expected distance of two images of different groups; within <= between <= D.
        seed: the image seed, in [0, 2**63).
        size: r, side of an image in pixels; a multiple of ``cells``.
        cells: c, cells along a side.

    Raises:
        ValueError: for distances out of reach, or more images than the cells keep apart.
    """

    groups: tuple[int, ...]
    within: float
    between: float
    seed: int = 1
    size: int = 12
    cells: int = BLUEPRINT_SIZE

    def __post_init__(self) -> None:
        make_fields_plain(self)
        groups = self.groups
        groups_ok = bool(groups) and are_ints(groups, 1)
        cells = self.cells if is_int(self.cells, 1) else 1
        most = WHITE * cells**2 // 2  # half the images that differ from a blueprint in one cell
        wanted = len(groups) * max(groups) if groups_ok else 0
        lowest = UNRELATED * (1 - (1 - 1 / self.cells**2) ** 2) if is_int(self.cells, 1) else 0.0
        within_ok = is_real(self.within, lowest, UNRELATED)
        reach = f"[{math.ceil(lowest * 1e5) / 1e5:.5f}, {UNRELATED:.5f}]"
        if is_real(self.within, 1e-9, lowest):
            enough = math.ceil((1 - math.sqrt(1 - self.within / UNRELATED)) ** -0.5)
            reach += f" for cells={self.cells} (use cells={enough} or more)"
        between_ok = is_real(self.between, self.within if within_ok else lowest, UNRELATED)
        require(
            (groups_ok, f"groups must be the numbers of images of each group, >= 1, got {groups!r}"),
            *at_least_one(cells=self.cells),
            _seed_rule(self.seed),
            _size_rule(self.size, cells),
            (wanted <= most, f"groups need {wanted} images, more than {most}; use more cells"),
            (within_ok, f"within must be in {reach}, got {self.within!r}"),
            (between_ok, f"between must be in [within, {UNRELATED:.5f}], got {self.between!r}"),
        )
        object.__setattr__(self, "within", float(self.within))
        object.__setattr__(self, "between", float(self.between))

    @property
    def num_images(self) -> int:
        """Images of all groups."""
        return sum(self.groups)

    @property
    def images(self) -> Tensor:
        """uint8 [num_images, r, r], before rotation and noise on read."""
        return _grouped_images(self)


@lru_cache(maxsize=64)
def _paper_images(image_set: PaperImages) -> Tensor:
    candidates = image_set.num_images
    images = None
    while images is None or len(images) < image_set.num_images:
        needed = candidates * (_BYTES_OF_A_PIXEL * image_set.size**2 + _BYTES_OF_A_BLUEPRINT)
        require_memory(f"{image_set.num_images:,} images while they are made", needed, "images")
        blueprints = _blueprints(image_set.seed, candidates)
        levels = torch.tensor(BLUEPRINT_LEVELS, dtype=torch.uint8, device="cpu")[blueprints[:, :-1]]
        rendered = resize(levels.view(-1, BLUEPRINT_SIZE, BLUEPRINT_SIZE), image_set.size)
        for which, angle in enumerate(BLUEPRINT_ANGLES):
            chosen = blueprints[:, -1] == which
            parts = rendered[chosen].split(_ROTATED_AT_ONCE)
            rendered[chosen] = torch.cat([rotate(part, angle) for part in parts])
        images = rendered[first_of_each(rendered)]
        candidates *= 2
    return images[: image_set.num_images].clone()


def _blueprints(seed: int, count: int) -> Tensor:
    """int64 [count, 17]: 16 cells in {0, 1, 2}, and one of three angles."""
    tick = torch.arange(count, device="cpu")
    words = draw(tick.new_tensor(seed), tick.new_tensor(0), tick, STREAM_IMAGES)
    powers = 3 ** torch.arange(BLUEPRINT_SIZE**2 + 1, device="cpu")
    return ((words[0] << 31) | (words[1] >> 1)).unsqueeze(-1) // powers % 3


@lru_cache(maxsize=64)
def _grouped_images(image_set: GroupedImages) -> Tensor:
    groups = image_set.groups
    cells = image_set.cells
    candidates = max(groups)
    chosen = [torch.empty(0, dtype=torch.int64, device="cpu")]
    while any(len(positions) < size for positions, size in zip(chosen, groups, strict=False)):
        needed = candidates * len(groups) * cells**2 * _BYTES_OF_A_CELL
        require_memory(f"{image_set.num_images:,} images while they are made", needed, "images")
        images = _candidates(image_set, candidates).flatten(0, 1)
        first = first_of_each(images)
        chosen = [first[first % len(groups) == group] for group in range(len(groups))]
        candidates *= 2
    positions = torch.cat([positions[:size] for positions, size in zip(chosen, groups, strict=True)])
    return resize(images[positions].to(torch.uint8).view(-1, cells, cells), image_set.size)


def _candidates(image_set: GroupedImages, count: int) -> Tensor:
    seed = image_set.seed
    cells = image_set.cells
    kept_by_image = 1 - image_set.within / UNRELATED  # (1 - s_i)^2
    kept_by_both = 1 - image_set.between / UNRELATED
    group_share = 1 - math.sqrt(kept_by_both / kept_by_image) if kept_by_image else 0.0
    group = torch.arange(1, len(image_set.groups) + 1, device="cpu")
    zero = group.new_tensor(0)
    common = _redraw(zero.expand(cells**2), 1.0, _words(seed, zero, zero, cells))
    blueprints = _redraw(common, group_share, _words(seed, group, zero, cells))
    words = _words(seed, group, torch.arange(1, count + 1, device="cpu").unsqueeze(-1), cells)
    return _redraw(blueprints, 1 - math.sqrt(kept_by_image), words)


def _words(seed: int, row: Tensor, tick: Tensor, cells: int) -> Tensor:
    """At least 2 c * c + 1 random words per element, last."""
    blocks = _GROUPED_BLOCK + torch.arange((2 * cells**2 + 1 + 3) // 4, device="cpu")
    words = draw(row.new_tensor(seed), row.unsqueeze(-1), tick.unsqueeze(-1), STREAM_IMAGES, blocks)
    return torch.stack(words, -1).flatten(-2)


def _redraw(levels: Tensor, share: float, words: Tensor) -> Tensor:
    """Levels [..., n] with share * n of them, rounded at random, redrawn."""
    n = levels.shape[-1]
    count = (words[..., 2 * n : 2 * n + 1] + int(share * n * 2**32)) >> 32
    rank = words[..., :n].argsort(dim=-1, stable=True).argsort(dim=-1)
    return torch.where(rank < count, randint(words[..., n : 2 * n], WHITE + 1), levels)


def _seed_rule(seed: object) -> Rule:
    return is_int(seed, 0, 2**63 - 1), f"image seed must be in [0, 2**63), got {seed!r}"


def _size_rule(size: int, cells: int) -> Rule:
    return is_int(size, cells) and size % cells == 0, f"size must be a positive multiple of {cells}, got {size!r}"
