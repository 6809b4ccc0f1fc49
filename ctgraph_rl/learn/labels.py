"""Labels that a learner gives to tasks itself, and which one stands for a task in evaluation."""

from __future__ import annotations

import math
from typing import NamedTuple

from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.metrics.labels import most_frequent
from ctgraph_rl.tasks.curriculum import Curriculum


def task_labels(log: RunLog, curriculum: Curriculum) -> dict[int, int]:
    """Return the label that acted in most frames of each task so far, by the task's position.

    Tasks of a block share its frames equally. Only evaluation uses this, as an oracle; the learner does not see it.
    """
    acted, blocks, ends = (log.training(name).tolist() for name in ("acted_label", "block", "frames"))
    starts = [0.0, *ends]
    parts = []
    for label, block, end, start in zip(acted, blocks, ends, starts, strict=False):
        if not math.isnan(label):
            trained = curriculum.trained[int(block) - 1]
            for task in trained:
                parts.append((task, int(label) - 1, (end - start) / len(trained)))
    return most_frequent(*zip(*parts, strict=True)) if parts else {}


class Span(NamedTuple):
    """Frames of a run in which one label acted."""

    start: float
    end: float
    label: int  # from 1
    learned: bool
    alarm: bool  # at its end


def label_spans(log: RunLog) -> tuple[Span, ...]:
    """Return the label spans of a run in time order; empty unless the learner labels tasks."""
    spans: list[Span] = []
    for m in log.of_kind("training"):
        if m.get("acted_label") is None:
            return ()
        start = spans[-1].end if spans else 0
        own = Span(start, m["frames"], int(m["acted_label"]), bool(m.get("learned")), bool(m.get("alarm")))
        if spans and spans[-1][2:] == (own.label, own.learned, False):
            own = own._replace(start=spans.pop().start)
        spans.append(own)
    return tuple(spans)
