"""L2: a penalty on changes of all weights since the end of the last task.

The simplest baseline of Kirkpatrick et al. 2017 (arXiv 1612.00796), where EWC was compared with it.
"""

from __future__ import annotations

import torch
from torch import Tensor
from typing_extensions import override

from baselines.methods.parts.importance import Importance


class L2(Importance):
    """Adds coeff * |w - a|^2; a are the weights at the end of the last task."""

    stackable = True

    @override
    def task_importance(self) -> Tensor:
        return torch.ones_like(self.importance)

    def consolidate(self, new: Tensor, weights: Tensor) -> None:
        """Keep all weights equally important."""
        self.importance.copy_(new)
        self.anchor.copy_(weights)
