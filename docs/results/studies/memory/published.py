"""MOHQA with its published settings on a confounding graph: raw results, and what memory.md says of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from studies.memory.runs import measured, solved, solved_once
from studies.raw import lines_of_runs, numbers_in, read, write

NAME = "mohqa_published"


def collect(name: str, folders: Sequence[Path]) -> None:
    """Write the table of the finished runs under some folders."""
    write(name, lines_of_runs(folders, lambda run: [measured(run)]))


def text() -> str:
    """Return the greedy returns after training, and how many seeds solve the task then and at any evaluation."""
    lines = read(NAME)
    returns = " and ".join(f"{value:.2f}" for value in numbers_in(lines, "greedy_return"))
    after = f"{sum(solved(lines))} of {len(lines)} seeds solve it"
    return f"{returns} ({after}, {sum(solved_once(lines))} at any evaluation)"
