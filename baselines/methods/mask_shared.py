"""Mask shared: modulating masks whose scores are combined with those received from other learners.

The masks of MOSAIC (Nath et al. 2025, arXiv 2506.05577), on those of Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from baselines.learner import Learner, make_compiled_step
from baselines.methods.masks import Masks, combined
from baselines.methods.weights import Weights, flat
from ctgraph_rl.checks import at_least_one, require
from ctgraph_rl.tasks.curriculum import Curriculum


class MaskShared(Masks):
    """`Masks` whose scores are a linear combination of own scores and of c that were received.

    Each weight tensor l has s = sum_i a_i s_i + a_own s_own, where a is the softmax of c + 1 trained numbers b_l; the
    received scores s_i are fixed. What is received replaces what was before, of which the own scores keep their share
    (`receive`). Without an exchange nothing is received, and this is `Masks` with random scores for each task.

    Stored are 4 P bytes more for each of the c received scores.

    Args:
        max_received: largest number c.
        backbone_seed: see `Masks`.
    """

    stackable = False

    received: Tensor  # s_i, float32 [c, P]
    betas: nn.Parameter  # b, float32 [weight tensors, max_received + 1]; the last one in use is the own scores'

    def __init__(self, max_received: int, backbone_seed: int | None = None) -> None:
        super().__init__(backbone_seed)
        require(*at_least_one(max_received=max_received))
        self.max_received = max_received

    def setup(self, agent: Learner, weights: Weights, curriculum: Curriculum) -> None:
        """See `Method`."""
        self.num_actions = max(task.graph.branching_factor for task in curriculum.tasks) + 1
        self.betas = nn.Parameter(torch.zeros(len(weights.parameters), self.max_received + 1))
        self.received = torch.zeros(0, len(weights))
        super().setup(agent, weights, curriculum)

    @property
    def trainable(self) -> list[nn.Parameter]:
        """The own scores and the numbers b."""
        return [*self.own, self.betas]

    def current_scores(self) -> Sequence[Tensor]:
        """Compute the combination."""
        count = len(self.received)
        if not count:
            return super().current_scores()
        old = self.weights.split(self.received)
        return list(map(combined, self.betas[:, : count + 1].unbind(0), old, self.own))

    @torch.no_grad()
    def start_task(self, task: int | None) -> None:
        """Start with own scores alone."""
        self.received = self.received[:0]
        super().start_task(task)

    @torch.no_grad()
    def end_task(self) -> None:
        """Store the combination, which the own scores then are."""
        super().end_task()
        self.received = self.received[:0]

    @torch.no_grad()
    def receive(self, scores: Tensor, own_share: float) -> None:
        """Combine with other scores in place of those received before; the own scores become the present combination.

        Args:
            scores: float32 [c, P], 1 <= c <= `max_received`.
            own_share: initial share of the own scores, in (0, 1); the others have equal ones.
        """
        count, changes = len(scores), len(scores) != len(self.received)
        self.set_scores(self.weights.split(flat(self.current_scores())))
        self.received = scores.to(self.constant)
        self.betas.zero_()
        self.betas[:, :count] = math.log((1 - own_share) / count)
        self.betas[:, count] = math.log(own_share)
        if changes and self.agent.compiled_step is not None:
            self.agent.compiled_step = make_compiled_step()  # the other one was made for as many as before
        self._write()
        self.agent.weights_changed()

    def get_extra_state(self) -> dict[str, Any]:
        """Return what `Masks` does, and the received scores."""
        return {**super().get_extra_state(), "received": self.received.clone()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` returned."""
        super().set_extra_state(state)
        self.received = state["received"].to(self.constant)
