"""PPO with a bonus for rarely seen observations, for exploration where rewards are rare.

Counts of hashed observations, "#Exploration", Tang et al. 2017 (arXiv 1611.04717): an observation adds coeff /
sqrt(times that its hash was seen) to the reward of the step before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from baselines.parts.networks import highest
from baselines.ppo import PPO, PPOSettings
from ctgraph_rl.checks import is_int, not_negative, require


class SimHashCounts(nn.Module):
    """Counts of observations with the same signs under random projections.

    Args:
        high: largest value of an observation.
        num_bits: number of projections; observations share a count where all signs agree.
    """

    projection: Tensor
    counts: Tensor

    def __init__(self, num_inputs: int, high: float, num_bits: int) -> None:
        super().__init__()
        self.num_inputs = num_inputs
        self.scale = 2 / high
        self.register_buffer("projection", torch.randn(num_inputs, num_bits, dtype=torch.float32, device="cpu"))
        self.register_buffer("counts", torch.zeros(2**num_bits, dtype=torch.int64, device="cpu"))

    def forward(self, observation: Tensor) -> Tensor:
        """Count uint8 observations, and return how often each was seen so far, int64 [n]."""
        flat = observation.reshape(-1, self.num_inputs).float() * self.scale - 1
        signs = (flat @ self.projection > 0).long()
        codes = (signs << torch.arange(signs.shape[1], device=signs.device)).sum(dim=1)
        self.counts.scatter_add_(0, codes, torch.ones_like(codes))
        return self.counts[codes]


@dataclass(frozen=True, kw_only=True)
class PPOCountSettings(PPOSettings):
    """The settings of `PPOCount`."""

    bonus_coeff: float  # bonus for an observation that was never seen before
    num_hash_bits: int  # bits of the hash, at most 24; more bits tell more observations apart

    def __post_init__(self) -> None:
        super().__post_init__()
        bits = f"num_hash_bits must be an integer in 1..24, got {self.num_hash_bits!r}"
        require((is_int(self.num_hash_bits, 1, 24), bits), *not_negative(bonus_coeff=self.bonus_coeff))


class PPOCount(PPO):
    """PPO with a count-based exploration bonus."""

    Settings = PPOCountSettings
    solves = "fully observable tasks (CT-FO) whose goal random actions almost never reach"

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        super().__init__(observation_spec, action_spec, **settings)
        spec = observation_spec["observation"]
        self.seen = SimHashCounts(spec.shape.numel(), highest(spec), self.settings.num_hash_bits)

    def start_task(self, task: int | None = None) -> None:
        """Reset all counts."""
        self.seen.counts.zero_()

    def reward(self, batch: TensorDictBase) -> Tensor:
        """Return the environment's reward plus the bonus for the next observation; count the batch."""
        return super().reward(batch) + self.bonus(batch["next", "observation"]).view(*batch.shape, 1)

    def bonus(self, observation: Tensor) -> Tensor:
        """Count observations, and return the bonus of each, float32 [n]."""
        return self.settings.bonus_coeff * self.seen(observation).float().rsqrt()
