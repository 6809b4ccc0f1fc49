"""The base class of detectors of task changes."""

from __future__ import annotations

from baselines.detectors.judge import Judge
from baselines.methods.parts.self_labelled import SelfLabelled
from ctgraph_rl.agent import MethodLike


class Detector(Judge):
    """Labels the tasks of a method; a class that derives from it defines `observe`. Arguments are those of `Judge`."""

    def labelling(self, method: MethodLike) -> SelfLabelled:
        """Return a method that labels tasks by this detector; see `ctgraph_rl.agent.DetectorLike`."""
        return SelfLabelled(method, self)
