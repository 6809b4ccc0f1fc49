"""MAML: all weights of a policy adapt to a task by a step of gradient descent, and the start of that step is learned.

Finn et al. 2017, "Model-agnostic meta-learning for fast adaptation of deep networks" (arXiv 1703.03400):

    theta_i = theta - alpha grad_theta L_i(theta),    minimise over theta the mean of the outer losses of theta_i,

with L_i on the first episodes of trial i and the outer loss on the others (`baselines.parts.inner_loop`). The outer
gradient has second derivatives of L_i.
"""

from __future__ import annotations

from torch import Tensor
from torch.func import functional_call
from typing_extensions import override

from baselines.parts.inner_loop import InnerLoop, InnerModel, NamedWeights
from baselines.parts.networks import Data


class AllWeights(InnerModel):
    """Every weight of the network adapts."""

    @override
    def start(self, theta: NamedWeights) -> NamedWeights:
        return theta

    @override
    def logits(self, theta: NamedWeights, own: NamedWeights, steps: Data) -> Tensor:
        return functional_call(self.net, own, tuple(steps[key] for key in self.keys))


class MAML(InnerLoop):
    """A policy of which all weights adapt."""

    Model = AllWeights
    solves = "tasks whose goal is drawn from several: it adapts all weights after some episodes"
