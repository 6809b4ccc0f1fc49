"""g: what an end state pays. One small frozen dataclass per reward, called with tensors.

A reward returns a share of ``Task.goal_reward``: 1 at the goal. Everything it needs is in its arguments, so a
user's own reward is a frozen dataclass (equal and hashable by value) with the same ``__call__``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class RewardFn(Protocol):
    """A reward over end states."""

    def __call__(self, leaf: Tensor, goal_leaf: Tensor, branching_factor: Tensor, depth: Tensor) -> Tensor:
        """The share of ``goal_reward`` that each row's end state pays.

        Args:
            leaf: end state reached, int64 [N] in [0, b**d); its base-b digits are the decisions taken.
            goal_leaf: end state with the goal, int64 [N].
            branching_factor: b of each row, int64 [N].
            depth: d of each row, int64 [N].

        Returns:
            float32 [N]. Rows that have not arrived are computed too and ignored.
        """
        ...


@dataclass(frozen=True)
class Needle:
    """1 at the goal and 0 at every other end state: the needle in a haystack of the paper, section 2.4."""

    def __call__(self, leaf: Tensor, goal_leaf: Tensor, branching_factor: Tensor, depth: Tensor) -> Tensor:
        """See `RewardFn`."""
        return (leaf == goal_leaf).to(torch.float32)
