"""A user's images from a .npy file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ctgraph_rl.checks import Rule, is_int, make_fields_plain, require
from ctgraph_rl.core.rotation import rotations
from ctgraph_rl.tasks.images.image_set import resize


@dataclass(frozen=True)
class ImageFile:
    """A user's images: a .npy file with a uint8 array [classes, instances, r, r].

    An id is a class; every observation shows an instance drawn uniformly. ``ImageFile.of(path)`` fills in the hash.
    Sets are equal when their content is, wherever the file is. The environment's bank takes
    classes * instances * (read_rotation + 1) * r * r bytes.

    Args:
        sha256: of the file, 64 hex digits.
        size: side of an observation in pixels: a multiple of r repeats pixels, a divisor averages blocks; None: r.

    Raises:
        ValueError: for a missing file, another hash, or another kind of array.
    """

    path: str = field(compare=False)
    sha256: str
    size: int | None = None
    num_images: int = field(init=False, compare=False)
    num_variants: int = field(init=False, compare=False)
    shape: tuple[int, ...] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        make_fields_plain(self)
        object.__setattr__(self, "path", str(self.path))
        classes, instances, side = _read(self.path).shape[:3]
        size = side if self.size is None else self.size
        whole = is_int(size, 1) and (size % side == 0 or side % size == 0)
        size_rule = f"size must be a multiple or a divisor of the file's {side} pixels, got {size!r}"
        require(self._hash_rule(), (whole, size_rule))
        found = {"size": size, "num_images": classes, "num_variants": instances, "shape": (1, size, size)}
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, path: str | Path, size: int | None = None) -> ImageFile:
        """The images of a file, with its present hash."""
        _read(str(path))
        return cls(str(path), _sha256(str(path)), size)

    def _hash_rule(self) -> Rule:
        found = _sha256(self.path)
        fix = f"if that is the content you mean, ImageFile.of({self.path!r}) fills it in"
        return found == self.sha256, f"sha256 of {self.path} must be {self.sha256!r}, but the file has {found!r}; {fix}"

    @property
    def images(self) -> Tensor:
        """uint8 [classes * instances, r, r], class by class; read from the file again."""
        array = _read(self.path)
        require(self._hash_rule())
        return resize(torch.from_numpy(np.array(array, order="C")).flatten(0, 1), self.shape[-1])

    def bank(self, read_rotation: int) -> Tensor:
        """Return each image's rotations by 0, 1, ... degrees in a row, uint8 [rows, 1, r, r]."""
        return rotations(self.images, read_rotation)


def _read(path: str) -> np.ndarray:
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
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
