"""Methods against loss of plasticity, on tasks that each seed draws: plasticity.md."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import fmean, linear_regression

import numpy as np
from scipy.stats import rankdata

from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import LEAST_FOR_BOOTSTRAP, Comparison
from studies.raw import Raw, fill, groups, read, shown, table
from studies.verdicts import UNKNOWN

NAME = "plasticity"
MATCHED = "plasticity_matched"
TRIALS = "plasticity_trials"

ALPHA = 0.05

CONFLICT = "goal_conflict"
STREAM = "stream"

COMPARED = {CONFLICT: range(2, 3), STREAM: range(2, 31)}
"""Blocks after a change."""

NINE = {
    "layer_norm": "layer norm",
    "l2_init": "L2 init",
    "shrink_and_perturb": "shrink and perturb",
    "redo": "ReDo",
    "continual_backprop": "continual backprop",
    "parseval": "Parseval",
    "c_chain": "C-CHAIN",
    "fire": "FIRE",
    "upgd": "UPGD",
}
LABELS = {"none": "*fine-tuning*", "fresh_optimiser": "a fresh Adam", **NINE, "fresh": "*a fresh network*"}

METRICS = {
    "dormant_0.1": "dormant at 0.1",
    "dormant_0.025": "dormant at 0.025",
    "dead": "dead",
    "rank_effective": "effective rank",
    "rank_srank": "srank",
    "rank_stable": "stable rank",
}
COLUMNS = [f"{name}_{images}" for name in METRICS for images in ("task", "fresh")] + ["norm_weights"]
"""Metrics before a change; ranks and shares on the next task's images and on fresh ones."""

RESAMPLES = 4000


def later_blocks(curriculum: str, condition: str) -> dict[str, Raw]:
    """Return the lines of the blocks in `COMPARED` by seed."""
    wanted = COMPARED[curriculum]
    lines = []
    for line in read(NAME):
        if line["condition"] == condition and line["curriculum"] == curriculum and int(line["block"]) in wanted:
            lines.append(line)
    return {seed: of_seed for (seed,), of_seed in groups(lines, "seed").items()}


def area(lines: Raw) -> float:
    """Return a seed's mean area over blocks."""
    return fmean(float(line["area"]) for line in lines)


def compared(curriculum: str, first: str, second: str) -> Comparison:
    """Compare the areas of two conditions, paired by seed."""
    ours = later_blocks(curriculum, first)
    theirs = later_blocks(curriculum, second)
    seeds = [seed for seed in ours if seed in theirs]
    first_areas = [area(ours[seed]) for seed in seeds]
    return statistics.compare(first_areas, [area(theirs[seed]) for seed in seeds])


def growth() -> Comparison:
    """Compare how a fresh network's and fine-tuning's area change over ten blocks of a stream, by least squares."""
    slopes = []
    for condition in ("fresh", "none"):
        of_seeds = []
        for lines in later_blocks(STREAM, condition).values():
            blocks = [int(line["block"]) for line in lines]
            of_seeds.append(10 * linear_regression(blocks, [float(line["area"]) for line in lines]).slope)
        slopes.append(of_seeds)
    return statistics.compare(slopes[0], slopes[1])


def nine_against(curriculum: str, other: str) -> dict[str, Comparison]:
    """Compare the nine methods with another condition, with p-values by Holm over the nine."""
    ran = {line["condition"] for line in read(NAME) if line["curriculum"] == curriculum}
    return statistics.corrected({name: compared(curriculum, name, other) for name in NINE if name in ran})


def conditions_table() -> str:
    """Return a row for each condition: areas, blocks that reached 0.9, and differences paired by seed."""
    rows = []
    tested = {name: nine_against(name, "none") for name in COMPARED}
    for condition, label in LABELS.items():
        row = [label]
        for curriculum in COMPARED:
            of_seeds = later_blocks(curriculum, condition)
            lines = [line for each in of_seeds.values() for line in each]
            reached = sum(line["reached"] == "True" for line in lines) / len(lines)
            found = compared(curriculum, condition, "fresh").difference
            own = f"area {fmean(map(area, of_seeds.values())):.2f}"
            row += [f"{100 * reached:.0f}", own if condition == "fresh" else shown(found)]
            holm = tested[curriculum][condition].holm if condition in NINE else None
            row.append("" if holm is None else f"{holm:.2g}")
        rows.append(row)
    head = ["less fresh", "p"]
    return table(["condition", "% reached", *head, f"`{STREAM}`: % reached", *head], rows)


def better(curriculum: str, other: str = "none") -> str:
    """Return the methods that Holm's procedure finds better than another condition, and worse, in words."""
    parts = []
    seeds = len(later_blocks(curriculum, other))
    if len(NINE) * 2 ** (1 - seeds) > ALPHA:
        return f"{UNKNOWN}: {seeds} seeds"
    found = nine_against(curriculum, other)
    for word, sign in (("better", 1), ("worse", -1)):
        names = []
        for name, each in found.items():
            value = each.difference.value or 0
            if each.holm is not None and each.holm <= ALPHA and value * sign > 0:
                names.append(f"{NINE[name]} {value:+.2f}")
        parts.append(f"{word}: {', '.join(names) or 'none'}")
    return "; ".join(parts)


def matched_words() -> str:
    """Return what the start costs, and what the old weights cost, with the seeds that were distilled."""
    lines = read(MATCHED)
    of = _areas(lines)
    compared_costs = {
        "the start": statistics.compare(of["fresh"], of["distilled"]),
        "the old weights": statistics.compare(of["distilled"], of["old"]),
    }
    costs = []
    for name, each in compared_costs.items():
        decided = each.p_value is not None and each.p_value <= ALPHA
        costs.append(f"{name} {shown(each.difference)}{'' if decided else f' ({UNKNOWN})'}")
    seeds = len({line["seed"] for line in lines})
    return f"{', '.join(costs)}; distilling worked in {len(of['distilled'])} of {seeds} seeds"


def _areas(lines: Raw) -> dict[str, list[float]]:
    """Return the areas of networks, one for each seed whose distillation met its limits."""
    met = {line["seed"] for line in lines if line["network"] == "distilled" and line["met"] == "True"}
    found: dict[str, list[float]] = {}
    for line in lines:
        if line["seed"] in met:
            found.setdefault(line["network"], []).append(float(line["area"]))
    return found


def forecasts(curriculum: str) -> Mapping[str, tuple[float, float, float]]:
    """Return each metric's rank correlation with the area after the change, and its interval.

    Ranks are within conditions and blocks, as both change over a life. Seeds are drawn with replacement, and all of
    [-1, 1] is the interval of fewer than `LEAST_FOR_BOOTSTRAP`. Intervals are corrected by Bonferroni.
    """
    cells: list[Raw] = []
    for condition in LABELS:
        lines = [line for of_seed in later_blocks(curriculum, condition).values() for line in of_seed]
        if condition != "fresh":
            cells += groups(lines, "block").values()
    seeds = [line["seed"] for lines in cells for line in lines]
    positions = np.unique(seeds, return_inverse=True)[1]
    count = positions.max() + 1
    draws = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), RESAMPLES)
    weights = np.concatenate([np.ones((1, count)), draws])

    def total(products: np.ndarray) -> np.ndarray:
        return weights @ np.bincount(positions, products)

    areas = _centred(cells, "area")
    tail = ALPHA / len(COLUMNS) / 2
    found = {}
    for column in COLUMNS:
        values = _centred(cells, column)
        scale = np.sqrt(total(values**2) * total(areas**2))
        correlations = total(values * areas) / np.where(scale > 0, scale, np.inf)
        low, high = np.quantile(correlations[1:], [tail, 1 - tail]) if count >= LEAST_FOR_BOOTSTRAP else (-1, 1)
        found[column] = (float(correlations[0]), float(low), float(high))
    return found


def _centred(cells: list[Raw], column: str) -> np.ndarray:
    """Return ranks within each cell, less their mean, as shares of the cell's lines."""
    values = np.array([[float(line[column]) for line in lines] for lines in cells])
    ranks = rankdata(values, axis=1)
    count = ranks.shape[1]
    return ((ranks - (count + 1) / 2) / count).ravel()


def forecast_words(curriculum: str) -> str:
    """Return the strongest metric with its interval, and whether it can be said to forecast the area."""
    found = forecasts(curriculum)
    column = max(found, key=lambda name: abs(found[name][0]))
    value, low, high = found[column]
    decided = low > 0 or high < 0
    if (low, high) == (-1, 1):
        return f"{UNKNOWN} with few seeds"
    return f"{_name(column)} {value:.2f} [{low:.2f}, {high:.2f}]{'' if decided else f', {UNKNOWN}'}"


def _name(column: str) -> str:
    """Return what a metric is called."""
    if column == "norm_weights":
        return "norm of weights"
    name, _, images = column.rpartition("_")
    return f"{METRICS[name]}, {images} images"


def seconds() -> float:
    """Return the CPU minutes of all runs."""
    runs = groups([*read(NAME), *read(TRIALS)], "curriculum", "condition", "settings", "seed")
    return sum(float(lines[0]["seconds"]) for lines in runs.values()) / 60


def page() -> str:
    """Return the page."""
    texts = {
        "better_conflict": better(CONFLICT),
        "better_stream": better(STREAM),
        "than_adam": better(CONFLICT, "fresh_optimiser"),
        "adam": shown(compared(CONFLICT, "fresh_optimiser", "none").difference),
        "conditions": conditions_table(),
        "conflict_seeds": len(later_blocks(CONFLICT, "none")),
        "stream_seeds": len(later_blocks(STREAM, "none")),
        "growth": shown(growth().difference),
        "loss_conflict": shown(compared(CONFLICT, "fresh", "none").difference),
        "loss_stream": shown(compared(STREAM, "fresh", "none").difference),
        "matched": matched_words(),
        "forecast_conflict": forecast_words(CONFLICT),
        "forecast_stream": forecast_words(STREAM),
        "minutes": f"{seconds():.0f}",
    }
    return fill(NAME, texts)
