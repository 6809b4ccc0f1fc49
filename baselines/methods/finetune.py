"""Fine-tuning: no method, the lower reference of forgetting."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from typing_extensions import override

from baselines.methods.method import Method
from baselines.methods.parts.weights import flat, write_flat
from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import one_of, require
from ctgraph_rl.tasks.curriculum import Curriculum


class Unchanged(Method):
    """A method that does nothing: what tells an agent's plasticity when tasks start."""

    stackable = True
    needs_boundaries = False


class Finetune(Method):
    """The agent learns one task after the other; nothing is stored while the trunk is trained.

    Args:
        trunk: "trained", or "kept": after the first task, whose weights are stored, only the output layers learn. This
            measures whether features of the first block serve later tasks.

    Raises:
        ValueError: for another trunk.
    """

    needs_boundaries = False

    learned: Tensor
    kept: Tensor
    in_heads: Tensor

    def __init__(self, trunk: str = "trained") -> None:
        super().__init__()
        require(*one_of(("trained", "kept"), trunk=trunk))
        self.trunk = trunk
        self.needs_boundaries = trunk == "kept"
        self.may_recycle = trunk == "trained"

    @override
    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        if self.trunk == "kept":
            return super().attach(agent, curriculum)
        plasticity = getattr(agent, "plasticity", None)
        return Unchanged().attach(agent, curriculum) if getattr(plasticity, "needs_starts", False) else agent

    @override
    def setup(self) -> None:
        self.register_buffer("learned", torch.zeros((), dtype=torch.bool, device="cpu"))
        self.register_buffer("kept", self.weights.zeros())
        self.register_buffer("in_heads", self.weights.in_heads)

    @override
    def end_task(self) -> None:
        if not self.learned:
            self.kept.copy_(self.weights.vector().detach())
            self.learned.fill_(True)

    @override
    @torch.no_grad()
    def after_step(self, weights: Sequence[Tensor]) -> None:
        write_flat(torch.where(self.in_heads | ~self.learned, flat(weights), self.kept), weights)
