"""The published comparison with 8 epochs of PPO, as its settings name, beside the runs with one, as its code takes."""

from __future__ import annotations

import comparison
from raw import Raw, groups, mean_of, read, table

COLUMNS = ("tasks learned", "known at the end")
RUN_WITH_BOTH = ("masks_ct8_md",)


def eight(name: str) -> str:
    """The name of the raw results with 8 epochs."""
    return f"epochs/{name}"


def by_epochs(name: str) -> str:
    """A line for each method: how many tasks it learned, and knows at the end, with 8 epochs and with one."""
    rows = []
    both = [groups(read(each), "method", "seed") for each in (eight(name), name)]
    for method in comparison.expected(name)["method"]:
        cells = []
        for column in COLUMNS:
            for of in both:
                cells.append(_cell([lines for (who, _), lines in of.items() if who == method], column))
        rows.append([f"`{method}`", *cells])
    return table(["", *(f"{column}, {epochs}" for column in COLUMNS for epochs in ("8 epochs", "1 epoch"))], rows)


def _cell(runs: list[Raw], column: str) -> str:
    values = [comparison.scores(lines)[column] for lines in runs]
    return f"{mean_of(values, comparison.bounds(column, runs[0]))} (n = {len(runs)})"


def tables() -> dict[str, str]:
    """What the template of the page names."""
    return {f"{name}_epochs": by_epochs(name) for name in RUN_WITH_BOTH}
