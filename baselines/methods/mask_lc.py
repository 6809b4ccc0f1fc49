"""Mask LC: modulating masks, each task's is a linear combination of the earlier ones and a new one.

Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110), their Mask_LC.
"""

from __future__ import annotations

import torch
from torch import Tensor

from baselines.methods.parts.masks import CombinedMasks


class MaskLC(CombinedMasks):
    """`CombinedMasks` with equal initial shares: 1 / k in the k-th task."""

    def initial_betas(self, num_earlier: int) -> Tensor:
        """Return equal numbers."""
        return torch.zeros(num_earlier + 1, dtype=torch.float32, device="cpu")
