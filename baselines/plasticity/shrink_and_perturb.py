"""Shrink and perturb: the weights shrink, and a share of new weights is added.

Ash and Adams 2020 (NeurIPS, arXiv 1910.08475).
"""

from __future__ import annotations

from typing_extensions import override

from baselines.parts.networks import Data, TensorsByName
from baselines.plasticity.plasticity import Plasticity
from ctgraph_rl.checks import fraction, one_of, require, true_or_false


class ShrinkAndPerturb(Plasticity):
    """w <- shrink w + perturb w', with w' drawn each time as at construction.

    A target network follows at its next copy.

    Args:
        shrink: in [0, 1].
        perturb: in [0, 1].
        every: ``boundary``, or ``step``: after each gradient step, where task changes need not be announced.
        reset_moments: also set the optimiser's moments to 0.
    """

    recycles = True

    def __init__(self, shrink: float, perturb: float, every: str, reset_moments: bool) -> None:
        super().__init__()
        require(
            *fraction(shrink=shrink, perturb=perturb),
            *one_of(("boundary", "step"), every=every),
            *true_or_false(reset_moments=reset_moments),
        )
        self.shrink = shrink
        self.perturb = perturb
        self.every = every
        self.reset_moments = reset_moments
        self.needs_boundaries = self.stackable = every == "boundary"

    @override
    def at_boundary(self) -> None:
        if self.every == "boundary":
            self._blend()

    @override
    def after_step(self, batch: Data, measured: TensorsByName) -> TensorsByName:
        if self.every == "step":
            self._blend()
        return measured

    def _blend(self) -> None:
        with self.rewriting():
            for parameter, drawn in self.draw_weights().items():
                parameter.mul_(self.shrink).add_(drawn, alpha=self.perturb)
                if self.reset_moments:
                    self.clear_moments(parameter)
