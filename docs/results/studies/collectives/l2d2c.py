"""Blocks and runs of the collectives of l2d2c_16x16, from their tables."""

from __future__ import annotations

from studies.raw import Raw, groups, read

NAME, BLOCKS = "collectives", "collective_blocks"
"""Tables with a line for each collective, and for each member and block."""

CELL = ("curriculum", "frames_of_block", "exchange", "num_members", "num_epochs")
"""The columns that tell the cells of an experiment apart."""

KEY = (*CELL, "seed")

FRAMES = "12800"
"""Of a block."""


def cells() -> dict[tuple[str, ...], Raw]:
    """Lines of collectives by the columns of `CELL`."""
    return groups(read(NAME), *CELL)


def on_l2d2c(num_members: str, frames: str = FRAMES, num_epochs: str = "1") -> Raw:
    """Lines of the collectives of l2d2c_16x16 with as many members."""
    return cells().get(("l2d2c_16x16", frames, "l2d2c", num_members, num_epochs), [])


def new_and_known(num_members: str) -> tuple[Raw, Raw]:
    """Return the blocks whose task no member had in an earlier block, and the others."""
    lines = groups(read(BLOCKS), *CELL)["l2d2c_16x16", FRAMES, "l2d2c", num_members, "1"]
    first: dict[tuple[str, str], int] = {}
    for line in lines:
        key = (line["seed"], line["task"])
        first[key] = min(int(line["block"]), first.get(key, int(line["block"])))
    new: Raw = []
    known: Raw = []
    for line in lines:
        (known if int(line["block"]) > first[line["seed"], line["task"]] else new).append(line)
    return new, known
