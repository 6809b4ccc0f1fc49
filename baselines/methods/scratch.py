"""Scratch: a fresh network for each task, the reference without any transfer."""

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


class Scratch(TaskMethod):
    """Each task has a network of its own, drawn anew; its optimiser starts anew, too.

    Stored are 4 P bytes for each of the curriculum's tasks. Nothing is forgotten and nothing is transferred.
    """

    kept: Tensor  # float32 [tasks, P]

    def put_on(self, agent: Learner, weights: Weights, curriculum: Curriculum) -> None:
        """See `Method`."""
        super().put_on(agent, weights, curriculum)
        layers = [(name, each) for name, each in agent.policy.named_modules() if list(each.parameters(recurse=False))]
        fixed = [name or type(layer).__name__ for name, layer in layers if not hasattr(layer, "reset_parameters")]
        require((not fixed, f"Scratch draws weights anew by reset_parameters, which {', '.join(fixed)} lack: add it"))
        self.register_buffer("kept", torch.zeros(self.num_tasks, len(weights)))

    def start_task(self, task: int | None) -> None:
        """Go to the task's network; that of the first is the one the agent began with."""
        first, known = not self.begun, task in self.begun
        super().start_task(task)
        if known:
            self.weights.write(self.kept[self.place])
        elif not first:
            self.agent.draw_weights()
        self.agent.forget(self.weights.parameters)
        self.agent.weights_changed()

    def end_task(self) -> None:
        """Keep the task's network."""
        self.kept[self.place] = self.weights.vector().detach()

    def weights_of(self, task: int) -> Tensor | None:
        """The task's network."""
        place = self.place_of(task)
        return None if not self.begun or place == self.place else self.kept[place]
