"""What memory.md says by graph: its tables, the totals over graphs, and how it reads the published claim."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import fmean

from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import Comparison
from studies.memory.conditions import (
    AGENTS,
    GIVEN,
    SHARED,
    TO_FIND,
    UNIQUE,
    finished,
    solved,
    solved_once,
)
from studies.raw import Raw, numbers_in, shown, table
from studies.verdicts import ALPHA, undecided

RIVALS = (
    "dqn, 1 step",
    "dqn, 6 steps",
    "qrdqn_lstm",
    "reinforce, 8 steps",
    "reinforce, 128 steps",
    "a2c, 8 steps",
    "a2c, 32 steps",
    "lstm_ppo-amrl_max",
    "lstm_ppo-amrl_avg",
    "lstm_ppo-backpropamine",
)
"""The agents that the claim names, in its order."""

OF_CLAIM = {
    "shared, given": SHARED,
    "shared, to be found": TO_FIND[0],
    "unique, given": UNIQUE,
    "unique, to be found": TO_FIND[1],
}
"""The graphs that the claim can be about, by decisions and first rewards."""


def ceiling(of: Mapping[str, Raw]) -> float:
    """Return the best return without memory on a graph."""
    return float(next(iter(of.values()))[0]["ceiling_without_memory"])


def totals() -> dict[str, Raw]:
    """Return the lines of each agent on all graphs with first rewards given."""
    of = finished()
    return {name: [line for condition in GIVEN for line in of[condition][name]] for name in AGENTS}


def compared(of: Mapping[str, Raw]) -> dict[str, Comparison]:
    """Return the paired comparison of each agent's greedy returns with the LSTM's, p-values corrected for all."""
    returns = {name: numbers_in(lines, "greedy_return") for name, lines in of.items()}
    base = returns.pop("lstm_ppo")
    return statistics.corrected({name: statistics.compare(each, base, bounds=(0, 1)) for name, each in returns.items()})


def total_table() -> str:
    """Return a line for each agent: how many of all runs solve the task, and the difference from the LSTM."""
    of = totals()
    comparisons = compared(of)
    rows = []
    for name in sorted(of, key=lambda name: -sum(solved(of[name]))):
        lines = of[name]
        mean = fmean(numbers_in(lines, "greedy_return"))
        row = [AGENTS[name], str(sum(solved(lines))), str(sum(solved_once(lines))), f"{mean:.2f}"]
        if name in comparisons:
            row += [shown(comparisons[name].difference), f"{comparisons[name].holm:.3f}"]
        else:
            row += ["", ""]
        rows.append(row)
    heads = [f"solved after training, of {len(lines)}", "at any evaluation", "greedy return"]
    return table(["", *heads, "difference from the LSTM", "p"], rows)


def lower_and_undecided() -> tuple[str, str]:
    """Return how many agents have lower returns than the LSTM, p <= 0.05 after Holm, and the others' differences.

    Raises:
        ValueError: for an agent with higher returns, of which the page has no word.
    """
    lower: list[str] = []
    others: list[str] = []
    for name, comparison in compared(totals()).items():
        if (comparison.holm or 0) > ALPHA:
            others.append(f"{AGENTS[name]} {undecided(comparison)}")
        elif (comparison.difference.value or 0) > 0:
            raise ValueError(f"{name} has higher returns than the LSTM: the page says otherwise")
        else:
            lower.append(AGENTS[name])
    return str(len(lower)), "; ".join(others)


def claim_table() -> str:
    """Return a line for each rival and MOHQA, a column for each graph that the claim can be about.

    Cells are the seeds that solve the task after training, in brackets at any evaluation.
    """
    of = finished()
    rows = []
    for name in (*RIVALS, "mohqa"):
        cells = [of[condition][name] for condition in OF_CLAIM.values()]
        rows.append([AGENTS[name], *(f"{sum(solved(lines))} ({sum(solved_once(lines))})" for lines in cells)])
    return table(["", *OF_CLAIM], rows)
