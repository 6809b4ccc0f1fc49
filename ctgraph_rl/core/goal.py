"""Goals as people write them: the decisions with a dot between them, ``1.2``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from ctgraph_rl.checks import as_tuple, is_int

Goal = str | float | Sequence[int]
"""``"1.2"``, the number ``1.2`` that yaml makes of it, or ``(1, 2)``."""

_DECISION = r"(?:0|[1-9]\d{0,17})"
_WRITTEN = re.compile(rf"{_DECISION}(?:\.{_DECISION})*", re.ASCII)


def read_goal(goal: object) -> object:
    """Return a goal as a tuple of decisions; anything else unchanged.

    >>> read_goal("1.2"), read_goal(1.2), read_goal([1, 2])
    ((1, 2), (1, 2), (1, 2))
    """
    text = repr(goal) if isinstance(goal, float) or is_int(goal) else goal
    if not isinstance(text, str):
        return as_tuple(goal)
    return tuple(map(int, text.split("."))) if _WRITTEN.fullmatch(text) else goal


def write_goal(decisions: Iterable[int]) -> str:
    """Return decisions as ``1.2``."""
    return ".".join(map(str, decisions))
