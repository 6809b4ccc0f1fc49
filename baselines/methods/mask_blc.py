"""Mask BLC: as Mask LC, but half of each new task's mask begins as its own.

Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110), their Mask_BLC.
"""

from __future__ import annotations

import torch
from torch import Tensor

from baselines.methods.masks import CombinedMasks


class MaskBLC(CombinedMasks):
    """`CombinedMasks` that begins with a share of 0.5 for the new scores, and the rest equally for the earlier ones."""

    def new_betas(self, num_earlier: int) -> Tensor:
        """Logarithms of the shares."""
        shares = [0.5 / max(num_earlier, 1)] * num_earlier + [0.5]
        return torch.tensor(shares).log()
