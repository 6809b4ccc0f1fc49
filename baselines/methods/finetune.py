"""Fine-tuning: no method, the lower reference of forgetting."""

from __future__ import annotations

from baselines.methods.method import Method
from ctgraph_rl.agent import Agent
from ctgraph_rl.tasks.curriculum import Curriculum


class Finetune(Method):
    """The agent as it is goes from task to task. Nothing is stored; it goes with any agent."""

    needs_boundaries = False

    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        """The agent itself."""
        return agent
