"""Proportional prioritized replay (Schaul et al. 2016, arXiv 1511.05952) as a TorchRL sampler in plain PyTorch.

TorchRL's own sampler keeps segment trees of an extension that is not available for every version of PyTorch, and it
draws from numpy's generator. A draw here costs a pass over the priorities, little beside a gradient step below a size
of 10^6.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers import Storage
from torchrl.data.replay_buffers.samplers import Sampler

LARGEST_ALPHA = 4
"""Beyond it the powers of errors leave the range of float32; Schaul et al. use 0.6 and 0.7."""


class PrioritySampler(Sampler):
    """Draws item i with probability p_i^alpha / sum p^alpha, with replacement, from torch's global generator.

    A new item has the largest priority so far. Each item comes with ``priority_weight``, at most 1:
    (p_i^alpha / min p^alpha)^-beta.

    Args:
        num_items: capacity of the storage.
        alpha: exponent of the priorities.
        beta: exponent of the weights, which correct for alpha. It is constant here; Schaul et al. raise it to 1 over
            training.
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

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Draw items, and return their indices and weights."""
        chances = self.priorities[: len(storage)] ** self.alpha
        index = torch.multinomial(chances, batch_size, replacement=True)
        return index, {"priority_weight": (chances[index] / chances.min()) ** -self.beta}

    def update_priority(self, index: Any, priority: Any, *, storage: Storage | None = None) -> dict[str, Any] | None:
        """Set priorities, float32 [n], to at least 1e-6, so that every item can be drawn."""
        self.priorities[index] = priority.clamp(min=1e-6)
        self.most = torch.maximum(self.most, priority.max())
        return None

    def state_dict(self) -> dict[str, Any]:
        """Return all priorities."""
        return {"priorities": self.priorities.clone(), "most": self.most.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
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
