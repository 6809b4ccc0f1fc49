"""Masks without labels on the three task-free curricula: the table of no_labels.md."""

from __future__ import annotations

from statistics import fmean

from studies.no_labels.learners import LEARNERS, by_learner, returns, share
from studies.raw import Raw, mean_of, numbers_in, table

NAME = "task_free"


def row(curriculum: str, name: str, lines: Raw) -> list[str]:
    """Return the cells of a learner on a curriculum."""
    shown = [f"`{curriculum}`", LEARNERS[name], str(len(lines))]
    shown += [mean_of(*returns(lines, column)) for column in ("average_performance", "online_return")]
    if name == "none":
        return [*shown, "", "", ""]
    delays = [each for line in lines for each in line["delays"].split()]
    if delays:
        shown.append(f"{len(delays) - delays.count('-')} of {len(delays)}")
        shown.append(f"{fmean(numbers_in(lines, 'labels_per_task')):.2f}")
    else:
        shown += ["no point of change", "undefined"]
    lost = [share(lines, column) for column in ("frames_not_learned", "frames_rolled_back")]
    return [*shown, "; ".join(f"{100 * each:.0f} %" for each in lost)]


def results() -> str:
    """Return the table: a line for each curriculum and learner."""
    head = ["", "", "seeds", "average performance", "online return", "changes found", "labels per task"]
    rows = []
    for (curriculum,), of in by_learner(NAME, "curriculum").items():
        rows += [row(curriculum, name, lines) for name, lines in of.items()]
    return table([*head, "not learned from; undone"], rows)
