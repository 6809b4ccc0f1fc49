"""Mask LC: modulating masks, each a linear combination of the earlier ones and a new one.

Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110), their Mask_LC.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.methods.parts.masks import Masks, combined, zero_betas


class MaskLC(Masks):
    """`Masks` whose new scores are a linear combination of those of earlier tasks and of new ones.

    In the k-th task each weight tensor l has s = sum_i a_i s_i + a_k s_k, where a is the softmax of k trained numbers
    b_l; the earlier tasks' scores s_i are fixed. At the task's end s is stored as its scores. The numbers b take 4
    bytes for each task and weight tensor.
    """

    betas: nn.Parameter  # b, float32 [weight tensors, tasks]; the last one in use is the new scores'

    @override
    def setup(self) -> None:
        self.betas = zero_betas(self.weights, self.num_ids)
        super().setup()

    @override
    def num_kept(self) -> int:
        return len(self.weights) + len(self.weights.parameters)

    @property
    @override
    def trainable(self) -> list[nn.Parameter]:
        return [*self.own, self.betas]

    @property
    def num_combined(self) -> int:
        """Number of earlier tasks in the combination."""
        return self.ended if self.slot >= self.ended else 0

    def initial_betas(self, num_earlier: int) -> Tensor:
        """Return the initial b of the earlier tasks, then of the new scores: equal shares of 1 / k."""
        return torch.zeros(num_earlier + 1, dtype=torch.float32, device="cpu")

    @override
    def init_scores(self) -> None:
        super().init_scores()
        self.betas.zero_()
        self.betas[:, : self.slot + 1] = self.initial_betas(self.slot)

    @override
    def current_scores(self) -> Sequence[Tensor]:
        earlier = self.num_combined
        if not earlier:
            return super().current_scores()
        old = self.weights.split(self.scores[..., :earlier, :])
        return list(map(combined, self.betas[..., : earlier + 1].unbind(-2), old, self.own))
