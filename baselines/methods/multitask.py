"""Multitask: all tasks at once, the upper reference of forgetting."""

from __future__ import annotations

from dataclasses import replace

from typing_extensions import override

from baselines.methods.method import Method
from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import require
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Block
from ctgraph_rl.tasks.switch import ByEpisode


class Multitask(Method):
    """One block with all tasks and frames replaces the curriculum's; environments change tasks at every episode.

    Nothing is stored or forgotten. Without task ids only tasks that look different can all be solved.
    """

    needs_boundaries = False
    reads_tasks = "all tasks at once"

    def prepare(self, curriculum: Curriculum) -> Curriculum:
        """Return the curriculum of one block.

        Raises:
            ValueError: for a single task, and ids that are given at boundaries.
        """
        super().prepare(curriculum)
        tasks = curriculum.tasks
        require(
            (len(tasks) > 1, "Multitask needs at least two tasks, got one"),
            (
                curriculum.protocol.task_id != "at_boundaries",
                "Multitask has no boundaries to give task ids at: set protocol.task_id=one_hot or hidden",
            ),
        )
        at_once = Block(tuple(tasks), curriculum.num_frames, ByEpisode())
        return replace(curriculum, blocks=(at_once,))

    @override
    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        return agent
