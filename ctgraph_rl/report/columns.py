"""The metrics that all tables show of a curriculum."""

from __future__ import annotations

from collections.abc import Sequence

from ctgraph_rl import metrics
from ctgraph_rl.log.run_log import tuning_share
from ctgraph_rl.metrics import METRICS, Trained
from ctgraph_rl.metrics.curves import find_returns
from ctgraph_rl.metrics.windows import OF_LIFE
from ctgraph_rl.runs.read import Run, by_curriculum, histories
from ctgraph_rl.tasks.curriculum import Curriculum

IN_ORDER = tuple(metric.__name__ for metric in metrics.SUMMARY)
"""Metrics of tasks that are trained once each, in order."""

TRANSFER = ("forward_transfer", "backward_transfer")

WHERE_KNOWN = (
    "isolated_forgetting",
    *("held_out_adapted_return", "held_out_search_regret"),
    *(metric.__name__ for metric in metrics.AGAINST_EXPERTS),
    *("continual_world_forward_transfer", "forward_transfer_from_experts", "memory_gap_closed"),
)


def columns(trained: Trained, adapts: bool, is_life: bool = False) -> tuple[str, ...]:
    """Return the metrics that a table shows of a curriculum with or without a value.

    Transfer and forgetting need several blocks. Where each trains one task, and each task comes once, they are those of
    `IN_ORDER`; else forgetting is `relative_forgetting`, with `regain` where a task returns.

    Args:
        trained: for each block, its tasks; empty where unknown.
        adapts: whether rows adapt before they are evaluated.
        is_life: whether it is a stream, whose metrics are `OF_LIFE`.
    """
    if is_life:
        return OF_LIFE
    tasks = [task for block in trained for task in set(block)]
    once = len(set(tasks)) == len(tasks) == len(trained)
    names = ["average_performance"]
    if not trained or (once and len(trained) > 1):
        names = [*IN_ORDER]
    elif len(trained) > 1:
        names.append("relative_forgetting")
    if find_returns(trained):
        names.append("regain")
    if adapts:
        names += ["adapted_return", "search_regret"]
    return tuple(names)


def board_columns(curriculum: Curriculum) -> list[str]:
    """Return `columns` without transfer and times, whose means leave out what never ended."""
    shown = columns(curriculum.trained, curriculum.evaluation.adapt_episodes > 0)
    return [name for name in shown if name not in TRANSFER and not METRICS[name].is_time]


def columns_of_runs(runs: Sequence[Run]) -> dict[str, tuple[str, ...]]:
    """Return `columns` of each curriculum, by its name in tables."""
    found = {}
    for name, some in by_curriculum(runs).items():
        known = histories(some)
        trained = max((history.trained for history in known), key=len, default=())
        is_life = any("life" in run.about for run in some)
        found[name] = columns(trained, any(history.adaptation for history in known), is_life)
    return found


def objective(run: Run) -> str | None:
    """Return the objective of a tuning run, all that a table shows of it; None for another run."""
    if tuning_share(run.about) is None:
        return None
    name = run.about["config"].get("objective")
    return name if isinstance(name, str) else "online_return"


def caveats(run: Run) -> dict[str, str]:
    """Return what a reader of a run's metrics must know, by the metric: a sentence where one is needed."""
    known = {name: metric["value"] for name, metric in run.metrics.items()}
    found = {}
    learned = known.get("tasks_learned")
    tasks = {task for block in run.history.trained for task in block} if run.history else set()
    if learned is not None and learned < len(tasks):
        sentence = f"only {learned:g} of {len(tasks)} tasks were learned in their blocks"
        found = {"forgetting": sentence, "relative_forgetting": sentence}
    never = known.get("never_adapted")
    if never:
        found["adaptation_frames"] = f"at least; {never:.0%} of tasks never reach 0.9, and count their whole block"
    return found
