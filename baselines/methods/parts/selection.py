"""The base class of masks that combine selected earlier tasks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import normalize
from typing_extensions import override

from baselines.methods.mask_lc import MaskLC
from baselines.parts.embedding import (
    linear_wasserstein,
    reference_points,
    sampled_points,
    sliced_wasserstein,
    unit_directions,
    with_last,
)
from ctgraph_rl.checks import NamedValues, at_least_one, one_of, require
from ctgraph_rl.tasks.kinds.task_like import TaskLike, most_actions

EMBEDDINGS = ("lwe", "swe")

STREAM = 0x5E1EC7


def own_generator(stream: int = STREAM) -> torch.Generator:
    """Return a generator whose stream depends on torch's global seed, without a draw from that."""
    return torch.Generator(device="cpu").manual_seed((torch.initial_seed() ^ stream << 32) % 2**63)


class SelectedMasks(MaskLC):
    """`MaskLC` that combines the new scores with those of selected earlier tasks; the others have a share of 0.

    s = sum_i a_i s_i + a_k s_k over the selected tasks i, where a is the softmax of their b and the new scores' b. A
    task that is not selected keeps its b. A task starts with none selected.

    Each task has an embedding z. After each batch ``num_samples`` of the task's last ``buffer_size`` transitions are
    drawn without replacement, and embedded in a direction e: z <- norm(z / 2 + e / 2), e at first.

    Beside what `MaskLC` stores: copies of the selected tasks' scores, 4 P bytes each; an embedding of each task, 4 M n
    bytes (``lwe``, n = pixels + actions + 1) or 4 L Q (``swe``); the last transitions.

    Args:
        every: batches between two selections.
        embedding: ``lwe``, linear Wasserstein, or ``swe``, sliced Wasserstein.
        num_samples: N.
        buffer_size: stored transitions; at least N.
        num_references: M, of ``lwe``.
        num_directions: L, of ``swe``.
        num_quantiles: Q, along each direction, of ``swe``.
    """

    stackable = False

    compares = True
    community: Tensor  # scores of the selected tasks, and of others with a share of 0, float32 [n, P]

    def __init__(
        self,
        every: int,
        embedding: str,
        num_samples: int,
        buffer_size: int,
        num_references: int,
        num_directions: int,
        num_quantiles: int,
    ) -> None:
        super().__init__()
        require(
            *at_least_one(every=every, num_samples=num_samples, num_references=num_references),
            *at_least_one(buffer_size=buffer_size, num_directions=num_directions, num_quantiles=num_quantiles),
            *one_of(EMBEDDINGS, embedding=embedding),
        )
        message = f"buffer_size must be at least num_samples={num_samples}, or no task is embedded, got {buffer_size}"
        require((buffer_size >= num_samples, message))
        self.every = every
        self.embedding = embedding
        self.num_samples = num_samples
        self.buffer_size = buffer_size
        self.num_references = num_references
        self.num_directions = num_directions
        self.num_quantiles = num_quantiles
        self.embeddings: dict[int, Tensor] = {}
        """Of norm 1, by slot, float32 [Z]."""

        self.recent: dict[str, Tensor] = {}
        """The present task's last transitions, [n, ...] each."""

        self.selected: list[int] = []
        self.num_batches = 0

    @override
    def setup(self) -> None:
        self.ids = self.curriculum.protocol.ids(len(self.curriculum.tasks))
        self.num_actions = most_actions(self.curriculum.examples)
        super().setup()
        self.generator = own_generator()
        for name in ("community", "places", "offsets"):
            self.register_buffer(name, torch.zeros(0, dtype=torch.float32, device="cpu"), persistent=False)

    def task_in(self, slot: int) -> TaskLike:
        """Return the task of a slot."""
        return self.curriculum.tasks[self.ids.index(self.started[slot])]

    @override
    def num_kept(self) -> int:
        if not self.compares:
            return super().num_kept()
        width = math.prod(self.curriculum.examples[0].observation_shape) + self.num_actions + 1
        size = self.num_references * width if self.embedding == "lwe" else self.num_directions * self.num_quantiles
        return super().num_kept() + size

    def choose(self) -> list[int]:
        """Return the slots of the tasks to select, among the first `num_combined`."""
        raise NotImplementedError

    @override
    def start_task(self, task: int | None) -> None:
        super().start_task(task)
        self.num_batches = 0
        self.recent = {}

    @override
    def init_scores(self) -> None:
        super().init_scores()
        self._gather([])

    @override
    def on_batch(self, batch: TensorDictBase) -> None:
        if self.compares:
            self.recent = with_last(self.recent, batch, self.buffer_size)

    @override
    @torch.no_grad()
    def after_learning(self) -> None:
        if self.compares and len(self.recent["action"]) >= self.num_samples:
            points = sampled_points(self.recent, self.num_samples, self.num_actions, self.generator)
            width = points.shape[1]
            if self.embedding == "lwe":
                found = linear_wasserstein(points, reference_points(self.num_references, width))
            else:
                found = sliced_wasserstein(points, unit_directions(self.num_directions, width), self.num_quantiles)
            new = normalize(found, dim=0)
            old = self.embeddings.get(self.slot, new)
            self.embeddings[self.slot] = normalize((old + new) / 2, dim=0)
        self.num_batches += 1
        if self.num_combined and self.num_batches % self.every == 0:
            self.select(self.choose())

    @torch.no_grad()
    def select(self, slots: Sequence[int]) -> None:
        """Combine the new scores with those of these tasks from now on."""
        if sorted(slots) != self.selected:
            self._gather(sorted(slots))
            self._write()
            self.agent.weights_changed()

    @override
    def current_scores(self) -> Sequence[Tensor]:
        if not self.num_combined:
            return list(self.own)
        return self.combine(self.community)

    def _gather(self, slots: list[int]) -> None:
        room = 4
        while room < len(slots):
            room *= 4
        others = [slot for slot in range(self.num_combined) if slot not in slots]
        filled = [*slots, *others][:room]
        self.selected = list(slots)
        self.community = self.scores[filled]
        self.set_places([*filled, self.slot], len(filled) - len(slots), self.scores.device)

    @override
    def get_extra_state(self) -> NamedValues:
        counts = {"selected": self.selected, "num_batches": self.num_batches, "random": self.generator.get_state()}
        embeddings = {"of_slot": dict(self.embeddings), "recent": dict(self.recent)}
        return {**super().get_extra_state(), **counts, "embeddings": embeddings}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        super().set_extra_state(state)
        self.num_batches = state["num_batches"]
        self.generator.set_state(state["random"].cpu())
        self.embeddings = {slot: value.cpu() for slot, value in state["embeddings"]["of_slot"].items()}
        self.recent = {key: value.cpu() for key, value in state["embeddings"]["recent"].items()}
        self._gather(list(state["selected"]))
