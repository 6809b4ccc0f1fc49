"""Mask BLC: as Mask LC, but the new scores have an initial share of one half.

Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110), their Mask_BLC.
"""

from __future__ import annotations

import torch
from torch import Tensor
from typing_extensions import override

from baselines.methods.mask_lc import MaskLC


class MaskBLC(MaskLC):
    """`MaskLC` with an initial share of 0.5 for the new scores, and equal ones for earlier tasks."""

    @override
    def initial_betas(self, num_earlier: int) -> Tensor:
        shares = [0.5 / max(num_earlier, 1)] * num_earlier + [0.5]
        return torch.tensor(shares, dtype=torch.float32, device="cpu").log()
