"""Masks that select on ct28: raw results, and the section of collectives.md that is made of them."""

from __future__ import annotations

from studies.raw import groups, mean_of, read, table

NAME, SEEDS, NUM_TASKS, HIGH, LAST = "selecting", 5, 28, 0.9, 5

METHODS = {"mask_amsc": "AMSC", "mask_lc": "Mask LC", "cka_rl": "CKA-RL", "mask_ri": "Mask RI", "finetune": "PPO"}
"""Methods and their names, in the order of the page."""


DEPTHS = range(2, 9)


def tasks_learned(method: str, column: str = "evaluated", depth: int | None = None) -> list[int]:
    """Return for each seed how many tasks had a greedy return of `HIGH` in a column, or those of one depth."""
    lines = [line for line in read(NAME) if line["method"] == method]
    return [
        sum(float(line[column]) >= HIGH for line in run if depth is None or _depth(line) == depth)
        for run in groups(lines, "seed").values()
    ]


def _depth(line: dict[str, str]) -> int:
    return 1 + line["task"].split("-")[0].count(".")


def tasks_table() -> str:
    """Return how many tasks each method learns and keeps."""
    head = ["method", "seeds", "tasks learned of 28", "tasks solved after the last block"]
    head += [f"depth {depth}" for depth in DEPTHS]
    rows = []
    for method, name in METHODS.items():
        learned, kept = tasks_learned(method), tasks_learned(method, "kept")
        if learned:
            cells = [mean_of([float(each) for each in of], (0, NUM_TASKS)) for of in (learned, kept)]
            by_depth = [tasks_learned(method, depth=depth) for depth in DEPTHS]
            means = [f"{sum(each) / len(each):.1f}" for each in by_depth]
            rows.append([name, str(len(learned)), *cells, *means])
    return table(head, rows)


def texts() -> dict[str, str]:
    """Return what the page's template names."""
    found = {"selecting": tasks_table()}
    for method in METHODS:
        counts = sorted(tasks_learned(method))
        found[f"learned_{method}"] = f"{counts[0]} to {counts[-1]}" if counts[0] < counts[-1] else str(counts[0])
    return found
