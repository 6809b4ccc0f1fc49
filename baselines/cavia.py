"""CAVIA: a few context inputs adapt to a task, and the weights of the policy are learned for all tasks.

Zintgraf et al. 2019, "Fast context adaptation via meta-learning" (arXiv 1810.03642):

    phi_i = phi_0 - alpha grad_phi L_i(theta, phi_0) with phi_0 = 0,    minimise over theta the mean of the outer losses
                                                                        of (theta, phi_i),

with L_i on the first episodes of trial i and the outer loss on the others (`baselines.parts.inner_loop`). phi is joined
to the observation. Without context inputs it learns one policy for all tasks.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor
from torch.func import functional_call
from typing_extensions import override

from baselines.parts.inner_loop import InnerLoop, InnerLoopSettings, InnerModel, NamedWeights
from baselines.parts.networks import Data
from ctgraph_rl.checks import is_int, require


class Context(InnerModel):
    """The context inputs of the network adapt, its last ones."""

    @override
    def start(self, theta: NamedWeights) -> NamedWeights:
        like = next(iter(theta.values()))
        return {"context": like.new_zeros(self.num_context)}

    @override
    def logits(self, theta: NamedWeights, own: NamedWeights, steps: Data) -> Tensor:
        context = own["context"].expand(*steps["observation"].shape[: -self.net.event_dims], -1)
        return functional_call(self.net, theta, (*(steps[key] for key in self.keys), context))


@dataclass(frozen=True, kw_only=True)
class CAVIASettings(InnerLoopSettings):
    """The settings of `CAVIA`."""

    num_context: int  # context inputs; 0: nothing adapts

    def __post_init__(self) -> None:
        super().__post_init__()
        require((is_int(self.num_context, 0), f"num_context must be an integer >= 0, got {self.num_context!r}"))


class CAVIA(InnerLoop):
    """A policy of which a context adapts."""

    Settings = CAVIASettings
    Model = Context
    solves = "tasks whose goal is drawn from several: it adapts a context after some episodes"

    @property
    @override
    def num_context(self) -> int:
        return self.settings.num_context
