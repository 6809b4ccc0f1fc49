"""Layer norm: each hidden layer's inputs of ReLUs have mean 0 and variance 1 over its units.

Ba et al. 2016 (arXiv 1607.06450); against lost plasticity Lyle et al. 2023 (ICML, arXiv 2303.01486).
"""

from __future__ import annotations

import torch
from torch import nn
from typing_extensions import override

from baselines.parts.learner import Learner
from baselines.plasticity.plasticity import Plasticity


class LayerNorm(Plasticity):
    """h = relu(g (a - mean a) / sqrt(var a + 1e-5) + b) with a = W x + c; g starts at 1, b at 0.

    Of convolutions, mean and variance are over the channels of each place. Gates of cells stay.
    """

    reads_units = True

    @override
    def setup(self, agent: Learner) -> None:
        added: list[nn.Parameter] = []
        for layer in self.layers:
            norm = nn.LayerNorm(layer.num_units, dtype=torch.float32, device="cpu")
            added += norm.parameters()
            normalised = nn.Sequential(norm, layer.activation)
            for part in list(agent.policy.modules()):
                for name, child in list(part.named_children()):
                    if child is layer.activation and part is not normalised:
                        setattr(part, name, normalised)
        agent.replace_optimiser([*agent.trainable, *added])
        agent.network_changed()
