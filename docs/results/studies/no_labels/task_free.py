"""Masks without labels on the three task-free curricula: raw results and the table of no_labels.md."""

from __future__ import annotations

from statistics import mean

from studies.no_labels.learners import LEARNERS, learner, values
from studies.raw import Raw, groups, mean_of, read, table

NAME = "task_free"

PLANNED = {
    "task_free_abrupt": ("oracle", "adwin", "none"),
    "task_free_gradual": ("adwin", "none"),
    "task_free_recurring": ("oracle", "adwin", "none"),
}
"""Curricula and learners of the experiment; the oracle refuses gradual changes."""

SEEDS = 3


def cells() -> dict[tuple[str, str], Raw]:
    """Return the lines of each curriculum and learner with all seeds."""
    of = groups(read(NAME), "curriculum")
    found: dict[tuple[str, str], Raw] = {}
    for curriculum, names in PLANNED.items():
        for name in names:
            own = [line for line in of.get((curriculum,), []) if learner(line) == name]
            if len(own) == SEEDS:
                found[curriculum, name] = own
    return found


def row(curriculum: str, name: str, lines: Raw) -> list[str]:
    """Return the cells of a learner on a curriculum."""
    bounds = (float(lines[0]["lowest_return"]), float(lines[0]["highest_return"]))
    returns = [mean_of(values(lines, key), bounds) for key in ("average_performance", "online_return")]
    shown = [f"`{curriculum}`", LEARNERS[name], str(len(lines)), *returns]
    if not lines[0]["detector"]:
        return [*shown, "", "", ""]
    delays = [each for line in lines for each in line["delays"].split()]
    found = f"{sum(each != '-' for each in delays)} of {len(delays)}" if delays else "no point of change"
    per_task = "undefined" if not delays else f"{mean(values(lines, 'labels_per_task')):.2f}"
    return [*shown, found, per_task, not_learned(lines)]


def not_learned(lines: Raw) -> str:
    """Return the shares of frames that were not learned from, and of those whose learning was undone."""
    frames = sum(values(lines, "frames"))
    shares = [sum(values(lines, key)) / frames for key in ("frames_not_learned", "frames_rolled_back")]
    return "; ".join(f"{100 * share:.0f} %" for share in shares)


def results() -> str:
    """Return the table: a line for each curriculum and learner that has run."""
    head = ["", "", "seeds", "average performance", "online return", "changes found", "labels per task"]
    rows = [row(curriculum, name, lines) for (curriculum, name), lines in cells().items()]
    return table([*head, "not learned from; undone"], rows)
