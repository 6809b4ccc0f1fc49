"""Ids as one-hot vectors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ctgraph_rl.checks import is_int, make_fields_plain, require


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
        make_fields_plain(self)
        require((is_int(self.num_images, 1), f"num_images must be an integer >= 1, got {self.num_images!r}"))

    @property
    def shape(self) -> tuple[int, ...]:
        """(K,)."""
        return (self.num_images,)

    def bank(self, read_rotation: int) -> Tensor:
        """The identity, uint8 [K, K]; a vector has no rotation."""
        return torch.eye(self.num_images, dtype=torch.uint8, device="cpu")
