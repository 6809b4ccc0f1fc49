"""The oracle: labels are the true tasks, the upper reference of detectors."""

from __future__ import annotations

from typing_extensions import override

from baselines.detectors.detector import Detector, SelfLabelledAgent
from baselines.detectors.seen import Seen, Verdict
from ctgraph_rl.agent import Agent
from ctgraph_rl.tasks.curriculum import Curriculum


class Oracle(Detector):
    """Knows the curriculum and counts frames: a label is the task's position in ``curriculum.tasks``.

    Where boundaries are announced, a label starts with its block: this is ``protocol.task_id=at_boundaries``, bit for
    bit. Where they are hidden, it starts with the first batch that begins in the block, while rows first end their old
    episodes.

    Args:
        max_labels: most labels; None: one for each task.
    """

    reads = "the true tasks"
    is_oracle = True
    changing = ("frames",)

    def __init__(self, max_labels: int | None = None) -> None:
        super().__init__(max_labels, patience=1, snapshot_every=None)
        self.frames = 0

    @override
    def attach(self, agent: Agent, curriculum: Curriculum) -> SelfLabelledAgent:
        self.curriculum = curriculum
        return super().attach(agent, curriculum)

    def present_label(self) -> int:
        """Return the label of the next frame's task; after the end, that of the last one."""
        block = min(self.curriculum.block_at(self.frames + 1), len(self.curriculum.blocks))
        return self.curriculum.trained[block - 1][0]

    def observe(self, seen: Seen) -> Verdict:
        """Return the label of the task in which the next batch begins; None where boundaries are announced."""
        self.frames += seen.action.numel()
        return None if self.curriculum.protocol.announces else self.present_label()
