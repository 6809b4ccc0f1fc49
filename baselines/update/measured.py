"""What gradient steps measure: means over the steps, and an error where a number is not finite."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from baselines.parts.networks import TensorsByName

LARGEST_WEIGHT = 1e12


def table_of(steps: Sequence[TensorsByName]) -> Tensor:
    """Return measurements of gradient steps, [...] each, as a table, [names, gradient steps, ...]."""
    return torch.stack([torch.stack(list(step.values())) for step in steps], dim=1)


def finite_means(names: Sequence[str], table: Tensor, largest_weight: Tensor) -> dict[str, float]:
    """Return the means of measurements, [names, gradient steps].

    Raises:
        FloatingPointError: names the first number that is not finite, or the largest weight.
    """
    for wrong in (~table.isfinite()).any(dim=0).nonzero()[:1, 0]:
        for name, value in zip(names, table[:, wrong], strict=True):
            require_finite(name, value)
    require_finite("the largest weight", largest_weight, LARGEST_WEIGHT)
    return dict(zip(names, table.mean(dim=1).tolist(), strict=True))


def require_finite(name: str, value: Tensor, most: float = math.inf) -> None:
    """Require a finite number of at most ``most``.

    Raises:
        FloatingPointError: if it is not; names the number.
    """
    if not (value.isfinite() and value.abs() <= most):
        raise FloatingPointError(f"{name} is {value.item():g}")
