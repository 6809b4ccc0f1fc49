"""O: the images behind the observation ids. One frozen dataclass per kind of image set.

A user's own kind is a frozen dataclass with what `ImageSet` names, and yaml reaches it through ``_target_``.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from ctgraph_rl.checks import as_tuple, at_least_one, is_int, is_real, require
from ctgraph_rl.core.philox import STREAM_IMAGES, draw, randint
from ctgraph_rl.core.rotation import rotate, rotations

WHITE = 254
"""Brightest level of the generated sets, and the unit of distances."""

BLUEPRINT_SIZE = 4
BLUEPRINT_LEVELS = (0, 127, WHITE)
BLUEPRINT_ANGLES = (0, 30, 60)

UNRELATED = (WHITE + 2) / (3 * (WHITE + 1))
"""256/765: the expected distance of two images whose cells are independent and uniform over 0..254."""

_GROUPED_BLOCK = 1 << 27  # the upper half of the image stream's blocks; `PaperImages` uses block 0


class ImageSet(Protocol):
    """What is behind the observation ids: a frozen dataclass, equal and hashable by value.

    An id has ``num_variants`` images. Every observation shows one of them, drawn uniformly together with its rotation.
    Two more attributes are optional: ``white``, the brightest level (254 if missing), and ``cue_element``, True for
    vectors whose last element is free to show the reward.
    """

    @property
    def num_images(self) -> int:
        """Number of ids it can show."""
        ...

    @property
    def num_variants(self) -> int:
        """Number of images of each id."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one observation: (1, r, r) for images, (K,) for one-hot."""
        ...

    def bank(self, read_rotation: int) -> Tensor:
        """All that can be shown, uint8 [num_images * num_variants * (read_rotation + 1), *shape].

        Variant v of an id, rotated by a degrees, is in row (id * num_variants + v) * (read_rotation + 1) + a.
        """
        ...


def has_cue_element(images: ImageSet) -> bool:
    """Whether observations are vectors whose last element shows the reward of end states."""
    return getattr(images, "cue_element", False)


def white_level(images: ImageSet) -> float:
    """The brightest level of an image set."""
    return getattr(images, "white", WHITE)


@dataclass(frozen=True)
class OneHot:
    """Ids as one-hot vectors, the paper's 1D observations.

    Args:
        num_images: K, the length of the vector and the number of ids.
    """

    num_images: int

    num_variants = 1
    white = 1

    def __post_init__(self) -> None:
        require((is_int(self.num_images, 1), f"num_images must be an integer >= 1, got {self.num_images!r}"))

    @property
    def shape(self) -> tuple[int, ...]:
        """(K,)."""
        return (self.num_images,)

    def bank(self, read_rotation: int) -> Tensor:
        """The identity, uint8 [K, K]; a vector has no rotation."""
        return torch.eye(self.num_images, dtype=torch.uint8)


class _Generated:
    """What generated sets share: one square image per id."""

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
        """See `ImageSet`."""
        return rotations(self.images, read_rotation)


@dataclass(frozen=True)
class PaperImages(_Generated):
    """The paper's image sets: random blueprints, upscaled and rotated, no image twice.

    Image k is the k-th different one in the sequence of a seed, so a longer set begins with the shorter one.
    A blueprint has 4x4 cells of {0, 1, 2}, shown as 0, 127 and 254; it is scaled up and rotated by 0, 30 or 60 degrees.

    Args:
        num_images: number of images.
        seed: the image seed, in [0, 2**63).
        size: r, side of an image in pixels; a multiple of 4.
    """

    num_images: int
    seed: int = 1
    size: int = 12

    def __post_init__(self) -> None:
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
class GroupedImages(_Generated):
    """Random images with a chosen similarity within groups, such as the decision images, and between groups.

    Ids follow the groups: ``groups=(1, 1, 4, 8)`` makes id 0 the first group, id 1 the second, ids 2..5 the third. The
    distance of two images is their mean absolute pixel difference as a share of 254. An image has c x c cells, each
    uniform over 0..254. A group's blueprint is a common blueprint with a share s_g of its cells drawn anew, an image is
    its group's blueprint with a share s_i drawn anew. Cells that are not shared differ by D = 256/765 on average, hence

        within = D (1 - (1 - s_i)^2),    between = D (1 - (1 - s_i)^2 (1 - s_g)^2)

    are the expected distances of two images of one group and of two groups, and the shares follow from them. What came
    out for a seed is told by `distances`; more cells come closer. A share s of n cells is s n of them rounded at random
    up or down, so at least one is drawn anew when within >= D (1 - (1 - 1 / c^2)^2), the least value allowed.

    No image occurs twice: one drawn before is left out. Longer groups begin with the shorter ones.

    Args:
        groups: number of images of each group.
        within: expected distance of two images of one group.
        between: expected distance of two images of different groups; within <= between <= D.
        seed: the image seed, in [0, 2**63).
        size: r, side of an image in pixels; a multiple of ``cells``.
        cells: c, cells along a side.

    Raises:
        ValueError: for distances out of reach and more images than the cells keep apart.
    """

    groups: tuple[int, ...]
    within: float
    between: float
    seed: int = 1
    size: int = 12
    cells: int = BLUEPRINT_SIZE

    def __post_init__(self) -> None:
        object.__setattr__(self, "groups", as_tuple(self.groups))
        groups = self.groups
        groups_ok = isinstance(groups, tuple) and bool(groups) and all(is_int(size, 1) for size in groups)
        cells = self.cells if is_int(self.cells, 1) else 1
        most = WHITE * cells**2 // 2  # half the images that differ from a blueprint in one cell
        wanted = len(groups) * max(groups) if groups_ok else 0
        require(
            (groups_ok, f"groups must be the numbers of images of each group, >= 1, got {groups!r}"),
            *at_least_one(cells=self.cells),
            _seed_rule(self.seed),
            _size_rule(self.size, cells),
            (wanted <= most, f"groups need {wanted} images, more than {most}; use more cells"),
            *self._distance_rules(),
        )
        object.__setattr__(self, "within", float(self.within))
        object.__setattr__(self, "between", float(self.between))

    def _distance_rules(self) -> list[tuple[bool, str]]:
        """What distances can be reached; any up to that of unrelated images as long as the cells are in question."""
        lowest = UNRELATED * (1 - (1 - 1 / self.cells**2) ** 2) if is_int(self.cells, 1) else 0.0
        within_ok = is_real(self.within, lowest, UNRELATED)
        reach = f"[{math.ceil(lowest * 1e5) / 1e5:.5f}, {UNRELATED:.5f}]"
        if is_real(self.within, 1e-9, lowest):
            reach += f" for cells={self.cells} (use cells={_cells_for(self.within)} or more)"
        between_ok = is_real(self.between, self.within if within_ok else lowest, UNRELATED)
        return [
            (within_ok, f"within must be in {reach}, got {self.within!r}"),
            (between_ok, f"between must be in [within, {UNRELATED:.5f}], got {self.between!r}"),
        ]

    @property
    def num_images(self) -> int:
        """Images of all groups."""
        return sum(self.groups)

    @property
    def group_of(self) -> tuple[int, ...]:
        """The group of each id, numbered from 0: what `distances` asks for."""
        return tuple(group for group, size in enumerate(self.groups) for _ in range(size))

    @property
    def images(self) -> Tensor:
        """uint8 [num_images, r, r], before rotation and noise on read."""
        return _grouped_images(self)


@dataclass(frozen=True)
class ImageFile:
    """A user's images: a .npy file that holds a uint8 array [classes, instances, r, r].

    An id is a class; every observation shows an instance drawn uniformly. ``ImageFile.of(path)`` fills in the hash.
    Two sets are equal when their content is: the path only says where this machine keeps it. The environment's bank
    takes classes * instances * (read_rotation + 1) * r * r bytes.

    Args:
        path: the file; relative to the working directory.
        sha256: SHA-256 of the file, 64 hex digits.
        size: side of an observation in pixels: a multiple of r repeats pixels, a divisor averages blocks of them. None
            is r.

    Raises:
        ValueError: for a missing file, another content than the hash says, and an array of another kind.
    """

    path: str = field(compare=False)
    sha256: str
    size: int | None = None
    num_images: int = field(init=False, compare=False)
    num_variants: int = field(init=False, compare=False)
    shape: tuple[int, ...] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", str(self.path))
        classes, instances, side = _read(self.path).shape[:3]
        size = side if self.size is None else self.size
        whole = is_int(size, 1) and (size % side == 0 or side % size == 0)
        require(
            self._hash_rule(),
            (whole, f"size must be a multiple or a divisor of the file's {side} pixels, got {size!r}"),
        )
        found = {"size": size, "num_images": classes, "num_variants": instances, "shape": (1, size, size)}
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, path: str | Path, size: int | None = None) -> ImageFile:
        """The images of a file with the hash that it has now."""
        _read(str(path))
        return cls(str(path), _sha256(str(path)), size)

    def _hash_rule(self) -> tuple[bool, str]:
        found, fix = _sha256(self.path), f"if that is the content you mean, ImageFile.of({self.path!r}) fills it in"
        return found == self.sha256, f"sha256 of {self.path} must be {self.sha256!r}, but the file has {found!r}; {fix}"

    @property
    def images(self) -> Tensor:
        """uint8 [classes * instances, r, r], the instances of a class in a row; read anew from the file."""
        array = _read(self.path)
        require(self._hash_rule())
        return _resize(torch.from_numpy(np.array(array, order="C")).flatten(0, 1), self.shape[-1])

    def bank(self, read_rotation: int) -> Tensor:
        """See `ImageSet`."""
        return rotations(self.images, read_rotation)


class Distances(NamedTuple):
    """Mean absolute pixel differences as a share of 254; nan where there is no pair to compare."""

    within: float  # mean over all pairs of different images of one group
    between: float  # mean over all pairs of images of different groups
    matrix: Tensor  # float64 [G, G]: the mean over pairs for every two groups, and within each on the diagonal


def distances(images: Tensor, groups: Sequence[int]) -> Distances:
    """How far apart images are within and between groups.

    The sum of |x - y| over the pairs of two groups is, per pixel, the sum over levels of A (m - B) + B (n - A), where A
    and B count each group's images up to the level and n and m count all: integers, and linear in the images.

    Args:
        images: uint8 [n, r, r].
        groups: the group of each image, numbered from 0 without a gap.
    """
    numbers = sorted(set(groups))
    require(
        (images.dtype == torch.uint8 and images.ndim == 3, f"images must be uint8 [n, r, r], got {images.dtype}"),
        (len(groups) == len(images), f"groups must have one entry for each of {len(images)} images, got {len(groups)}"),
        (numbers == list(range(len(numbers))), f"groups must be numbered from 0 without a gap, got {numbers}"),
    )
    group_of = torch.tensor(groups, device=images.device)
    up_to = torch.stack([_counts_up_to_level(images[group_of == group]) for group in numbers]).to(torch.float64)
    sizes = torch.bincount(group_of).to(torch.float64)
    mixed = up_to.sum(1).unsqueeze(1) * sizes
    sums = (mixed + mixed.T - 2 * up_to @ up_to.T) / (images[0].numel() * WHITE)
    pairs = sizes.unsqueeze(1) * sizes - sizes.diag()  # of different images, in both orders
    same = torch.eye(len(numbers), dtype=torch.bool, device=images.device)
    within, between = ((sums[where].sum() / pairs[where].sum()).item() for where in (same, ~same))
    return Distances(within, between, sums / pairs)


def _counts_up_to_level(images: Tensor) -> Tensor:
    """int64 [pixels * 256]: how many images have at most a level at a pixel."""
    pixels = images.flatten(1).to(torch.int64)
    count = pixels.shape[1]
    place = pixels + 256 * torch.arange(count, device=images.device)
    return torch.bincount(place.flatten(), minlength=256 * count).view(count, 256).cumsum(1).flatten()


def count_repeats(images: Tensor) -> int:
    """How many of uint8 [n, r, r] images equal an earlier one."""
    fits = images.dtype == torch.uint8 and images.ndim == 3 and len(images) > 0
    require((fits, f"images must be uint8 [n, r, r] with n >= 1, got {images.dtype} {list(images.shape)}"))
    return len(images) - len(_first_of_each(images))


def _resize(images: Tensor, size: int) -> Tensor:
    """Images [n, r, r] with every pixel repeated, or blocks of pixels averaged and rounded, half up."""
    side = images.shape[-1]
    if size >= side:
        return images.repeat_interleave(size // side, dim=1).repeat_interleave(size // side, dim=2)
    block = side // size
    sums = images.view(-1, size, block, size, block).sum((2, 4), dtype=torch.int64)
    return ((2 * sums + block**2) // (2 * block**2)).to(torch.uint8)


def _first_of_each(images: Tensor) -> Tensor:
    """Positions of the images that do not repeat an earlier one, in order."""
    _, group = torch.unique(images.flatten(1), dim=0, return_inverse=True)
    positions = torch.arange(len(images))
    first = torch.full((int(group.max()) + 1,), len(images)).scatter_reduce(0, group, positions, reduce="amin")
    return first.sort().values


@lru_cache(maxsize=16)
def _paper_images(image_set: PaperImages) -> Tensor:
    """The first different images of the seed's sequence of candidates."""
    candidates, images = image_set.num_images, torch.empty(0)
    while len(images) < image_set.num_images:
        rendered = _render(_blueprints(image_set.seed, candidates), image_set.size)
        images = rendered[_first_of_each(rendered)]
        candidates *= 2
    return images[: image_set.num_images].clone()


def _blueprints(seed: int, count: int) -> Tensor:
    """int64 [count, 17]: 16 cells of a blueprint in {0, 1, 2} and one of three angles, by counter."""
    words = draw(torch.tensor(seed), torch.tensor(0), torch.arange(count), STREAM_IMAGES)
    powers = 3 ** torch.arange(BLUEPRINT_SIZE**2 + 1)
    return ((words[0] << 31) | (words[1] >> 1)).unsqueeze(-1) // powers % 3


def _render(blueprints: Tensor, size: int) -> Tensor:
    """Blueprints as uint8 [count, size, size] images."""
    levels = torch.tensor(BLUEPRINT_LEVELS, dtype=torch.uint8)[blueprints[:, :-1]]
    images = _resize(levels.view(-1, BLUEPRINT_SIZE, BLUEPRINT_SIZE), size)
    for which, angle in enumerate(BLUEPRINT_ANGLES):
        chosen = blueprints[:, -1] == which
        images[chosen] = rotate(images[chosen], angle)
    return images


@lru_cache(maxsize=16)
def _grouped_images(image_set: GroupedImages) -> Tensor:
    """Each group's first candidates that repeat none of any group, where candidate k of all groups precedes k + 1."""
    groups, cells = image_set.groups, image_set.cells
    candidates, chosen = max(groups), [torch.empty(0)]
    while any(len(positions) < size for positions, size in zip(chosen, groups, strict=False)):
        images = _candidates(image_set, candidates).flatten(0, 1)
        first = _first_of_each(images)
        chosen = [first[first % len(groups) == group] for group in range(len(groups))]
        candidates *= 2
    positions = torch.cat([positions[:size] for positions, size in zip(chosen, groups, strict=True)])
    return _resize(images[positions].to(torch.uint8).view(-1, cells, cells), image_set.size)


def _candidates(image_set: GroupedImages, count: int) -> Tensor:
    """int64 [count, G, c * c]: levels of the first candidates of each group."""
    seed, cells = image_set.seed, image_set.cells
    kept_by_image = 1 - image_set.within / UNRELATED  # (1 - s_i)^2
    kept_by_both = 1 - image_set.between / UNRELATED
    group_share = 1 - math.sqrt(kept_by_both / kept_by_image) if kept_by_image else 0.0
    group = torch.arange(1, len(image_set.groups) + 1)
    common = _redraw(
        torch.zeros(cells**2, dtype=torch.int64), 1.0, _words(seed, torch.tensor(0), torch.tensor(0), cells)
    )
    blueprints = _redraw(common, group_share, _words(seed, group, torch.tensor(0), cells))
    words = _words(seed, group, torch.arange(1, count + 1).unsqueeze(-1), cells)
    return _redraw(blueprints, 1 - math.sqrt(kept_by_image), words)


def _words(seed: int, row: Tensor, tick: Tensor, cells: int) -> Tensor:
    """At least 2 c * c + 1 random words per element, in a last dimension."""
    blocks = _GROUPED_BLOCK + torch.arange((2 * cells**2 + 1 + 3) // 4)
    words = draw(torch.tensor(seed), row.unsqueeze(-1), tick.unsqueeze(-1), STREAM_IMAGES, blocks)
    return torch.stack(words, -1).flatten(-2)


def _redraw(levels: Tensor, share: float, words: Tensor) -> Tensor:
    """Levels [..., n] with a share of them drawn anew, each with this probability: share * n, rounded at random."""
    n = levels.shape[-1]
    count = (words[..., 2 * n : 2 * n + 1] + int(share * n * 2**32)) >> 32
    rank = words[..., :n].argsort(dim=-1, stable=True).argsort(dim=-1)
    return torch.where(rank < count, randint(words[..., n : 2 * n], WHITE + 1), levels)


def _cells_for(distance: float) -> int:
    """Cells along a side from which on a distance within groups is in reach."""
    return math.ceil((1 - math.sqrt(1 - distance / UNRELATED)) ** -0.5)


def _seed_rule(seed: object) -> tuple[bool, str]:
    return is_int(seed, 0, 2**63 - 1), f"image seed must be in [0, 2**63), got {seed!r}"


def _size_rule(size: int, cells: int) -> tuple[bool, str]:
    return is_int(size, cells) and size % cells == 0, f"size must be a positive multiple of {cells}, got {size!r}"


def _read(path: str) -> np.ndarray:
    """The array of a file, not yet in memory."""
    require((Path(path).is_file(), f"path must be an existing .npy file, got {path!r}"))
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f"{path} must be a .npy file of a uint8 array [classes, instances, r, r]: {error}") from error
    is_array = isinstance(array, np.ndarray)
    found = f"{array.dtype} {list(array.shape)}" if is_array else "several arrays"
    fits = is_array and array.dtype == np.uint8 and array.ndim == 4 and array.shape[2] == array.shape[3] and array.size
    require((bool(fits), f"{path} must hold a uint8 array [classes, instances, r, r], got {found}"))
    return array


def _sha256(path: str) -> str:
    stat = Path(path).stat()
    return _sha256_of_version(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=64)
def _sha256_of_version(path: str, size: int, changed: int) -> str:
    """SHA-256 of a file, read once as long as its size and time of change stay."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
