"""PackNet: each task gets a share of the network's weights, which then stay fixed.

Mallya and Lazebnik 2018 (CVPR, arXiv 1711.05769).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from typing_extensions import override

from baselines.methods.method import TaskMethod
from baselines.methods.parts.heads import Heads
from baselines.methods.parts.weights import flat, write_flat
from ctgraph_rl.checks import is_real, require

FREE = -1


class PackNet(TaskMethod):
    """In each block the free weights are trained, the smallest pruned, and the rest trained further and kept.

    The k-th of K tasks keeps the largest 1 / (K - k + 1) of each matrix's free weights; pruned ones are 0 and free for
    later tasks. A task acts with the weights of the tasks up to it. Biases are the first task's; each task has separate
    output layers (`Heads`), which are all that a returning task trains.

    Stored are the output layers and, of each weight, its owner (2 P bytes), whether it may change and is in use (2 P),
    and its value (4 P).

    Args:
        retrain: share of a block's frames, at its end, that is trained after pruning, in [0, 1).
    """

    may_recycle = False
    acts_on_batches = stackable = of_one_seed = True
    agent_members = Heads.agent_members
    reads_tasks = "the frames of each block"
    counts = ("block", "frames")

    owner: Tensor  # int16 [P]: the slot of the task that keeps a weight, or FREE
    packed: Tensor  # float32 [P]: kept weights
    live: Tensor  # bool [P]: weights that may change
    mine: Tensor  # bool [P]: kept weights that the present task acts with

    def __init__(self, retrain: float) -> None:
        super().__init__()
        ok = is_real(retrain, 0, 1) and retrain < 1
        require((ok, f"retrain must be a number in [0, 1), got {retrain!r}"))
        self.retrain = retrain
        self.heads = Heads()

    @override
    def setup(self) -> None:
        super().setup()
        self.heads.begin(self.agent, self.weights, self.curriculum)
        self.budgets = [block.num_frames for block in self.curriculum.blocks]
        self.block = -1
        self.frames = 0
        self.register_buffer("owner", self.weights.zeros(torch.int16) + FREE)
        self.register_buffer("packed", self.weights.zeros())
        self.register_buffer("live", ~self.weights.zeros(torch.bool))
        self.register_buffer("mine", self.weights.zeros(torch.bool))
        self.in_matrices = self.weights.in_matrices & ~self.weights.in_heads
        self.in_heads = self.weights.in_heads

    @override
    def num_kept(self) -> int:
        return 0  # beside the output layers

    @torch.no_grad()
    @override
    def start_task(self, task: int | None) -> None:
        new = task not in self.started
        super().start_task(task)
        self.heads.start_task(task)
        self.block = self.block + 1
        self.frames = 0
        first = new and self.slot == 0
        free = (self.owner == FREE) & new & (self._on_device(self.in_matrices) | first)
        self.live.copy_(free | self._on_device(self.in_heads))
        self.mine.copy_(self._kept_up_to(self.slot))
        self._load()
        self.agent.clear_optimiser_state(self.weights.parameters)

    @torch.no_grad()
    @override
    def end_task(self) -> None:
        self._prune()
        self.packed.copy_(torch.where(self.owner == self.slot, self.weights.vector(), self.packed))
        self.heads.end_task()

    def on_batch(self, batch: TensorDictBase) -> None:
        """Prune before the first batch in the share for retraining, but not before the block's first."""
        budget = self.budgets[self.block % len(self.budgets)]
        if self.frames and self.frames + batch.numel() > (1 - self.retrain) * budget:
            self._prune()
        self.frames += batch.numel()

    @override
    def transform_gradients(self, gradients: Sequence[Tensor], weights: Sequence[Tensor]) -> Sequence[Tensor]:
        live = self.weights.split(self.live)
        return [gradient * part.view_as(gradient) for gradient, part in zip(gradients, live, strict=True)]

    @torch.no_grad()
    @override
    def after_step(self, weights: Sequence[Tensor]) -> None:
        fixed = torch.where(self.mine, self.packed, 0.0)
        write_flat(torch.where(self.live, flat(weights), fixed), weights)

    @torch.no_grad()
    @override
    def task_weights(self, task: int) -> Tensor | None:
        slot = self.other_slot(task)
        if slot is None:
            return None
        weights = torch.where(self._kept_up_to(slot), self.packed, 0.0)
        weights[self._on_device(self.in_heads)] = self.heads.kept[slot]
        return weights

    @torch.no_grad()
    def _prune(self) -> None:
        trained = self.live & ~self._on_device(self.in_heads) & (self.owner == FREE)
        if not trained.any():
            return
        weights = self.weights.vector()
        kept = torch.zeros_like(self.live)
        share = 1 / (self.num_tasks - self.slot)
        parts = [self.weights.split(each) for each in (weights, trained, kept)]
        for parameter, values, free, keep in zip(self.weights.parameters, *parts, strict=True):
            count = int(free.sum())
            most = count if parameter.ndim < 2 else round(share * count)
            keep[values.abs().masked_fill(~free, -1.0).topk(most).indices] = True
        self.owner[kept] = self.slot
        self.live.copy_(kept | self._on_device(self.in_heads))
        self._load()

    def _load(self) -> None:
        self.after_step(self.weights.parameters)
        self.agent.weights_changed()

    def _kept_up_to(self, slot: int) -> Tensor:
        return (self.owner >= 0) & (self.owner <= slot)

    def _on_device(self, chosen: Tensor) -> Tensor:
        return chosen.to(self.owner.device)
