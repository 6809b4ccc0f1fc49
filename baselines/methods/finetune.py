"""Fine-tuning: no method, the lower reference of forgetting."""

from __future__ import annotations

from baselines.methods.method import Method


class Finetune(Method):
    """The agent as it is goes from task to task. Nothing is stored."""

    needs_boundaries = False
