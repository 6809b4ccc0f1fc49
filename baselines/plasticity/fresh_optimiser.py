"""A fresh optimiser at each boundary, the weights as they were: the control of methods that change these, too."""

from __future__ import annotations

from typing_extensions import override

from baselines.plasticity.plasticity import Plasticity


class FreshOptimiser(Plasticity):
    """Moments and step counts of Adam or RMSprop start at 0 in each task."""

    needs_boundaries = True

    @override
    def at_boundary(self) -> None:
        self.agent.clear_optimiser_state(self.agent.trainable)
