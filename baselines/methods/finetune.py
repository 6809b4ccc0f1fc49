"""Fine-tuning: no method, the lower reference of forgetting."""

from __future__ import annotations

from baselines.methods.method import Method
from ctgraph_rl.agent import Agent
from ctgraph_rl.tasks.curriculum import Curriculum


class Finetune(Method):
    """The agent learns one task after the other, unchanged. Nothing is stored, and any agent will do."""

    needs_boundaries = False

    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        """Return the agent itself."""
        return agent
