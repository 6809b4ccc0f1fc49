"""FIRE: at each boundary every matrix becomes the nearest one that keeps all lengths.

Han et al. 2026 (ICLR, arXiv 2602.08040).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.methods.parts.weights import head_names
from baselines.plasticity.plasticity import Plasticity
from ctgraph_rl.checks import is_int, require, true_or_false


class FIRE(Plasticity):
    """W <- U V' sqrt(outputs / inputs) for the matrix U S V' of each linear layer; biases and gates of cells stay.

    Args:
        iterations: of Newton and Schulz from W / |W|, as in the published code, which does not reach U V' where
            singular values are small; None: U V' by a singular value decomposition.
        heads: also the output layers.
        reset_moments: also set the optimiser's moments of these matrices to 0.
    """

    recycles = needs_boundaries = True

    def __init__(self, iterations: int | None, heads: bool, reset_moments: bool) -> None:
        super().__init__()
        rule = f"iterations must be an integer >= 1, or null for the exact matrix, got {iterations!r}"
        known = iterations is None or is_int(iterations, 1)
        require((known, rule), *true_or_false(heads=heads, reset_moments=reset_moments))
        self.iterations = iterations
        self.heads = heads
        self.reset_moments = reset_moments

    @override
    def at_boundary(self) -> None:
        policy = self.agent.policy
        left_out = () if self.heads else head_names(policy)
        with self.rewriting():
            for name, layer in policy.named_modules():
                if isinstance(layer, nn.Linear) and f"{name}.weight" not in left_out:
                    layer.weight.copy_(isometry(layer.weight, self.iterations))
                    if self.reset_moments:
                        self.clear_moments(layer.weight)


def isometry(matrix: Tensor, iterations: int | None = None) -> Tensor:
    """Return U V' sqrt(n / m) of a matrix U S V', [n, m], or what some iterations give."""
    scale = math.sqrt(matrix.shape[0] / matrix.shape[1])
    if iterations is None:
        u, _, v = torch.linalg.svd(matrix, full_matrices=False)
        return scale * (u @ v)
    is_wide = matrix.shape[1] > matrix.shape[0]
    size = torch.linalg.matrix_norm(matrix).clamp(min=torch.finfo(matrix.dtype).tiny)  # one that failed is 0
    x = (matrix.mT if is_wide else matrix) / size
    for _ in range(iterations):
        x = 1.5 * x - 0.5 * x @ (x.mT @ x)
    return scale * (x.mT if is_wide else x)
