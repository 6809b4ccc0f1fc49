"""Proportional prioritized replay (Schaul et al. 2016, arXiv 1511.05952) as a TorchRL sampler in plain PyTorch.

TorchRL's sampler needs an extension that not every version of PyTorch has, and draws from numpy's generator. A draw
costs a pass over the priorities, little beside a gradient step below a size of 10^6.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers import Storage
from torchrl.data.replay_buffers.samplers import Sampler
from typing_extensions import override

LARGEST_ALPHA = 4
"""Beyond it powers of errors leave the range of float32; Schaul et al. use 0.6 and 0.7."""


class PrioritySampler(Sampler):
    """Draws item i with probability p_i^alpha / sum p^alpha, with replacement, from torch's global generator.

    A new item has the largest priority so far. Items come with ``priority_weight`` (p_i^alpha / min p^alpha)^-beta, at
    most 1.

    Args:
        alpha: exponent of the priorities.
        beta: exponent of the weights; constant, where Schaul et al. raise it to 1.
    """

    def __init__(self, num_items: int, alpha: float, beta: float) -> None:
        self.alpha = alpha
        self.beta = beta
        self.priorities = torch.zeros(num_items, dtype=torch.float32, device="cpu")
        self.most = torch.ones((), dtype=torch.float32, device="cpu")

    def extend(self, index: Tensor) -> None:
        """Give new items the largest priority so far."""
        self.priorities[index] = self.most

    add = extend

    @override
    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        chances = self.priorities[: len(storage)] ** self.alpha
        index = torch.multinomial(chances, batch_size, replacement=True)
        return index, {"priority_weight": (chances[index] / chances.min()) ** -self.beta}

    def update_priority(self, index: Any, priority: Any, *, storage: Storage | None = None) -> dict[str, Any] | None:
        """Set priorities, float32 [n], to at least 1e-6, so that every item can be drawn."""
        self.priorities[index] = priority.clamp(min=1e-6)
        self.most = torch.maximum(self.most, priority.max())
        return None

    @override
    def state_dict(self) -> dict[str, Any]:
        return {"priorities": self.priorities.clone(), "most": self.most.clone()}

    @override
    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.priorities.copy_(state_dict["priorities"])
        self.most = state_dict["most"].clone()

    def _empty(self) -> None:
        self.priorities.zero_()
        self.most = torch.ones((), dtype=torch.float32, device="cpu")

    def dumps(self, path: Any) -> None:
        """Not used: `state_dict` holds all."""
        raise NotImplementedError

    def loads(self, path: Any) -> None:
        """Not used: `state_dict` holds all."""
        raise NotImplementedError
