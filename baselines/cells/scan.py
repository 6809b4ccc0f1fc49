"""Scans over time with resets, in a number of operations logarithmic in the steps.

Each round includes twice as many earlier steps (Hillis and Steele 1986), without a loop over time.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor


def linear_scan(carry: Tensor, inputs: Tensor) -> Tensor:
    """Return h_t = carry_t h_{t-1} + inputs_t at all steps, with h = 0 before the first.

    Args:
        carry: [rows, steps, n], or n = 1 for all; 0 is a reset.
        inputs: [rows, steps, n].
    """
    for distance in _distances(inputs):
        carried = carry[:, distance:] * inputs[:, :-distance]
        inputs = _with_earlier(inputs, inputs[:, distance:] + carried)
        carry = _with_earlier(carry, carry[:, distance:] * carry[:, :-distance])
    return inputs


def max_scan(inputs: Tensor, starts: Tensor) -> Tensor:
    """Return the largest input since the last reset at each step.

    Args:
        inputs: [rows, steps, n].
        starts: where there is a reset before the step, bool [rows, steps].
    """
    goes_on = ~starts.unsqueeze(-1)
    for distance in _distances(inputs):
        later = inputs[:, distance:]
        largest = torch.where(goes_on[:, distance:], torch.maximum(later, inputs[:, :-distance]), later)
        inputs = _with_earlier(inputs, largest)
        goes_on = _with_earlier(goes_on, goes_on[:, distance:] & goes_on[:, :-distance])
    return inputs


def _distances(inputs: Tensor) -> Iterator[int]:
    return (2**power for power in range((inputs.shape[1] - 1).bit_length()))


def _with_earlier(values: Tensor, later: Tensor) -> Tensor:
    return torch.cat([values[:, : values.shape[1] - later.shape[1]], later], dim=1)
