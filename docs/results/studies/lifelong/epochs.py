"""The published comparison with 8 epochs of PPO, as its settings name, beside the runs with one, as its code takes."""

from __future__ import annotations

from studies.lifelong import comparison
from studies.lifelong.experiments import MASKS, expected
from studies.raw import Raw, groups, mean_of, read, table

COLUMNS = ("tasks learned", "known at the end")
CURRICULA = ("CT8 multi-depth, of 8", "CT8, of 8", "CT12, of 12")
"""Heads of the columns, in the order of `MASKS`."""


def eight(name: str) -> str:
    """The name of the raw results with 8 epochs."""
    return f"epochs/{name}"


def with_eight() -> str:
    """A line for each method, a column for each curriculum: tasks learned, and known at the end, with 8 epochs."""
    rows = []
    for method in expected(MASKS[0])["method"]:
        rows.append([f"`{method}`", *(_cell(groups(read(eight(name)), "method")[method,]) for name in MASKS)])
    return table(["", *CURRICULA], rows)


def _cell(lines: Raw) -> str:
    runs = list(groups(lines, "seed").values())
    found = [comparison.scores(run) for run in runs]
    bounds = [comparison.bounds(column, runs[0]) for column in COLUMNS]
    means = zip(COLUMNS, bounds, strict=True)
    return "; ".join(mean_of([scores[column] for scores in found], ends) for column, ends in means)


def tables() -> dict[str, str]:
    """What the template of the page names."""
    return {"eight_epochs": with_eight()}
