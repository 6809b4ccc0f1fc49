"""g: what an end state pays, a frozen dataclass per reward, called with tensors.

A reward returns a share of ``Task.goal_reward``: 1 at the goal. A user's own is a frozen dataclass with the same
``__call__``, named by ``_target_`` in yaml. It may have ``bounds``, as here; without it returns are unbounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class Arrival(NamedTuple):
    """The end states that rows arrived at; int64 [N], without meaning in other rows."""

    leaf: Tensor  # in [0, b**d); its base-b digits are the decisions taken, the first one leading
    goal_leaf: Tensor
    branching_factor: Tensor
    depth: Tensor
    max_depth: int  # the largest depth of the batch

    def differences(self) -> Tensor:
        """|decision taken - goal's decision|, last first, 0 beyond a row's depth: [N, max_depth]."""
        place = torch.arange(self.max_depth, device=self.leaf.device)
        base = self.branching_factor.unsqueeze(-1)
        valid = place < self.depth.unsqueeze(-1)
        power = base ** torch.where(valid, place, 0)
        taken, wanted = (leaf.unsqueeze(-1) // power % base for leaf in (self.leaf, self.goal_leaf))
        return torch.where(valid, (taken - wanted).abs(), 0)


class RewardFn(Protocol):
    """A reward over end states."""

    def __call__(self, arrival: Arrival) -> Tensor:
        """The share of ``goal_reward`` that each end state pays, float32 [N]."""
        ...


@dataclass(frozen=True)
class Needle:
    """1 at the goal and 0 at every other end state (section 2.5 of the paper)."""

    def __call__(self, arrival: Arrival) -> Tensor:
        """Shares, float32 [N]."""
        return (arrival.leaf == arrival.goal_leaf).to(torch.float32)

    def bounds(self, branching_factor: int) -> tuple[float, float]:
        """Lowest and highest share."""
        return 0.0, 1.0


@dataclass(frozen=True)
class Gradient:
    """Reward in [0, 1] that shrinks with the weighted distance of the decisions from the goal's.

    1 - sum_k b^(d-k) |D_k - G_k| / (b^d - 1), k = 1..d: an early wrong decision costs more than a late one. The
    paper's reward gradient (section 2.5) with its weights corrected to b^(d-1)..b^0.
    """

    def __call__(self, arrival: Arrival) -> Tensor:
        """Shares, float32 [N]."""
        b = arrival.branching_factor
        depth = arrival.depth
        place = torch.arange(arrival.max_depth, device=b.device)
        weight = b.unsqueeze(-1) ** torch.where(place < depth.unsqueeze(-1), place, 0)
        lost = (weight * arrival.differences()).sum(-1)  # exact: at most b^d - 1
        return (1 - lost.double() / (b**depth - 1).double()).float()

    def bounds(self, branching_factor: int) -> tuple[float, float]:
        """Lowest and highest share."""
        return 0.0, 1.0


@dataclass(frozen=True)
class ReferenceLinear:
    """The linear reward of the authors' implementation: weights d, d-1, .., 1 and no bound below for b > 2.

    sum_k (d-k+1) (1 - |D_k - G_k|) / sum_k (d-k+1). In thirds for b=2, d=2; down to -1 for b=3, d=2.
    """

    def __call__(self, arrival: Arrival) -> Tensor:
        """Shares, float32 [N]."""
        place = torch.arange(1, arrival.max_depth + 1, device=arrival.leaf.device)
        depth = arrival.depth
        lost = (place * arrival.differences()).sum(-1)  # the last decision weighs 1, the first one d
        return (1 - lost.double() / (depth * (depth + 1) / 2)).float()

    def bounds(self, branching_factor: int) -> tuple[float, float]:
        """Lowest and highest share; the lowest is at the farthest decisions."""
        return 2.0 - branching_factor, 1.0


KERNEL_REWARDS = (Needle, Gradient, ReferenceLinear)
"""Rewards that ``kernel.c`` computes, in its order; others need the tensor engine."""

REWARD_FNS: dict[str, type] = {"needle": Needle, "gradient": Gradient, "reference_linear": ReferenceLinear}
"""Every reward of this package by its name in settings."""
