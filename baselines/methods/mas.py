"""MAS: memory aware synapses; weights are important if the network's outputs are sensitive to them.

Aljundi et al. 2018 (ECCV, arXiv 1711.09601), eqs. (2) to (4).
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from typing_extensions import override

from baselines.methods.parts.importance import SampledImportance, learnt_steps
from baselines.parts.networks import Data


class MAS(SampledImportance):
    """Adds coeff * sum_i O_i (w_i - a_i)^2, O_i = sum over tasks of the mean |d |f(s)|^2 / d w_i| over samples.

    f are the network's outputs: log-probabilities and value, or action values; a are the weights at the end of the last
    task.
    """

    stackable = True
    agent_members = (*SampledImportance.agent_members, "outputs", "output_keys")

    @override
    def task_importance(self) -> Tensor:
        return self.mean(self._sensitivity)

    def _sensitivity(self, item: Data) -> Iterator[Tensor]:
        outputs = self.agent.outputs(item)
        joined = torch.cat([outputs[key] for key in self.agent.output_keys], dim=-1)
        for step in learnt_steps(joined, item):
            yield self.gradient(step.square().sum()).abs()
