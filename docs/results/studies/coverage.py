"""How often intervals cover what they are of, by simulation: the tables of docs/explanation/statistics.md.

Each cell has draws of its own, so that one alone can be computed again. A mean of two outcomes is not simulated: its
coverage is the sum of the binomial probabilities of the samples whose interval covers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from string import Template
from zlib import crc32

import numpy as np

from ctgraph_rl.report import statistics
from ctgraph_rl.report.intervals import scipy
from studies.lifelong.comparison import forward_transfer
from studies.raw import HERE, TEMPLATES, table
from studies.two_groups import two_groups

PAGE = HERE.parent / "explanation" / "statistics.md"
SEEDS = (3, 5, 10, 20)
DRAWS = 2000
RATE = 0.9
TAIL = (1 - statistics.LEVEL) / 2

Interval = tuple[float, float]
Rule = Callable[[Sequence[float]], Interval]


def gaffke(values: Sequence[float]) -> Interval:
    """The rule of this package for values in [0, 1]."""
    found = statistics.mean(values, bounds=(0.0, 1.0))
    return found.low, found.high  # type: ignore[return-value]


def student(values: Sequence[float]) -> Interval:
    """Student's interval; of no width where all seeds agree."""
    found = statistics.mean(values)
    return (found.value, found.value) if found.low is None else (found.low, found.high)  # type: ignore[return-value]


def bca(values: Sequence[float]) -> Interval:
    """The bootstrap interval BCa, 999 samples; of no width where all seeds agree."""
    if min(values) == max(values):
        return values[0], values[0]
    bootstrap = partial(scipy("stats").bootstrap, n_resamples=999, method="BCa", rng=0)
    found = bootstrap((np.array(values),), np.mean, confidence_level=statistics.LEVEL).confidence_interval
    return float(found.low), float(found.high)


RULES: dict[str, Rule] = {
    "**Gaffke**": gaffke,
    "Student t": student,
    "BCa bootstrap": bca,
}
SHAPES: dict[str, tuple[Callable[[np.random.Generator, tuple[int, ...]], np.ndarray], float]] = {
    "bounded": (lambda rng, size: rng.random(size), 0.5),
    "two-valued": (lambda rng, size: (rng.random(size) < RATE).astype(float), RATE),
    "skewed": (lambda rng, size: 1 - rng.random(size) ** 8, 1 - 1 / 9),
}
"""Draws of returns in [0, 1], and their mean."""

SLOW = ("BCa bootstrap",)
"""Rules with a tenth of the draws."""


def cell(rule: str, shape: str, n: int) -> str:
    """The coverage of a rule and the mean width of its intervals."""
    covers, widths = _two_valued(RULES[rule], n) if shape == "two-valued" else _simulated(rule, shape, n)
    return f"{covers:.1%}, {widths:.2f}".replace("%", " %")


def _two_valued(rule: Rule, n: int) -> tuple[float, float]:
    covers = width = 0.0
    for ones in range(n + 1):
        chance = math.comb(n, ones) * RATE**ones * (1 - RATE) ** (n - ones)
        low, high = rule([1.0] * ones + [0.0] * (n - ones))
        covers, width = covers + chance * (low <= RATE <= high), width + chance * (high - low)
    return covers, width


def _simulated(rule: str, shape: str, n: int) -> tuple[float, float]:
    draw, centre = SHAPES[shape]
    samples = draw(_rng(shape, n), (DRAWS // 10 if rule in SLOW else DRAWS, n))
    ends = np.array([RULES[rule](sample) for sample in samples.tolist()])
    covers = (ends[:, 0] <= centre + 1e-12) & (centre - 1e-12 <= ends[:, 1])
    return float(covers.mean()), float((ends[:, 1] - ends[:, 0]).mean())


def _rng(*names: object) -> np.random.Generator:
    return np.random.default_rng(crc32(" ".join(map(str, names)).encode()))


def of_means() -> str:
    """Coverage and width of each rule for a mean, of each shape and number of seeds."""
    rows = [[shape, rule, *(cell(rule, shape, n) for n in SEEDS)] for shape in SHAPES for rule in RULES]
    return table(["returns", "interval", *(f"n = {n}" for n in SEEDS)], rows)


def of_times(n: int) -> str:
    """Coverage of the median of times, a third of which are never reached, and the share of intervals with an end."""
    rng, found = _rng("times", n), []
    for sample in np.where(rng.random((DRAWS, n)) < 1 / 3, np.inf, rng.exponential(size=(DRAWS, n))).tolist():
        estimate = statistics.median_time(sample)
        found.append((estimate.low <= math.log(4) <= estimate.high, estimate.high < math.inf))  # type: ignore[operator]
    covers, ends = np.mean(found, axis=0)
    return f"{covers:.1%}, {ends:.0%}".replace("%", " %")


def of_middle_means(n: int, draws: int = 200) -> str:
    """Coverage of the interquartile mean of one task of each shape, and the mean width."""
    rng = _rng("iqm", n)
    true = np.sort(np.concatenate([draw(_rng("iqm", shape), (10**6,)) for shape, (draw, _) in SHAPES.items()]))
    centre = true[len(true) // 4 : len(true) - len(true) // 4].mean()
    found = []
    for _ in range(draws):
        tasks = [draw(rng, (n,)).tolist() for draw, _ in SHAPES.values()]
        estimate = statistics.interquartile_mean(tasks, resamples=1000, bounds=(0.0, 1.0))
        found.append((estimate.low <= centre <= estimate.high, estimate.high - estimate.low))  # type: ignore[operator]
    covers, width = np.mean(found, axis=0)
    return f"{covers:.1%}, {width:.2f}".replace("%", " %")


def of_transfer(how: str, n: int, draws: int = 500) -> str:
    """Coverage of forward transfer over four tasks; an area is 1 less the share of evaluations before success."""
    rng, found = _rng("transfer", n), []

    def areas(mean_wait: float) -> np.ndarray:
        waits = rng.geometric(1 / (mean_wait + 1), (n, 4)) - 1
        return 1 - np.minimum(waits, 20) / 20

    centre = forward_transfer(*(np.full(4, 1 - _mean_wait(mean) / 20) for mean in (1, 3)))
    for _ in range(draws):
        runs, experts = areas(1), areas(3)
        low, high = _both(runs, experts) if how == "weighted" else _drawn_again(runs, experts, rng)
        found.append((bool(low <= centre <= high), low == -math.inf))
    covers, open_below = np.mean(found, axis=0)
    return f"{covers:.1%}, {open_below:.0%}".replace("%", " %")


def _mean_wait(mean: float) -> float:
    """Mean of a geometric wait that is cut at 20."""
    stays = mean / (mean + 1)
    return sum(stays**k for k in range(1, 21))


def _both(runs: np.ndarray, experts: np.ndarray) -> Interval:
    found = two_groups(runs, experts, forward_transfer)
    return found.low, found.high  # type: ignore[return-value]


def _drawn_again(runs: np.ndarray, experts: np.ndarray, rng: np.random.Generator) -> Interval:
    draws = [side[rng.integers(len(side), size=(999, len(side)))].mean(1) for side in (runs, experts)]
    found = forward_transfer(*draws)
    return float(np.quantile(found, TAIL, method="lower")), float(np.quantile(found, 1 - TAIL, method="higher"))


def of_others() -> str:
    """A line for each rule of other numbers."""
    few = ["-"] * 2
    weighted, drawn = ([of_transfer(how, n) for n in SEEDS] for how in ("weighted", "drawn again"))
    rows = [
        ["median of times, of which a third is never reached", "covers, has an end", *map(of_times, SEEDS)],
        ["interquartile mean of three tasks", "covers, width", *few, *map(of_middle_means, SEEDS[2:])],
        ["**forward transfer, both sides weighted**", "covers, no end below", *weighted],
        ["forward transfer, both sides drawn again", "covers, no end below", *drawn],
    ]
    return table(["number", "", *(f"n = {n}" for n in SEEDS)], rows)


def page() -> str:
    """The page: its template with its tables."""
    template = Template((TEMPLATES / "statistics.md").read_text(encoding="utf-8"))
    return template.substitute(of_means=of_means(), of_others=of_others(), draws=f"{DRAWS:,}")


def make() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")
