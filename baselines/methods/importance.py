"""What methods share that hold the weights near those of earlier tasks, each as firmly as it was important."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from baselines.learner import one_of
from baselines.methods.heads import Heads
from baselines.methods.method import Method, blocks_of_several
from baselines.methods.weights import Weights, flat
from baselines.networks import Data
from ctgraph_rl.checks import at_least_one, positive, require
from ctgraph_rl.tasks.curriculum import Curriculum

if TYPE_CHECKING:
    from baselines.learner import Learner


class Importance(Method):
    """Adds coeff * sum_i I_i (w_i - a_i)^2 to the losses: I is how important weights were, a where they were.

    Stored are I, a and which weights are held, 12 P bytes in all, whatever the number of tasks; where each task has
    output layers of its own also those, see `Heads`.

    Args:
        coeff: weight of what is added.
        heads: ``single``: all tasks share the output layers, whose weights are held, too; ``multi``: each task has its
            own, which are not held; ``auto``: multi where the curriculum tells task ids and each block has one task,
            else single.
    """

    without_ids = ", or method.heads=single"

    importance: Tensor  # float32 [P]
    anchor: Tensor  # float32 [P]
    held: Tensor  # float32 [P]: 1 where weights are held, 0 in output layers of a task's own

    def __init__(self, coeff: float, heads: str) -> None:
        super().__init__()
        require(*positive(coeff=coeff), *one_of(("auto", "single", "multi"), heads=heads))
        self.coeff, self.wanted = coeff, heads
        self.needs_task_id = heads == "multi"
        self.heads: Heads | None = None

    def put_on(self, agent: Learner, weights: Weights, curriculum: Curriculum) -> None:
        """See `Method`."""
        super().put_on(agent, weights, curriculum)
        self.register_buffer("importance", torch.zeros(len(weights)))
        self.register_buffer("anchor", torch.zeros(len(weights)))
        told = curriculum.protocol.task_id != "hidden" and not blocks_of_several(curriculum)
        if self.wanted == "multi" or (self.wanted == "auto" and told):
            self.heads = Heads()
            self.heads.put_on(agent, weights, curriculum)
        self.register_buffer("held", torch.ones(len(weights)) if self.heads is None else 1.0 - weights.in_heads.float())

    def start_task(self, task: int | None) -> None:
        """Go to the task's output layers."""
        if self.heads is not None:
            self.heads.start_task(task)

    @torch.no_grad()
    def end_task(self) -> None:
        """Weigh up what the task needs."""
        with torch.enable_grad():
            new = self.task_importance()
        self.remember(new * self.held, self.weights.vector())
        if self.heads is not None:
            self.heads.end_task()

    def task_importance(self) -> Tensor:
        """How important the weights are for the task that ends, float32 [P], each >= 0."""
        raise NotImplementedError

    def remember(self, new: Tensor, weights: Tensor) -> None:
        """Sum importances up, and hold the weights where they are now."""
        self.importance += new
        self.anchor.copy_(weights)

    def loss(self, batch: Data) -> dict[str, Tensor]:
        """What is lost by moving away."""
        gap = self.weights.vector() - self.anchor
        return {"loss_method": self.coeff * (self.importance * gap.square()).sum()}

    def weights_of(self, task: int) -> Tensor | None:
        """The present weights with the task's own output layers."""
        return None if self.heads is None else self.heads.weights_of(task)


def num_learnt(data: Data) -> int:
    """Frames that are learned from; sequences of recurrent Q-learners have others, too."""
    return data["action"].numel() if "learnt" not in data else int(data["learnt"].sum())


def of_learnt(outputs: Tensor, data: Data) -> Tensor:
    """The outputs of the steps that are learned from, [steps, n], of those of all, [..., n]."""
    return outputs.flatten(0, -2) if "learnt" not in data else outputs[data["learnt"]]


class Samples:
    """The last minibatches that were learned from, of at least so many frames in all; each batch's first pass alone.

    Args:
        num_frames: frames.
    """

    def __init__(self, num_frames: int) -> None:
        require(*at_least_one(num_samples=num_frames))
        self.num_frames, self.held = num_frames, 0
        self.due = math.inf
        """Frames of the present batch that are still to be taken."""

        self.minibatches: deque[dict[Any, Tensor]] = deque()

    def add(self, minibatch: Data) -> None:
        """Take a minibatch in, and drop those that are not needed any more."""
        size = num_learnt(minibatch)
        if self.due <= 0:
            return
        self.due -= size
        self.held += size
        self.minibatches.append({key: value.clone() for key, value in minibatch.items()})  # not a whole pass
        while self.held - (first := num_learnt(self.minibatches[0])) >= self.num_frames:
            self.minibatches.popleft()
            self.held -= first

    def clear(self) -> None:
        """Drop all."""
        self.minibatches.clear()
        self.held = 0

    def items(self) -> Iterator[dict[Any, Tensor]]:
        """The items of the minibatches one by one, [1, ...], the latest first, until there are enough frames."""
        frames = 0
        for minibatch in reversed(self.minibatches):
            for number in range(len(minibatch["action"])):
                if frames >= self.num_frames:
                    return
                item = {key: value[number : number + 1] for key, value in minibatch.items()}
                frames += num_learnt(item)
                yield item

    def state(self) -> dict[str, Any]:
        """Plain values for a state dict."""
        alike = groupby(self.minibatches, lambda minibatch: minibatch["action"].shape[1:])  # steps of a sequence
        return {"parts": [_joined(list(minibatches)) for _, minibatches in alike]}

    def restore(self, state: Mapping[str, Any], device: torch.device) -> None:
        """Go back to what `state` gave."""
        self.clear()
        for part in state.get("parts", [state]):  # one alone, as once saved
            split = {key: value.to(device).split(part["sizes"]) for key, value in part["items"].items()}
            self.minibatches += [dict(zip(split, values, strict=True)) for values in zip(*split.values(), strict=True)]
        self.held = sum(map(num_learnt, self.minibatches))


def _joined(minibatches: Sequence[dict[Any, Tensor]]) -> dict[str, Any]:
    """Minibatches of items of one shape as one, with their sizes."""
    items = {key: torch.cat([minibatch[key] for minibatch in minibatches]) for key in minibatches[0]}
    return {"sizes": [len(minibatch["action"]) for minibatch in minibatches], "items": items}


class SampledImportance(Importance):
    """`Importance` that is a mean over what was learned from last.

    Until a task ends, the last of its minibatches are stored, too, of at least ``num_samples`` frames in all.

    Args:
        num_samples: frames.
        settings: the arguments of `Importance`.
    """

    def __init__(self, num_samples: int, **settings: Any) -> None:
        super().__init__(**settings)
        self.samples = Samples(num_samples)

    def see(self, batch: TensorDictBase) -> None:
        """So many frames are to be kept."""
        self.samples.due = self.agent.num_learnt(batch)

    def mixed(self, batch: Data) -> Data:
        """The minibatch itself, which is kept for the end of the task."""
        self.samples.add(batch)
        return batch

    def end_task(self) -> None:
        """Weigh up what the task needs; a later task's is a matter of its own samples."""
        super().end_task()
        self.samples.clear()

    def mean(self, terms: Callable[[dict[Any, Tensor]], Iterator[Tensor]]) -> Tensor:
        """The sum of the terms of every sample, [P] each, over the number of frames."""
        total, frames = torch.zeros_like(self.importance), 0
        for item in self.samples.items():
            for term in terms(item):
                total += term
            frames += num_learnt(item)
        return total / max(frames, 1)

    def gradient(self, value: Tensor) -> Tensor:
        """The gradient of a number by the weights, [P]; the number's graph is kept."""
        return flat(torch.autograd.grad(value, self.weights.parameters, retain_graph=True, materialize_grads=True))

    def get_extra_state(self) -> dict[str, Any]:
        """The samples."""
        return {"samples": self.samples.state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` gave."""
        self.samples.restore(state["samples"], self.weights.device)
