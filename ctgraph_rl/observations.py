"""X and O: which observation id a state shows, and the images behind the ids.

Section 2.3 of the paper. The id ranges are inclusive, as in the paper's JSON (W_IDs, D_IDs, graph_ends).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import pairwise
from typing import Protocol

import torch
from torch import Tensor

from ctgraph_rl.checks import as_tuple, is_int, require
from ctgraph_rl.dynamics import STREAM_IMAGES, draw
from ctgraph_rl.graph import CTGraph, StateType

Ids = tuple[int, int]
"""First and last id of a subset, both included."""

MAX_READ_ROTATION = 359
BLUEPRINT_SIZE = 4
BLUEPRINT_LEVELS = (0, 127, 254)
BLUEPRINT_ANGLES = (0, 30, 60)


@dataclass(frozen=True)
class Observations:
    """The observation process X of a task: the ids of each kind of state, and the variation on read.

    Fully observable: ``unique_decisions`` and ``unique_waits`` (MDP_D, MDP_W of the paper). Surjective: ranges of
    one id. Confounding: longer ranges without uniqueness; an id is then drawn for every observation.

    Args:
        wait_ids: ids of wait states, O^W.
        decision_ids: ids of decision states, O^D.
        end_ids: ids of end states, O^E.
        home_ids: ids of the home state, O^H.
        fail_ids: ids of the fail state, O^F.
        unique_waits: each wait state has an id of its own.
        unique_decisions: each decision state has an id of its own.
        unique_ends: each end state has an id of its own; None means: when waits or decisions have.
        read_noise: each pixel gets an integer drawn from 0..read_noise added, saturating at 255.
        read_rotation: images are rotated by a whole number of degrees drawn from 0..read_rotation.

    Raises:
        ValueError: for ranges that are reversed or overlap, and values out of range.
    """

    wait_ids: Ids
    decision_ids: Ids
    end_ids: Ids
    home_ids: Ids = (0, 0)
    fail_ids: Ids = (1, 1)
    unique_waits: bool = False
    unique_decisions: bool = False
    unique_ends: bool | None = None
    read_noise: int = 0
    read_rotation: int = 0

    def __post_init__(self) -> None:
        ranges = [field.name for field in fields(self) if field.name.endswith("_ids")]
        for name in ranges:
            object.__setattr__(self, name, as_tuple(getattr(self, name)))
        if self.unique_ends is None:
            object.__setattr__(self, "unique_ends", bool(self.unique_decisions or self.unique_waits))
        require(
            *((_is_range(getattr(self, name)), _range_rule(name, getattr(self, name))) for name in ranges),
            *_flag_rules(self),
            (is_int(self.read_noise, 0, 255), f"read_noise must be an integer in 0..255, got {self.read_noise!r}"),
            (
                is_int(self.read_rotation, 0, MAX_READ_ROTATION),
                f"read_rotation must be whole degrees in 0..{MAX_READ_ROTATION}, got {self.read_rotation!r}",
            ),
        )
        require(*_overlap_rules({name: getattr(self, name) for name in ranges}))

    def ids(self, kind: StateType) -> Ids:
        """First and last id of a kind of state."""
        return getattr(self, f"{kind.name.lower()}_ids")

    def is_unique(self, kind: StateType) -> bool:
        """Whether each state of this kind has an id of its own."""
        return bool(getattr(self, f"unique_{kind.name.lower()}s", False))

    @property
    def last_id(self) -> int:
        """The highest id in use."""
        return max(self.ids(kind)[1] for kind in StateType)

    @property
    def draws_ids(self) -> bool:
        """Whether any kind of state shows an id drawn from several."""
        return any(not self.is_unique(kind) and self.ids(kind)[0] < self.ids(kind)[1] for kind in StateType)

    def rules(self, graph: CTGraph) -> list[tuple[bool, str]]:
        """What must hold on a graph: unique ids need as many ids as there are states."""
        return [self._room_rule(kind, count) for kind, count in _states_with_ids(graph) if self.is_unique(kind)]

    def _room_rule(self, kind: StateType, count: int) -> tuple[bool, str]:
        name, (first, last) = f"{kind.name.lower()}_ids", self.ids(kind)
        need = f"unique_{kind.name.lower()}s needs {count} {name}, got {last - first + 1} in ({first}, {last})"
        return last - first + 1 >= count, f"{need}; use ({first}, {first + count - 1})"


def _states_with_ids(graph: CTGraph) -> list[tuple[StateType, int]]:
    return [
        (StateType.WAIT, graph.num_wait_states),
        (StateType.DECISION, graph.num_decision_states),
        (StateType.END, graph.num_end_states),
    ]


def _is_range(value: object) -> bool:
    return isinstance(value, tuple) and len(value) == 2 and is_int(value[0], 0) and is_int(value[1], value[0])


def _range_rule(name: str, value: object) -> str:
    return f"{name} must be (first, last) with 0 <= first <= last, got {value!r}"


def _flag_rules(observations: Observations) -> list[tuple[bool, str]]:
    names = ("unique_waits", "unique_decisions", "unique_ends")
    flags = [(name, getattr(observations, name)) for name in names]
    return [(isinstance(value, bool), f"{name} must be true or false, got {value!r}") for name, value in flags]


def _overlap_rules(ranges: dict[str, Ids]) -> list[tuple[bool, str]]:
    ordered = sorted(ranges.items(), key=lambda item: item[1])
    return [
        (high[0] > low[1], f"{high_name}={high} overlaps {low_name}={low}; let it start at {low[1] + 1} or later")
        for (low_name, low), (high_name, high) in pairwise(ordered)
    ]


class ImageSet(Protocol):
    """What is behind the observation ids: a frozen dataclass, equal and hashable by value."""

    @property
    def num_images(self) -> int:
        """Number of ids it can show."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one observation: (1, r, r) for images, (K,) for one-hot."""
        ...

    def bank(self, read_rotation: int) -> Tensor:
        """uint8 [num_images * (read_rotation + 1), *shape]: each id's rotations by 0, 1, ... degrees in a row."""
        ...


@dataclass(frozen=True)
class OneHot:
    """Ids as one-hot vectors, the paper's 1D observations.

    Args:
        num_images: K, the length of the vector and the number of ids.
    """

    num_images: int

    def __post_init__(self) -> None:
        require((is_int(self.num_images, 1), f"num_images must be an integer >= 1, got {self.num_images!r}"))

    @property
    def shape(self) -> tuple[int, ...]:
        """(K,)."""
        return (self.num_images,)

    def bank(self, read_rotation: int) -> Tensor:
        """The identity, uint8 [K, K]; a vector has no rotation."""
        return torch.eye(self.num_images, dtype=torch.uint8)


@dataclass(frozen=True)
class PaperImages:
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
        size_ok = is_int(self.size, BLUEPRINT_SIZE) and self.size % BLUEPRINT_SIZE == 0
        most = len(BLUEPRINT_LEVELS) ** (BLUEPRINT_SIZE**2)
        require(
            (is_int(self.num_images, 1, most), f"num_images must be in 1..{most} (3**16), got {self.num_images!r}"),
            (is_int(self.seed, 0, 2**63 - 1), f"image seed must be in [0, 2**63), got {self.seed!r}"),
            (size_ok, f"size must be a positive multiple of {BLUEPRINT_SIZE}, got {self.size!r}"),
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """(1, r, r)."""
        return (1, self.size, self.size)

    @property
    def images(self) -> Tensor:
        """uint8 [num_images, r, r], before rotation and noise on read."""
        return _paper_images(self)

    def bank(self, read_rotation: int) -> Tensor:
        """See `ImageSet`."""
        rotations = [rotate(self.images, angle) for angle in range(read_rotation + 1)]
        return torch.stack(rotations, dim=1).view(-1, *self.shape)


@lru_cache(maxsize=16)
def _paper_images(image_set: PaperImages) -> Tensor:
    """The first different images of the seed's sequence of candidates."""
    candidates, images = image_set.num_images, torch.empty(0)
    while len(images) < image_set.num_images:
        images = _first_of_each(_render(_blueprints(image_set.seed, candidates), image_set.size))
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
    scale = size // BLUEPRINT_SIZE
    images = levels.view(-1, BLUEPRINT_SIZE, BLUEPRINT_SIZE)
    images = images.repeat_interleave(scale, dim=1).repeat_interleave(scale, dim=2)
    for which, angle in enumerate(BLUEPRINT_ANGLES):
        chosen = blueprints[:, -1] == which
        images[chosen] = rotate(images[chosen], angle)
    return images


def _first_of_each(images: Tensor) -> Tensor:
    """Images without repeats, in the order of first appearance."""
    flat = images.flatten(1)
    _, group = torch.unique(flat, dim=0, return_inverse=True)
    first = torch.full((int(group.max()) + 1,), len(images)).scatter_reduce(
        0, group, torch.arange(len(images)), reduce="amin"
    )
    return images[first.sort().values]


def rotate(images: Tensor, degrees: int) -> Tensor:
    """Rotate images counter-clockwise about their centre, bilinear, black outside.

    Args:
        images: uint8 [n, r, r].
        degrees: whole degrees.

    Returns:
        uint8 [n, r, r], rounded to the nearest level. Integer arithmetic with 16-bit weights: equal on every machine.
    """
    if degrees % 360 == 0:
        return images
    index, weight = _rotation_taps(images.shape[-1], degrees)
    taps = images.flatten(1).to(torch.int64)[:, index]
    return (((taps * weight).sum(-1) + (1 << 15)) >> 16).to(torch.uint8).view_as(images)


@lru_cache(maxsize=512)
def _rotation_taps(size: int, degrees: int) -> tuple[Tensor, Tensor]:
    """For each pixel the four source pixels and their weights * 2**16; both int64 [r * r, 4]."""
    angle, centre = math.radians(degrees), (size - 1) / 2
    grid = torch.arange(size, dtype=torch.float64) - centre
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    source_x = math.cos(angle) * x - math.sin(angle) * y + centre
    source_y = math.sin(angle) * x + math.cos(angle) * y + centre
    taps, weights = [], []
    for step_y in (0, 1):
        for step_x in (0, 1):
            tap_y, tap_x = source_y.floor() + step_y, source_x.floor() + step_x
            weight = (1 - (source_y - tap_y).abs()) * (1 - (source_x - tap_x).abs())
            inside = (tap_y >= 0) & (tap_y < size) & (tap_x >= 0) & (tap_x < size)
            taps.append((tap_y * size + tap_x).where(inside, 0.0).long().flatten())
            weights.append((weight.where(inside, 0.0) * 2**16).round().long().flatten())
    return torch.stack(taps, -1), torch.stack(weights, -1)
