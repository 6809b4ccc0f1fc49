"""Mask shared: modulating masks whose scores are combined with those received from other learners.

The masks of MOSAIC (Nath et al. 2025, arXiv 2506.05577), on those of Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.methods.parts.masks import Masks, zero_betas
from baselines.methods.parts.weights import flat
from ctgraph_rl.checks import NamedValues, at_least_one, require
from ctgraph_rl.tasks.kinds.task_like import most_actions


class MaskShared(Masks):
    """`Masks` whose scores are a linear combination of own scores and of c that were received.

    Each weight tensor l has s = sum_i a_i s_i + a_own s_own, where a is the softmax of c + 1 trained numbers b_l; the
    received scores s_i are fixed. New received scores replace the earlier ones (`receive`). Without an exchange this is
    `Masks` with random scores for each task.

    Stored are 4 P bytes more for each of the c received scores.

    Args:
        max_received: largest number c.
        backbone_seed: see `Masks`.
    """

    stackable = False

    received: Tensor  # s_i, float32 [r, P] with r >= c; those after the first c have a share of 0; b is [l, most c + 1]

    def __init__(self, max_received: int, backbone_seed: int | None = None) -> None:
        super().__init__(backbone_seed)
        require(*at_least_one(max_received=max_received))
        self.max_received = max_received

    @override
    def setup(self) -> None:
        self.num_actions = most_actions(self.curriculum.examples)
        self.betas = zero_betas(self.weights, self.max_received + 1)
        self._keep(torch.zeros(0, len(self.weights), dtype=torch.float32, device="cpu"))
        super().setup()

    @property
    @override
    def trainable(self) -> list[nn.Parameter]:
        return [*self.own, self.betas]

    @override
    def current_scores(self) -> Sequence[Tensor]:
        if not len(self.received):
            return super().current_scores()
        return self.combine(self.received)

    @override
    @torch.no_grad()
    def start_task(self, task: int | None) -> None:
        self._keep(self.received[:0])
        super().start_task(task)

    @override
    @torch.no_grad()
    def end_task(self) -> None:
        super().end_task()
        self._keep(self.received[:0])

    @torch.no_grad()
    def receive(self, scores: Tensor, own_share: float) -> None:
        """Combine with other scores in place of earlier ones; the own scores become the present combination.

        Args:
            scores: float32 [c, P], 1 <= c <= `max_received`.
            own_share: initial share of the own scores, in (0, 1); the others have equal ones.
        """
        count = len(scores)
        self.set_scores(self.weights.split(flat(self.current_scores())))
        self._keep(scores.to(self.constant))
        self.betas.zero_()
        self.betas[:, :count] = math.log((1 - own_share) / count)
        self.betas[:, count] = math.log(own_share)
        self._write()
        self.agent.weights_changed()

    def _keep(self, scores: Tensor) -> None:
        count = len(scores)
        room = 2 ** (count - 1).bit_length() if count and self.agent.compiled_step is not None else count
        excluded = room - count
        self.num_received = count
        self.received = torch.cat([scores, scores.new_zeros(excluded, scores.shape[1])]) if excluded else scores
        self.set_places([*range(count), *[0] * excluded, count], excluded, scores.device)

    @override
    def get_extra_state(self) -> NamedValues:
        return {**super().get_extra_state(), "received": self.received[: self.num_received].clone()}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        super().set_extra_state(state)
        self._keep(state["received"].to(self.constant))
