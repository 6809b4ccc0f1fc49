"""MaskSC: modulating masks that combine the most similar tasks, or those that an oracle names.

After facts about the public repository DMIU-ShELL/MaskSC (2026), without its code. There is no paper with a public
text.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from typing_extensions import override

from baselines.methods.parts.selection import SelectedMasks
from ctgraph_rl.checks import at_least_one, is_real, one_of, require
from ctgraph_rl.tasks.task import Task, ct_graphs

SELECTIONS = ("similarity", "random", "none", "all", "parent", "depth_prefix")

ORACLES = ("all", "parent", "depth_prefix")
"""Selected from a task's start; the last two read the curriculum, which a learner does not know."""


class MaskSC(SelectedMasks):
    """`SelectedMasks` with the most similar tasks: a cosine of embeddings above a threshold, and the highest of those.

    Other selections are references. ``all`` is Mask LC and ``none`` is Mask RI, bit by bit; ``random`` draws ``top_k``
    earlier tasks at each selection. An oracle knows images and goals: ``depth_prefix`` are all earlier tasks with the
    same images whose goal is the beginning of this one's, ``parent`` is the last of them.

    Our choices: the embedding is AMSC's moving average, and the first selection is after ``every`` batches.

    Args:
        selection: one of `SELECTIONS`.
        threshold: the cosine must be larger, in [-1, 1].
        top_k: most tasks that are selected.
        settings: arguments of `SelectedMasks`.
    """

    def __init__(self, selection: str, threshold: float, top_k: int, **settings: Any) -> None:
        super().__init__(**settings)
        require(
            *one_of(SELECTIONS, selection=selection),
            *at_least_one(top_k=top_k),
            (is_real(threshold, -1, 1), f"threshold must be a number in [-1, 1], got {threshold!r}"),
        )
        self.selection = selection
        self.threshold = threshold
        self.top_k = top_k
        self.compares = selection == "similarity"
        self.reads_tasks = "the tasks' goals and images" if selection in ORACLES else ""

    @override
    def setup(self) -> None:
        super().setup()
        if self.selection in ORACLES[1:]:
            ct_graphs(self.curriculum.examples, f"selection={self.selection}")

    @override
    def start_task(self, task: int | None) -> None:
        super().start_task(task)
        if self.num_combined and self.selection in ORACLES:
            self.select(self.choose())

    @override
    def choose(self) -> list[int]:
        earlier = list(range(self.num_combined))
        if self.selection == "similarity":
            known = self.embeddings
            if self.slot not in known:
                return []
            near = {}
            for slot in range(self.num_combined):
                if slot in known:
                    cosine = float(known[slot] @ known[self.slot])
                    if cosine > self.threshold:
                        near[slot] = cosine
            return sorted(near, key=lambda slot: -near[slot])[: self.top_k]
        if self.selection == "random":
            order = torch.randperm(self.num_combined, generator=self.generator, device="cpu")
            return order[: self.top_k].tolist()
        if self.selection == "all":
            return earlier
        if self.selection == "none":
            return []
        tasks = ct_graphs([self.task_in(slot) for slot in (*earlier, self.slot)], self.selection)
        family = [slot for slot in earlier if is_prefix(tasks[slot], tasks[-1])]
        return family if self.selection == "depth_prefix" else family[-1:]


def is_prefix(one: Task, other: Task) -> bool:
    """Return whether a task has another's images, as many as it needs, and a goal on the way to the other's."""
    alike = _without_number(one.images) == _without_number(other.images)
    return alike and one.goal == other.goal[: len(one.goal)] and len(one.goal) < len(other.goal)


def _without_number(images: Any) -> Any:
    number = getattr(images, "__dataclass_fields__", {}).get("num_images")
    return replace(images, num_images=1) if number is not None and number.init else images
