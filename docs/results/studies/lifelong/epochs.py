"""The published comparison with 8 epochs of PPO, as its settings name, beside the runs with one, as its code takes."""

from __future__ import annotations

from studies.lifelong import comparison
from studies.lifelong.experiments import MASKS, expected
from studies.raw import Raw, groups, mean_of, read, table

COLUMNS = ("tasks learned", "known at the end")


def eight(name: str) -> str:
    """The name of the raw results with 8 epochs."""
    return f"epochs/{name}"


def by_epochs(name: str) -> str:
    """A line for each method: how many tasks it learned, and knows at the end, with 8 epochs and with one."""
    with_eight, with_one = (groups(read(each), "method") for each in (eight(name), name))
    of = {"8 epochs": with_eight, "1 epoch": with_one}
    heads = ["", *(f"{column}, {epochs}" for column in COLUMNS for epochs in of)]
    rows = [
        [f"`{method}`", *(_cell(of[epochs][method,], column) for column in COLUMNS for epochs in of)]
        for method in expected(name)["method"]
    ]
    return table(heads, rows)


def _cell(lines: Raw, column: str) -> str:
    runs = list(groups(lines, "seed").values())
    values = [comparison.scores(run)[column] for run in runs]
    return f"{mean_of(values, comparison.bounds(column, runs[0]))} (n = {len(runs)})"


def tables() -> dict[str, str]:
    """What the template of the page names."""
    return {f"{name}_epochs": by_epochs(name) for name in MASKS}
