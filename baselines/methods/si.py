"""SI: synaptic intelligence; weights are important if their changes made the loss fall.

Zenke et al. 2017 (ICML, arXiv 1703.04200), eqs. (3) to (5).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from baselines.methods.parts.importance import Importance
from baselines.methods.parts.weights import flat
from ctgraph_rl.checks import positive, require


class SI(Importance):
    """Adds c * sum_i O_i (w_i - a_i)^2, O_i = sum over tasks of max(0, v_i) / (d_i^2 + xi).

    v_i is the sum over gradient steps of -(d loss / d w_i) times the change of w_i, with the gradient of the agent's
    own losses and a plasticity's; d_i is the change of w_i in these steps over the task; a are the weights at the end
    of the last task.

    Beside those of `Importance`, v, the weights at the task's start and two vectors of a step are stored: 28 P bytes in
    all.

    Args:
        epsilon: xi, which is added to the divisor.
        settings: the arguments of `Importance`; ``coeff`` is the paper's c.
    """

    stackable = of_one_seed = True
    step_buffers = ("path", "before", "slope")

    path: Tensor  # v, float32 [P]
    start: Tensor  # weights at the start of the task, float32 [P]
    before: Tensor  # weights before a step, float32 [P]
    slope: Tensor  # gradient of a step, float32 [P]

    def __init__(self, epsilon: float, **settings: Any) -> None:
        super().__init__(**settings)
        require(*positive(epsilon=epsilon))
        self.epsilon = epsilon

    @override
    def setup(self) -> None:
        super().setup()
        for name in ("path", "start", "before", "slope"):
            self.register_buffer(name, self.weights.zeros())

    @override
    @torch.no_grad()
    def start_task(self, task: int | None) -> None:
        super().start_task(task)
        self.path.zero_()
        self.start.copy_(self.weights.vector())

    @torch.no_grad()
    def transform_gradients(self, gradients: Sequence[Tensor], weights: Sequence[Tensor]) -> Sequence[Tensor]:
        """Return the gradients, and store the part of the agent's losses."""
        self.before.copy_(flat(weights))
        added = 2 * self.coeff * self.importance * (self.before - self.anchor)
        self.slope.copy_(flat(gradients) - added)
        return gradients

    @override
    @torch.no_grad()
    def after_step(self, weights: Sequence[Tensor]) -> None:
        self.path -= self.slope * (flat(weights) - self.before)

    @override
    def weights_rewritten(self, change: Tensor) -> None:
        self.start += change

    @override
    def task_importance(self) -> Tensor:
        return self.path.clamp(min=0) / ((self.weights.vector().detach() - self.start).square() + self.epsilon)
