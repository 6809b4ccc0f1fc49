"""The page memory.md and its figures."""

from __future__ import annotations

from pathlib import Path

from studies.memory import figures, graphs
from studies.memory.conditions import LADDER, NAME
from studies.raw import fill, machines


def page() -> str:
    """Return the page; its template has the counts of seeds, which tests compare with the raw results."""
    lower, undecided = graphs.lower_and_undecided()
    texts = {"totals": graphs.total_table(), "claim": graphs.claim_table(), "lower": lower, "undecided": undecided}
    return fill("memory", texts | {"machines": machines(NAME, LADDER)})


def draw(folder: Path) -> None:
    """Draw the figures."""
    figures.draw_returns(folder / "memory.png")
    figures.draw_ladder(folder / "memory_ladder.png")
