"""What memory.md says by graph: its tables, the totals over graphs, and how it reads the published claim."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import Comparison
from studies.memory.conditions import (
    GIVEN,
    NOISE,
    NOISY,
    NOISY_AGENTS,
    SHARED,
    TO_FIND,
    UNIQUE,
    Condition,
    columns,
    finished,
)
from studies.memory.runs import AGENTS, count, mean, returns, solved, solved_once
from studies.raw import Raw, shown, table
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

POOR = 1
"""The most seeds of five that solve a graph on which an agent is said to do poorly."""

OF_CLAIM = [SHARED, TO_FIND[0], UNIQUE, TO_FIND[1]]


def ceiling(of: Mapping[str, Raw]) -> float:
    """Return the best return without memory on a graph."""
    return float(next(iter(of.values()))[0]["ceiling_without_memory"])


def with_noise() -> str:
    """Return how many of all runs with noise solve the task after training, and of those without."""
    of = finished()
    noise, plain = (
        [line for noisy in NOISY for name in NOISY_AGENTS for line in of[noisy._replace(read_noise=level)][name]]
        for level in (NOISE, "0")
    )
    return f"{count(noise)} runs with noise and {count(plain)} without"


def totals() -> dict[str, Raw]:
    """Return the lines of each agent on all graphs with first rewards given, of those that ran on all."""
    each = columns(GIVEN).values()
    return {name: [line for of in each for line in of[name]] for name in AGENTS if all(name in of for of in each)}


def compared(of: Mapping[str, Raw]) -> dict[str, Comparison]:
    """Return the paired comparison of each agent's greedy returns with the LSTM's, p-values corrected for all."""
    base = returns(of["lstm_ppo"])
    found = {name: statistics.compare(returns(of[name]), base, bounds=(0, 1)) for name in of if name != "lstm_ppo"}
    return statistics.corrected(found)


def total_table() -> str:
    """Return a line for each agent: how many of all runs solve the task, and the difference from the LSTM."""
    of = totals()
    comparisons, rows = compared(of), []
    for name in sorted(of, key=lambda name: -sum(solved(of[name]))):
        lines = of[name]
        row = [
            AGENTS[name],
            f"{sum(solved(lines))}",
            f"{sum(solved_once(lines))}",
            f"{mean(lines, 'greedy_return'):.2f}",
        ]
        if name in comparisons:
            comparison = comparisons[name]
            row += [shown(comparison.difference), f"{comparison.holm:.3f}"]
        rows.append([*row, "", ""][:6])
    number = len(next(iter(of.values())))
    heads = [
        f"solved after training, of {number}",
        "at any evaluation",
        "greedy return",
        "difference from the LSTM",
        "p",
    ]
    return table(["", *heads], rows)


def lower_and_undecided() -> tuple[str, str]:
    """Return how many agents have lower returns than the LSTM, p <= 0.05 after Holm, and the others' differences.

    Raises:
        ValueError: for an agent with higher returns, of which the page has no word.
    """
    lower: list[str] = []
    others: list[str] = []
    found = compared(totals())
    for name, comparison in found.items():
        if (comparison.holm or 0) > ALPHA:
            others.append(f"{AGENTS[name]} {undecided(comparison, len(found))}")
        elif (comparison.difference.value or 0) > 0:
            raise ValueError(f"{name} has higher returns than the LSTM: the page says otherwise")
        else:
            lower.append(AGENTS[name])
    return str(len(lower)), "; ".join(others)


def lost() -> str:
    """Return how many runs that solved the task at an evaluation did not after training, by agent; without noise."""
    each = columns([*GIVEN, *TO_FIND]).values()
    runs = {name: [line for of in each for line in of.get(name, [])] for name in AGENTS}
    once = {name: [line for line in lines if line["frames_to_90"]] for name, lines in runs.items()}
    gone = {name: len(lines) - sum(solved(lines)) for name, lines in once.items()}
    worst = sorted((name for name in once if gone[name]), key=lambda name: -gone[name] / len(once[name]))
    parts = [f"{AGENTS[name]} {gone[name]} of {len(once[name])}" for name in worst]
    whole = f"Of {sum(map(len, once.values()))} runs that solved the task at an evaluation, {sum(gone.values())}"
    return f"{whole} did not after training: {', '.join(parts)}"


def cut_off(steps: int) -> str:
    """Return the share of frames whose episode continues after their batch, for each p of the graphs, as ``25 %``.

    Rows begin together, play the optimal policy, which waits a geometric time before each decision and before the
    end, and are seen after many batches; at p = 0 all stay in step.
    """
    shares = [_share_cut_off(wait_prob, steps) for wait_prob in (0.0, 0.5, 0.9)]
    return listed([f"{100 * share:.0f} %" for share in shares])


def _share_cut_off(wait_prob: float, steps: int, depth: int = 2) -> float:
    waits = depth + 1
    if wait_prob == 0:
        length = 2 * waits
        return sum(steps * batch % length for batch in range(length)) / length / steps
    ways = (math.comb(n - 1, depth) * (1 - wait_prob) ** waits * wait_prob ** (n - waits) for n in range(waits, 2000))
    longer = 1.0
    shares = [1.0] * (2 * waits - 1)
    for probability in ways:
        shares.append(longer)
        longer -= probability
    return sum(min(age, steps) * share for age, share in enumerate(shares)) / sum(shares) / steps


def claim_table() -> str:
    """Return a line for each rival and MOHQA, a column for each graph that the claim can be about."""
    of = columns(OF_CLAIM)
    heads = [f"{each.decisions}, {each.rewards.removeprefix('first rewards ')}" for each in OF_CLAIM]
    rows = [[AGENTS[name], *(short(each.get(name)) for each in of.values())] for name in (*RIVALS, "mohqa")]
    return table(["", *heads], rows)


def short(lines: Raw | None) -> str:
    """Return the seeds that solve the task after training, in brackets at any evaluation."""
    return f"{sum(solved(lines))} ({sum(solved_once(lines))})" if lines else "not run"


def better_than_poor(condition: Condition) -> str:
    """Return the rivals that more than `POOR` seeds solve a graph with."""
    of = columns([condition])[condition]
    return listed([AGENTS[name] for name in RIVALS if sum(solved(of[name])) > POOR])


def listed(names: Sequence[str]) -> str:
    """Return names as a list in a sentence."""
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else "".join(names) or "no agent"
