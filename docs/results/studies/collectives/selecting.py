"""Masks that select on ct28: the last section of collectives.md."""

from __future__ import annotations

from statistics import fmean

from studies.raw import groups, mean_of, numbers_in, read, select, table

NAME, NUM_TASKS, HIGH = "selecting", 28, 0.9

METHODS = {"mask_amsc": "AMSC", "mask_lc": "Mask LC", "cka_rl": "CKA-RL", "mask_ri": "Mask RI", "finetune": "PPO"}
"""Methods and their names, in the order of the page."""

DEPTHS = range(2, 9)


def tasks_learned(method: str, column: str = "evaluated", depths: range = DEPTHS) -> list[int]:
    """Return for each seed how many tasks of some depths had a greedy return of `HIGH` in a column."""
    found = []
    for run in groups(select(read(NAME), method=method), "seed").values():
        own = [line for line in run if 1 + line["task"].split("-")[0].count(".") in depths]
        found.append(sum(value >= HIGH for value in numbers_in(own, column)))
    return found


def texts() -> dict[str, str]:
    """Return what the page's template names: how many tasks each method learns and keeps."""
    head = ["method", "seeds", "tasks learned of 28", "tasks solved after the last block"]
    head += [f"depth {depth}" for depth in DEPTHS]
    rows = []
    found = {}
    for method, name in METHODS.items():
        learned = tasks_learned(method)
        cells = [mean_of(counts, (0, NUM_TASKS)) for counts in (learned, tasks_learned(method, "kept"))]
        means = [f"{fmean(tasks_learned(method, depths=range(depth, depth + 1))):.1f}" for depth in DEPTHS]
        rows.append([name, str(len(learned)), *cells, *means])
        least, most = min(learned), max(learned)
        found[f"learned_{method}"] = f"{least} to {most}" if least < most else str(least)
    return found | {"selecting": table(head, rows)}
