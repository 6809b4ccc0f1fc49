"""Masks that select on ct28: raw results, and the section of collectives.md that is made of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from studies.raw import Raw, groups, machine_of, mean_of, read, table

NAME, SEEDS, NUM_TASKS, HIGH, LAST = "selecting", 5, 28, 0.9, 5

METHODS = {"mask_amsc": "AMSC", "mask_lc": "Mask LC", "cka_rl": "CKA-RL", "mask_ri": "Mask RI", "finetune": "PPO"}
"""Methods and their names, in the order of the page."""

KEY = ("method", "seed")
"""The columns that tell runs apart."""

DEPTHS = range(2, 9)


def measured(folders: Sequence[Path]) -> Raw:
    """Return the lines of the finished runs on ct28 under some folders."""
    logs = [log for folder in folders for log in sorted(folder.rglob("run.jsonl"))]
    return [line for log in logs for line in _measured(log) or ()]


def ordered(lines: Raw) -> Raw:
    """Return lines in the order of the methods, of their seeds and of blocks."""
    order = list(METHODS)
    return sorted(lines, key=lambda line: (order.index(line["method"]), int(line["seed"]), int(line["block"])))


def _measured(path: Path) -> Raw | None:
    """Return a line for each block of a run; None if it is not finished, or not of this experiment."""
    from ctgraph_rl.log.run_log import RunLog

    if not (path.parent / "metrics.json").exists():
        return None
    log = RunLog.read(path)
    about = log.of_kind("run")[0]
    if about["curriculum"].removesuffix(" (modified)") != "ct28":  # in the protocol alone
        return None
    return [_block(log, about, number) for number in range(1, NUM_TASKS + 1)]


def _block(log: Any, about: dict[str, Any], number: int) -> dict[str, Any]:
    """Return what was measured in a block, of its task at its end and at the end of the run."""
    trained = [line for line in log.of_kind("training") if line["block"] == number]
    before = max((line["frames"] for line in log.of_kind("training") if line["block"] < number), default=0)
    [task] = about["trained"][number - 1]
    greedy = [line for line in log.of_kind("evaluation") if line["task"] == task]
    end = trained[-1]["frames"]
    first = next((line["frames"] - before for line in trained if line["return_mean"] >= HIGH), "")
    return {
        "curriculum": "ct28",
        "method": str(about["config"]["method"]["_target_"]).split(".")[-2],  # the module is named like the method
        "seed": about["config"]["seed"],
        "trained_together": len(about.get("together", [0])),
        "block": number,
        "task": greedy[0]["label"],
        "frames_to_learn": first,
        "final_return": round(sum(line["return_mean"] for line in trained[-LAST:]) / LAST, 6),
        "evaluated": next(line["return_mean"] for line in reversed(greedy) if line["frames"] == end),
        "kept": greedy[-1]["return_mean"],
        "num_epochs": about["config"]["agent"]["num_epochs"],
        "numbers": about["numbers"],
        **machine_of(about),
    }


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
    found = {"selecting": tasks_table(), "selecting_missing": _missing()}
    for method in METHODS:
        counts = sorted(tasks_learned(method))
        found[f"learned_{method}"] = f"{counts[0]} to {counts[-1]}" if counts[0] < counts[-1] else str(counts[0])
    return found


def _missing() -> str:
    parts = [
        f"{SEEDS - count} of {SEEDS} seeds of {name}"
        for method, name in METHODS.items()
        if (count := len(tasks_learned(method))) < SEEDS
    ]
    return f"Not run yet: {'; '.join(parts)}." if parts else "All seeds that were planned are here."
