"""Agents whose goal is swapped in the middle of each life: a table of adaptation.md."""

from __future__ import annotations

from statistics import fmean

from studies.raw import groups, mean_of, read, table

NAME = "adaptation_swap"

LABELS = {"penn_a": "PENN-A", "rl2": "RL^2"}

EPISODES = 100
"""Episodes of a life."""


def best_search(goals: int, swapped: bool) -> float:
    """Return the greatest mean share of a life's episodes at the goal, over goals that are drawn uniformly.

    The search tries goals in turn and misses (goals - 1) / 2 episodes in the mean. A swap draws from all goals; where
    the goal is another one, the first miss tells it, and the others are tried in turn.
    """
    misses = (goals - 1) / 2
    if swapped:
        misses += (goals - 1) / goals * (1 + (goals - 2) / 2)
    return 1 - misses / EPISODES


def shares(agent: str, held_out: bool) -> list[float]:
    """Return the share of episodes at the goal of each seed: of lives with a swap, held out, or with one goal."""
    lines = [line for line in read(NAME) if (line["agent"], line["held_out"]) == (agent, str(held_out))]
    return [fmean(float(line["success"]) for line in of) for of in groups(lines, "seed").values()]


def swap_table() -> str:
    """Return a row for each agent: means over seeds with their intervals."""
    frames = {line["agent"]: line["frames"] for line in read(NAME)}
    rows = [
        [
            LABELS[agent],
            str(len(shares(agent, held_out=True))),
            frames[agent],
            mean_of(shares(agent, held_out=False), (0.0, 1.0)),
            mean_of(shares(agent, held_out=True), (0.0, 1.0)),
        ]
        for agent in LABELS
        if agent in frames
    ]
    best = [best_search(goals=4, swapped=swapped) for swapped in (False, True)]
    rows.append(["*best search*", "exact", "-", *(f"{share:.3f}" for share in best)])
    return table(["agent", "seeds", "frames", "one goal", "a goal that is swapped"], rows)
