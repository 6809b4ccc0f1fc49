"""Scratch: a fresh network for each task, the reference without any transfer."""

from __future__ import annotations

from torch import Tensor
from typing_extensions import override

from baselines.methods.method import TaskMethod
from baselines.methods.parts.weights import require_drawn


class Scratch(TaskMethod):
    """Each task has a separate network with random initial weights, and an optimiser without state.

    Stored are 4 P bytes for each of the curriculum's tasks.
    """

    stackable = True
    agent_members = (*TaskMethod.agent_members, "clear_optimiser_state", "reset_parameters")

    kept: Tensor  # float32 [tasks, P]

    @override
    def setup(self) -> None:
        super().setup()
        require_drawn(self.agent.policy, "Scratch")
        self.register_buffer("kept", self.weights.zeros().repeat(self.num_tasks, 1))

    @override
    def start_task(self, task: int | None) -> None:
        first = not self.started
        known = task in self.started
        super().start_task(task)
        if known:
            self.weights.write(self.kept[self.slot])
        elif not first:
            self.agent.reset_parameters()
        self.agent.clear_optimiser_state(self.weights.parameters)
        self.agent.weights_changed()

    @override
    def end_task(self) -> None:
        self.kept[self.slot] = self.weights.vector().detach()

    @override
    def task_weights(self, task: int) -> Tensor | None:
        slot = self.other_slot(task)
        return None if slot is None else self.kept[slot]
