"""Paired comparisons of methods on the pages of results: seed by seed, with p-values corrected for their number.

The runs of two methods on one curriculum with one agent and seed are a pair: they share the images, the initial weights
and the evaluation's draws, and where both learn the first task alike, its results. Runs of one seed on
several curricula share its weights and draws, too, so the paper's claims compare means over curricula, a pair for each
seed. Five pairs have no p-value below 0.06, so pairs of several agents are tested together where there are no more.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import combinations
from typing import Any

from ctgraph_rl import metrics
from ctgraph_rl.metrics import MASTERED
from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import Comparison
from studies.lifelong import comparison
from studies.lifelong.comparison import CURRICULA, MASKS, RETURNS, returns_at_end
from studies.raw import Raw, groups, mean_of, read, select, shown, table
from studies.verdicts import ALPHA

COMBINED, ALONE, OTHERS = ("mask_lc", "mask_blc"), "mask_ri", ("finetune", "ewc_published")
BASE = "finetune"

METHODS = ("finetune", "ewc_published", "mask_lc", "mask_ri", "mask_blc")
"""Methods of the published comparison."""

Measured = dict[tuple[str, ...], float]
"""A number of each run, by what tells pairs apart."""


def at_the_end(lines: Raw) -> float:
    """Mean return on all tasks at the end of a run."""
    return float(comparison.curves(lines).performance[-1].mean())


def while_learning(lines: Raw) -> float:
    """Mean return on each task over the evaluations of its own block, mean over tasks."""
    return float(metrics.stage_areas(comparison.curves(lines)).mean())


def claims() -> dict[str, Comparison]:
    """The two claims of the paper on masks, each for all methods that it is about: means over the three curricula."""
    raw = [{**line, "curriculum": name} for name in MASKS for line in read(name)]
    of = groups(raw, "method", "curriculum", "seed")
    end = over_curricula({cell: at_the_end(lines) for cell, lines in of.items()})
    learning = over_curricula({cell: while_learning(lines) for cell, lines in of.items()})
    found = {}
    for mask in (ALONE, *COMBINED):
        for other in OTHERS:
            found[f"at the end, `{mask}` - `{other}`"] = of_pairs(end, mask, other)
    for mask in COMBINED:
        found[f"while learning, `{mask}` - `{ALONE}`"] = of_pairs(learning, mask, ALONE)
    return found


def by_method(lines: Raw, measure: Callable[[Raw], float]) -> dict[str, list[float]]:
    """Return a number of each run by method, in the order of seeds."""
    found: dict[str, list[float]] = {}
    for (method, _), run in sorted(groups(lines, "method", "seed").items(), key=lambda cell: int(cell[0][1])):
        found.setdefault(method, []).append(measure(run))
    return found


def compare_areas(name: str) -> dict[tuple[str, str], Comparison]:
    """Compare all pairs of methods of a table by the mean return over all blocks, p-values corrected for all."""
    areas = by_method(read(name), while_learning)
    found = {}
    for one, other in combinations(METHODS, 2):
        found[one, other] = statistics.compare(areas[one], areas[other], bounds=(0, 1))
    return statistics.corrected(found)


def clearest(found: Mapping[Any, Comparison]) -> tuple[Any, Comparison]:
    """Return the comparison with the smallest p-value of those that are above 0.05 after the correction."""
    left = {pair: each for pair, each in found.items() if each.holm is not None and each.holm > ALPHA}
    pair = min(left, key=lambda pair: left[pair].p_value or 1.0)
    return pair, left[pair]


def last_depth(methods: Sequence[str]) -> dict[str, Comparison]:
    """Compare PPO with each method and fine-tuned PPO by depth 5 in its own block, p-values corrected for all."""
    lines = select(read("methods"), curriculum="fo_b1_depth2to5", agent="ppo")
    learned = by_method(lines, lambda run: float(comparison.curves(run).ends[-1, -1] >= MASTERED))
    found = {name: statistics.compare(learned[name], learned[BASE], bounds=(0, 1)) for name in methods}
    return statistics.corrected(found)


def over_curricula(measured: Mapping[tuple[str, ...], float]) -> Measured:
    """Return the mean over the three curricula of each method and seed that has all: seeds are what is independent."""
    by_seed: dict[tuple[str, ...], list[float]] = {}
    for (method, _, seed), value in measured.items():
        by_seed.setdefault((method, seed), []).append(value)
    return {cell: sum(values) / len(MASKS) for cell, values in by_seed.items() if len(values) == len(MASKS)}


def against_finetuning(agents: Collection[str]) -> dict[str, Comparison]:
    """Each method against fine-tuning on each curriculum, pairs of some agents, by the mean return at the end."""
    lines = [line for line in read("methods") if line["agent"] in agents]
    found = {}
    for curriculum in CURRICULA:
        of = groups(select(lines, curriculum=curriculum), "method", "agent", "seed")
        measured = {cell: at_the_end(run) for cell, run in of.items()}
        for method in comparison.METHODS:
            if method != BASE:
                found[f"{curriculum}, `{method}`"] = of_pairs(measured, method, BASE)
    return found


def by_ppo() -> str:
    """A line for each method, a column for each curriculum: PPO's return at the end, and p against fine-tuning."""
    cells = groups(select(read("methods"), agent="ppo"), "method", "curriculum")
    tested = statistics.corrected(against_finetuning(["ppo"]))
    lines = []
    for method in comparison.METHODS:
        line = [f"`{method}`"]
        for curriculum in CURRICULA:
            cell = mean_of(returns_at_end(cells[method, curriculum]), RETURNS)
            if method != BASE:
                cell += f", p {_p(tested[f'{curriculum}, `{method}`'].holm)}"
            line.append(cell)
        lines.append(line)
    return table(["", *(f"`{curriculum}`" for curriculum in CURRICULA)], lines)


def of_pairs(measured: Mapping[tuple[str, ...], float], first: str, second: str) -> Comparison:
    """Compare two methods over all pairs that both have."""
    pairs = [
        (value, measured[second, *cell])
        for (method, *cell), value in measured.items()
        if method == first and (second, *cell) in measured
    ]
    values, others = zip(*pairs, strict=True)
    return statistics.compare(values, others, bounds=(0.0, 1.0))


def rows(found: Mapping[str, Comparison]) -> str:
    """A line for each comparison, its p-value corrected for all of them."""
    lines = []
    for name, each in statistics.corrected(found).items():
        lines.append([name, shown(each.difference), f"{each.wins}, {each.ties}, {each.losses}", _p(each.holm)])
    return table(["", "difference", "better, equal, worse", "p (Holm)"], lines)


def _p(value: float | None) -> str:
    return "-" if value is None else "< 0.001" if value < 0.001 else f"{value:.3f}"
