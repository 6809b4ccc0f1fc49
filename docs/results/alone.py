"""What instances of images change for agents that learn each goal alone, and what other agents with memory solve."""

from __future__ import annotations

from raw import Raw, groups, read, table

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


def memory_verdict() -> str:
    """Return for each of the other agents with memory how many seeds solve each goal that was run."""
    if not read(MEMORY):
        return "No agent has five seeds yet."
    words = []
    for (agent,), lines in groups(read(MEMORY), "agent").items():
        each = groups(lines, "configuration", "task").items()
        parts = [
            f"goal {goal} of CT-{name.upper().replace('_', '-')} in {num_solved(cell)}" for (name, goal), cell in each
        ]
        words.append(f"`{agent}` solves {', '.join(parts)}")
    return "; ".join(words) + " seeds (a greedy success of at least 0.9)."


def num_solved(lines: Raw) -> str:
    """Return how many seeds have a greedy success of at least 0.9, such as ``4 of 5``."""
    return f"{sum(float(line['greedy_success']) >= 0.9 for line in lines)} of {len(lines)}"
