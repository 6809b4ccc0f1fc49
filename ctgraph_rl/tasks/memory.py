"""The memory that tasks need for their images, and the refusal of what a machine cannot hold."""

from __future__ import annotations

import math
from collections.abc import Iterable

from torch import Tensor

from ctgraph_rl.checks import require_memory
from ctgraph_rl.tasks.images import ImageSet
from ctgraph_rl.tasks.task import Task

BankKey = tuple[ImageSet, int]
"""An image set, and the rotation on read whose angles an environment's bank holds."""


def rotates_after_noise(task: Task) -> bool:
    """Return whether rotations come after noise, so that no bank can hold them; without noise the order is the same."""
    return task.observations.noise_before_rotation and task.observations.read_noise > 0


def bank_key(task: Task) -> BankKey:
    """Return the images of a task and the rotation that is in the bank."""
    return task.images, 0 if rotates_after_noise(task) else task.observations.read_rotation


def make_bank(key: BankKey) -> Tensor:
    """Return all images of a key, uint8 [rows, *shape]."""
    images, rotation = key
    size = math.prod(images.shape) * images.num_images * images.num_variants * (rotation + 1)
    require_memory(f"{images.num_images:,} images while they are made", 2 * size, "images")
    return images.bank(rotation)


def bank_bytes(tasks: Iterable[Task]) -> int:
    """Return the bytes of the images that an environment holds: each different set once, one-hot vectors padded."""
    sets = {bank_key(task): math.prod(task.images.shape) for task in tasks}
    shown = sum(images.num_images * images.num_variants * (rotation + 1) for images, rotation in sets)
    return shown * max(sets.values())
