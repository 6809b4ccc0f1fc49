"""What instances of images change for agents that learn each goal alone, and what other agents with memory solve."""

from __future__ import annotations

from studies.raw import groups, read

INSTANCES, MEMORY = "baselines_b1_instances", "memory_b1"
"""Raw results with noise and rotation on read, and of the other agents with memory."""


def means(name: str, way: str) -> dict[tuple[str, ...], float]:
    """Return the mean return of a table's cells over seeds, by configuration, goal and agent."""
    cells = groups(read(name), "configuration", "task", "agent")
    return {key: sum(float(line[f"{way}_return"]) for line in lines) / len(lines) for key, lines in cells.items()}


def changes(way: str) -> dict[tuple[str, ...], float]:
    """Return by how much instances change the mean return of a cell, by configuration, goal and agent."""
    constant = means("baselines_b1", way)
    return {key: mean - constant[key] for key, mean in means(INSTANCES, way).items()}
