"""Memory of tasks' images, and the refusal of what a machine cannot hold."""

from __future__ import annotations

import math
from collections.abc import Iterable

from torch import Tensor

from ctgraph_rl.checks import require_memory
from ctgraph_rl.tasks.images import ImageSet
from ctgraph_rl.tasks.task import Task

BankKey = tuple[ImageSet, int]
"""An image set, and the rotation on read that the bank holds."""


def rotates_after_noise(task: Task) -> bool:
    """Return whether rotations follow noise, so that no bank can hold them."""
    return task.observations.noise_before_rotation and task.observations.read_noise > 0


def bank_key(task: Task) -> BankKey:
    """Return the key of a task's bank."""
    return task.images, 0 if rotates_after_noise(task) else task.observations.read_rotation


def make_bank(key: BankKey) -> Tensor:
    """Return the images of a key, uint8 [rows, *shape]."""
    images, rotation = key
    size = math.prod(images.shape) * images.num_images * images.num_variants * (rotation + 1)
    require_memory(f"{images.num_images:,} images while they are made", 2 * size, "images")
    return images.bank(rotation)


def bank_bytes(tasks: Iterable[Task]) -> int:
    """Return the bytes of an environment's images: each different set once, vectors padded."""
    sets = {bank_key(task): math.prod(task.images.shape) for task in tasks}
    shown = sum(images.num_images * images.num_variants * (rotation + 1) for images, rotation in sets)
    return shown * max(sets.values())
