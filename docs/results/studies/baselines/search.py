"""Success in each episode of a trial, which has one goal."""

from __future__ import annotations

from studies.raw import Raw

NAME = "rl2_search"

SOLVED = 0.95
"""Share of the last episodes of trials that reach the goal, from which on a seed has learned to search."""


def searching(lines: Raw) -> list[bool]:
    """Return for each seed whether it finds the goal by the last episode of a trial."""
    last = max(int(line["episode"]) for line in lines)
    return [float(line["greedy_success"]) >= SOLVED for line in lines if int(line["episode"]) == last]
