"""The base classes of methods that hold weights near those of earlier tasks, by their importance."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from typing_extensions import override

from baselines.methods.method import Method
from baselines.methods.parts.heads import Heads
from baselines.methods.parts.weights import flat
from baselines.parts.networks import Data, Items, TensorsByName
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, at_least_one, one_of, positive, require


class Importance(Method):
    """Adds coeff * sum_i I_i (w_i - a_i)^2 to the losses: I are importances, a the weights of earlier tasks.

    Stored are I, a and which weights are held, 12 P bytes in all, whatever the number of tasks; and the output layers
    of multi-head networks (`Heads`).

    Args:
        coeff: weight of the penalty.
        heads: ``single``: all tasks share the output layers, which are held; ``multi``: each task has separate ones,
            not held; ``auto``: multi where the protocol gives task ids and each block has one task, else single.
    """

    hidden_ids_hint = ", or method.heads=single"

    importance: Tensor  # float32 [P]
    anchor: Tensor  # float32 [P]
    held: Tensor  # float32 [P]: 1 where weights are held, 0 in output layers of a task's own

    def __init__(self, coeff: float, heads: str) -> None:
        super().__init__()
        require(*positive(coeff=coeff), *one_of(("auto", "single", "multi"), heads=heads))
        self.coeff = coeff
        self.heads_setting = heads
        self.needs_task_id = heads == "multi"
        self.heads: Heads | None = None
        if heads != "single":
            self.agent_members = tuple(dict.fromkeys((*self.agent_members, *Heads.agent_members)))

    @override
    def setup(self) -> None:
        self.register_buffer("importance", self.weights.zeros())
        self.register_buffer("anchor", self.weights.zeros())
        ids = self.curriculum.protocol.task_id != "hidden" and not self.curriculum.blocks_of_several
        if self.heads_setting == "multi" or (self.heads_setting == "auto" and ids):
            self.heads = Heads()
            self.heads.max_labels = self.max_labels
            self.heads.begin(self.agent, self.weights, self.curriculum)
        in_heads = self.weights.zeros() if self.heads is None else self.weights.in_heads.float()
        self.register_buffer("held", 1.0 - in_heads)

    @override
    def start_task(self, task: int | None) -> None:
        if self.heads is not None:
            self.heads.start_task(task)

    @override
    @torch.no_grad()
    def end_task(self) -> None:
        with torch.enable_grad():
            new = self.task_importance()
        self.consolidate(new * self.held, self.weights.vector())
        if self.heads is not None:
            self.heads.end_task()

    def task_importance(self) -> Tensor:
        """Return the weights' importance for the ending task, float32 [P], each >= 0."""
        raise NotImplementedError

    def consolidate(self, new: Tensor, weights: Tensor) -> None:
        """Add new importances, and hold the weights near their present values."""
        self.importance += new
        self.anchor.copy_(weights)

    @override
    def penalties(self, batch: Data, weights: Sequence[Tensor]) -> TensorsByName:
        gap = flat(weights) - self.anchor
        return {"loss_method": self.coeff * (self.importance * gap.square()).sum()}

    def task_weights(self, task: int) -> Tensor | None:
        """Return the present weights with the task's output layers."""
        return None if self.heads is None else self.heads.task_weights(task)


def num_learnt(data: Data) -> int:
    """Return how many frames are learned from, which excludes some of recurrent Q-learners' sequences."""
    return data["action"].numel() if "learnt" not in data else int(data["learnt"].sum())


def learnt_steps(outputs: Tensor, data: Data) -> Tensor:
    """Select the outputs of the steps that are learned from, [steps, n], from all, [..., n]."""
    return outputs.flatten(0, -2) if "learnt" not in data else outputs[data["learnt"]]


class Samples:
    """The last minibatches of the first pass over each batch.

    Args:
        num_frames: least number of their frames.
    """

    def __init__(self, num_frames: int) -> None:
        require(*at_least_one(num_samples=num_frames))
        self.num_frames = num_frames
        self.num_held = 0
        self.remaining = math.inf
        """Frames still to come in the present batch's first pass."""

        self.minibatches: deque[Items] = deque()

    def add(self, minibatch: Data) -> None:
        """Add a minibatch of the first pass, and drop old ones."""
        size = num_learnt(minibatch)
        if self.remaining <= 0:
            return
        self.remaining -= size
        self.num_held += size
        self.minibatches.append({key: value.clone() for key, value in minibatch.items()})  # not a whole pass
        while self.num_held - (first := num_learnt(self.minibatches[0])) >= self.num_frames:
            self.minibatches.popleft()
            self.num_held -= first

    def clear(self) -> None:
        """Drop all minibatches."""
        self.minibatches.clear()
        self.num_held = 0

    def items(self) -> Iterator[Items]:
        """Yield single items, [1, ...], the latest first, until there are enough frames."""
        frames = 0
        for minibatch in reversed(self.minibatches):
            for number in range(len(minibatch["action"])):
                if frames >= self.num_frames:
                    return
                item = {key: value[number : number + 1] for key, value in minibatch.items()}
                frames += num_learnt(item)
                yield item

    def state(self) -> NamedValues:
        """Return a state of plain values."""
        alike = groupby(self.minibatches, lambda minibatch: (minibatch["action"].shape[1:], [*minibatch]))
        return {"parts": [_joined(list(minibatches)) for _, minibatches in alike]}

    def restore(self, state: ReadOnlyValues, device: torch.device) -> None:
        """Restore what `state` returned."""
        self.clear()
        for part in state["parts"]:
            split = {key: value.to(device).split(part["sizes"]) for key, value in part["items"].items()}
            self.minibatches += [dict(zip(split, values, strict=True)) for values in zip(*split.values(), strict=True)]
        self.num_held = sum(map(num_learnt, self.minibatches))


def _joined(minibatches: Sequence[Items]) -> NamedValues:
    items = {key: torch.cat([minibatch[key] for minibatch in minibatches]) for key in minibatches[0]}
    return {"sizes": [len(minibatch["action"]) for minibatch in minibatches], "items": items}


class SampledImportance(Importance):
    """`Importance` that is a mean over the last learned frames.

    Until a task ends, its last minibatches are stored.

    Args:
        num_samples: least number of these frames.
        settings: arguments of `Importance`.
    """

    agent_members = (*Importance.agent_members, "num_learnt")

    def __init__(self, num_samples: int, **settings: Any) -> None:
        super().__init__(**settings)
        self.samples = Samples(num_samples)

    @override
    def on_batch(self, batch: TensorDictBase) -> None:
        self.samples.remaining = self.agent.num_learnt(batch)

    @override
    def transform_minibatch(self, batch: Data) -> Data:
        self.samples.add(batch)
        return batch

    @override
    def end_task(self) -> None:
        super().end_task()
        self.samples.clear()

    def mean(self, terms: Callable[[Items], Iterator[Tensor]]) -> Tensor:
        """Return the sum of all samples' terms, [P] each, by the number of frames."""
        total = torch.zeros_like(self.importance)
        frames = 0
        for item in self.samples.items():
            for term in terms(item):
                total += term
            frames += num_learnt(item)
        return total / max(frames, 1)

    def gradient(self, value: Tensor) -> Tensor:
        """Return the gradient of a scalar by the weights, [P]; its graph is retained."""
        return flat(torch.autograd.grad(value, self.weights.parameters, retain_graph=True, materialize_grads=True))

    @override
    def get_extra_state(self) -> NamedValues:
        return {"samples": self.samples.state()}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        self.samples.restore(state["samples"], self.weights.device)
