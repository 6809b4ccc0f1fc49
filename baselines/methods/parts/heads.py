"""Output layers for each task on a trunk that all tasks share."""

from __future__ import annotations

import torch
from torch import Tensor
from typing_extensions import override

from baselines.methods.method import TaskMethod
from ctgraph_rl.checks import require


class Heads(TaskMethod):
    """Each task has separate last linear layers of policy and critic, at first the new agent's.

    Stored are their weights, 4 H bytes for each of the curriculum's tasks.
    """

    agent_members = (*TaskMethod.agent_members, "clear_optimiser_state")

    kept: Tensor  # float32 [tasks, H]

    @override
    def setup(self) -> None:
        super().setup()
        self.in_heads = self.weights.in_heads
        message = f"{type(self.agent).__name__} has no output layers behind a trunk, so tasks cannot have their own"
        require((bool(self.in_heads.any()), f"{message}: take a method that shares them, as some do with heads=single"))
        self.register_buffer("kept", self.weights.vector().detach()[self.in_heads].repeat(self.num_tasks, 1))

    @override
    def num_kept(self) -> int:
        return int(self.weights.in_heads.sum())

    @torch.no_grad()
    def start_task(self, task: int | None) -> None:
        """Load the task's output layers, and clear their optimiser state."""
        super().start_task(task)
        in_heads = self.in_heads.to(self.kept.device)
        weights = self.weights.vector()
        weights[in_heads] = self.kept[self.slot]
        self.weights.write(weights)
        self.agent.clear_optimiser_state(self.weights.in_head_parameters)
        self.agent.weights_changed()

    @override
    @torch.no_grad()
    def end_task(self) -> None:
        self.kept[self.slot] = self.weights.vector()[self.in_heads.to(self.kept.device)]

    def slot_of(self, task: int) -> int:
        """Return the slot of a task's output layers; before it starts, a free one with the new agent's."""
        unseen = task not in self.started and len(self.started) < self.num_tasks
        return len(self.started) if unseen else super().slot_of(task)

    @override
    @torch.no_grad()
    def task_weights(self, task: int) -> Tensor | None:
        return self.present_with(task, self.in_heads, self.kept)
