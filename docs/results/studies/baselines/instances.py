"""What instances of images change for agents that learn each goal alone, and what other agents with memory solve."""

from __future__ import annotations

from studies.raw import groups, read, table

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


def instances_change() -> str:
    """A line for each agent: the least and the largest change of the mean return by instances over all goals."""
    by_way, rows = [changes(way) for way in ("greedy", "sampled")], []
    for agent in dict.fromkeys(line["agent"] for line in read(INSTANCES)):
        each = [[found[key] for key in found if key[2] == agent] for found in by_way]
        spans = (f"{min(of):+.2f} to {max(of):+.2f}".replace("-0.00", "+0.00") for of in each)
        rows.append([agent, str(len(each[0])), *spans])
    return table(["agent", "goals", "change greedily", "change sampled"], rows)
