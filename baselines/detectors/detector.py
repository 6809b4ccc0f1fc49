"""The base class of detectors of task changes."""

from __future__ import annotations

from baselines.detectors.judge import Judge
from baselines.methods.parts.self_labelled import SelfLabelled
from ctgraph_rl.agent import MethodLike


class Detector(Judge):
    """Labels the tasks of a method; subclasses define `observe`. Arguments as in `Judge`."""

    def labelling(self, method: MethodLike) -> SelfLabelled:
        """Return a method that labels tasks by this detector, as `ctgraph_rl.agent.DetectorLike`."""
        return SelfLabelled(method, self)
