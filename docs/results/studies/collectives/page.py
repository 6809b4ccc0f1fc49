"""Learners that share: collectives.md and its figure."""

from __future__ import annotations

from pathlib import Path

from studies.collectives import l2d2c, mosaic, selecting
from studies.raw import fill, machines


def page() -> str:
    """Return the page."""
    texts = l2d2c.texts() | mosaic.texts() | selecting.texts()
    return fill("collectives", texts | {"machines": machines(l2d2c.NAME, selecting.NAME)})


def draw(folder: Path) -> None:
    """Draw the figure."""
    l2d2c.draw(folder / "collectives.png")
