"""What a lifelong-learning method is: a few hooks around the learning of an agent.

`baselines.learner.Learner` calls them at every gradient step, `baselines.methods.wearing.Wearing` at task changes. A
method knows the network's weights as one vector and the losses by name; it knows no agent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from tensordict import TensorDictBase
from torch import Tensor, nn

from baselines.networks import Data
from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import require
from ctgraph_rl.tasks.curriculum import Curriculum

if TYPE_CHECKING:
    from baselines.learner import Learner
    from baselines.methods.weights import Weights


class Method(nn.Module):
    """No method: the agent is fine-tuned on one task after the other. Other methods derive from this one.

    Buffers and parameters of a method are part of the agent's state.
    """

    needs_task_id: bool = False
    """Whether it must be told which task it is in, while learning and while acting."""

    without_ids = ""
    """What else can be done where ids are hidden, for the message that refuses them."""

    needs_boundaries: ClassVar[bool] = True
    """Whether it must be told when the task changes."""

    agent: Learner
    weights: Weights

    def __init__(self) -> None:  # a module takes any arguments, a method those that it names
        super().__init__()

    def prepare(self, curriculum: Curriculum) -> Curriculum:
        """What is learned in place of a curriculum: mostly the same.

        Raises:
            ValueError: if the curriculum does not tell what the method needs to know.
        """
        told, name, several = curriculum.protocol, type(self).__name__, blocks_of_several(curriculum)
        require(
            (
                not self.needs_task_id or told.task_id != "hidden",
                f"{name} needs task ids, which are hidden: "
                f"set protocol.task_id=one_hot or at_boundaries{self.without_ids}",
            ),
            (
                not self.needs_boundaries or told.boundaries == "announced",
                f"{name} needs to be told when the task changes: set protocol.boundaries=announced",
            ),
            (
                not (self.needs_task_id and several),
                f"{name} needs blocks of one task each, and blocks {several} have several",
            ),
        )
        return curriculum

    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        """An agent with this method for a curriculum.

        Raises:
            ValueError: if the two cannot go together.
        """
        from baselines.methods.wearing import wear  # which knows learners, which know methods

        return wear(agent, self, curriculum)

    def put_on(self, agent: Learner, weights: Weights, curriculum: Curriculum) -> None:
        """Called once, before anything is learned.

        Raises:
            ValueError: if the two cannot go together.
        """
        object.__setattr__(self, "agent", agent)  # the method is part of the agent, not the other way round
        self.weights = weights

    def start_task(self, task: int | None) -> None:
        """Called where a task begins, with its id where it is told."""

    def end_task(self) -> None:
        """Called where a task ends."""

    def see(self, batch: TensorDictBase) -> None:
        """Called with each batch, [num_envs, num_steps], before the agent learns from it."""

    def mixed(self, batch: Data) -> Data:
        """What a gradient step learns from in place of a minibatch."""
        return batch

    def loss(self, batch: Data) -> dict[str, Tensor]:
        """What is added to the agent's losses, as scalars named ``loss_*``."""
        return {}

    def gradients(self, gradients: Sequence[Tensor]) -> Sequence[Tensor]:
        """The gradients of what the optimiser changes, from those of the weights."""
        return gradients

    def settle(self) -> None:
        """Called after each step of the optimiser."""

    def weights_of(self, task: int) -> Tensor | None:
        """The weights to act with in a task, float32 [P]; None: as they are."""
        return None


def blocks_of_several(curriculum: Curriculum) -> list[int]:
    """The numbers of the blocks with several tasks, from 1."""
    return [number for number, block in enumerate(curriculum.blocks, 1) if len(set(block.tasks)) > 1]


class TaskMethod(Method):
    """A method that keeps something for each task; its places are taken in the order in which the tasks begin.

    A task that has not begun is acted in as the first one is.
    """

    needs_task_id = True

    def __init__(self) -> None:
        super().__init__()
        self.begun: list[int] = []
        """The ids of the tasks that have begun."""

        self.place = 0
        """That of the present task."""

    def put_on(self, agent: Learner, weights: Weights, curriculum: Curriculum) -> None:
        """See `Method`."""
        super().put_on(agent, weights, curriculum)
        self.num_tasks = len(curriculum.tasks)

    def start_task(self, task: int | None) -> None:
        """Go to the task's place."""
        name = type(self).__name__
        if task is None:
            raise ValueError(f"{name} needs the id of the task that begins: blocks of one task, with ids that are told")
        if task not in self.begun:
            message = f"there is room for {self.num_tasks} tasks, got another, {task}"
            require((len(self.begun) < self.num_tasks, message))
            self.begun.append(task)
        self.place = self.begun.index(task)

    def place_of(self, task: int) -> int:
        """Where what is kept for a task is."""
        return self.begun.index(task) if task in self.begun else 0

    def get_extra_state(self) -> dict[str, Any]:
        """Who has which place."""
        return {"begun": list(self.begun), "place": self.place}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` gave."""
        self.begun, self.place = list(state["begun"]), state["place"]
