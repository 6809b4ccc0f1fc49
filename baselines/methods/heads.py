"""Output layers of each task's own on a trunk that all tasks share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from baselines.methods.method import TaskMethod
from baselines.methods.weights import Weights
from ctgraph_rl.checks import require
from ctgraph_rl.tasks.curriculum import Curriculum

if TYPE_CHECKING:
    from baselines.learner import Learner


class Heads(TaskMethod):
    """Each task has its own last linear layers of policy and critic; a new task's are those the agent began with.

    Stored are their weights, 4 H bytes for each of the curriculum's tasks.
    """

    kept: Tensor  # float32 [tasks, H]

    def put_on(self, agent: Learner, weights: Weights, curriculum: Curriculum) -> None:
        """See `Method`."""
        super().put_on(agent, weights, curriculum)
        self.inside = weights.in_heads
        message = f"{type(agent).__name__} has no output layers behind a trunk, so tasks cannot have their own"
        require((bool(self.inside.any()), f"{message}: take a method that shares them, as some do with heads=single"))
        self.register_buffer("kept", weights.vector().detach()[self.inside].repeat(self.num_tasks, 1))

    @torch.no_grad()
    def start_task(self, task: int | None) -> None:
        """Go over to a task's output layers; the optimiser forgets what it knew of the former ones."""
        super().start_task(task)
        inside = self.inside.to(self.kept.device)
        weights = self.weights.vector()
        weights[inside] = self.kept[self.place]
        self.weights.write(weights)
        self.agent.forget(self.weights.in_head_parameters)
        self.agent.weights_changed()

    @torch.no_grad()
    def end_task(self) -> None:
        """Keep the task's."""
        self.kept[self.place] = self.weights.vector()[self.inside.to(self.kept.device)]

    def place_of(self, task: int) -> int:
        """Where a task's output layers are; one that has not begun has those the agent began with, if there is room."""
        unseen = task not in self.begun and len(self.begun) < self.num_tasks
        return len(self.begun) if unseen else super().place_of(task)

    @torch.no_grad()
    def weights_of(self, task: int) -> Tensor | None:
        """The present weights with a task's output layers."""
        place = self.place_of(task)
        if not self.begun or place == self.place:
            return None
        weights = self.weights.vector()
        weights[self.inside.to(weights.device)] = self.kept[place]
        return weights
