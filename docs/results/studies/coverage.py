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

from ctgraph_rl.report import intervals, statistics
from ctgraph_rl.report.intervals import Bounds, scipy
from studies.lifelong.comparison import forward_transfer
from studies.raw import HERE, TEMPLATES, table
from studies.two_groups import two_groups

PAGE = HERE.parent / "explanation" / "statistics.md"
SEEDS = (3, 5, 10, 20)
DRAWS = 2000
RATE = 0.9
TAIL = (1 - statistics.LEVEL) / 2

MORE_SEEDS = (*SEEDS, 50)
NOISES = (0.01, 0.1, 0.5)
"""Standard deviations of the noise in a seed's return."""

NOISY_DRAWS = 20_000
WIDTHS = 100
KINDS = {
    "equal, mean 1": (1.0, 1.0),
    "solve at 0.98": (1.0, 0.98),
    "solve at 0.9": (1.0, 0.9),
    "solve at 0.5": (1.0, 0.5),
}
"""Seeds with noise: the return of a seed that solves its task, and how many do; the others have 0."""

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


def of_noise() -> str:
    """Coverage and mean width of the rule for returns with noise, of each kind of seeds, noise and number of seeds."""
    rows = []
    for kind in KINDS:
        for noise in NOISES:
            rows.append([kind, f"{noise:g}", *(noisy_cell(kind, noise, n) for n in MORE_SEEDS)])
    return table(["seeds", "noise", *(f"n = {n}" for n in MORE_SEEDS)], rows)


def noisy_cell(kind: str, noise: float, n: int, draws: int = NOISY_DRAWS) -> str:
    """The coverage for returns with noise, and the mean width of the first `WIDTHS` intervals."""
    samples, centre = noisy_returns(kind, noise, n, draws)
    bounds = Bounds(0.0, 1.0).widened(noise)
    found = [statistics.mean(sample, bounds=bounds) for sample in samples[:WIDTHS].tolist()]
    width = np.mean([each.high - each.low for each in found])  # type: ignore[operator]
    return f"{are_covered(samples, centre, bounds).mean():.1%}, {width:.2f}".replace("%", " %")


def noisy_returns(kind: str, noise: float, n: int, draws: int) -> tuple[np.ndarray, float]:
    """Return samples of n seeds, float64 [draws, n], each a return in [0, 1] and noise, and the true mean."""
    centre, share = KINDS[kind]
    rng = _rng(kind, noise, n)
    solved = rng.random((draws, n)) < share
    returns = np.where(solved, centre, 0.0)
    return returns + noise * rng.standard_normal((draws, n)), centre * share


def are_covered(samples: np.ndarray, centre: float, bounds: Bounds) -> np.ndarray:
    """Return whether the interval of `statistics.mean` holds a number, for each sample, bool [draws].

    Gaffke's lower end is below the number where the mean of random weights is so with probability `TAIL` at least. That
    needs no quantile, so that all samples are computed at once.

    Args:
        samples: float64 [draws, n].
        centre: the number.
        bounds: of the values.
    """
    draws, n = samples.shape
    low = np.column_stack([np.full(draws, bounds.low), np.sort(samples)])
    high = np.column_stack([np.full(draws, -bounds.high), np.sort(-samples)])
    covers = (_share_below(low, centre) >= TAIL) & (_share_below(high, -centre) >= TAIL)
    spread = samples.std(axis=1, ddof=1) / math.sqrt(n)
    half = intervals.student(statistics.LEVEL, n - 1) * spread
    students = np.abs(samples.mean(axis=1) - centre) <= half
    within = (samples >= bounds.low).all(axis=1) & (samples <= bounds.high).all(axis=1)
    return np.where(within, covers, students)


def _share_below(points: np.ndarray, limit: float) -> np.ndarray:
    """Return the probability that a mean of points, with uniform weights that sum to 1, is at most a limit.

    With points u >= 0 above the limit and v < 0 below it, by their distances, F of h and k of them is
    (|v_k| F(h - 1, k) + u_h F(h, k - 1)) / (u_h + |v_k|), 1 without points above and 0 without points below (Ali 1973).

    Args:
        points: float64 [draws, points], rising.
        limit: the limit.
    """
    distances = (points - limit).T
    number = len(distances)
    found = np.ones((number + 1, points.shape[0]))
    for above in distances[::-1]:
        is_above = above >= 0
        found[0] = np.where(is_above, 0.0, found[0])
        for k in range(1, number + 1):
            below = -distances[k - 1]
            both = is_above & (below > 0)
            total = np.where(both, above + below, 1.0)
            found[k] = np.where(both, (below * found[k] + above * found[k - 1]) / total, found[k])
    count = (distances < 0).sum(axis=0)
    return found[count, np.arange(points.shape[0])]


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
    return template.substitute(of_means=of_means(), of_noise=of_noise(), of_others=of_others(), **_counts())


def _counts() -> dict[str, str]:
    return {"draws": f"{DRAWS:,}", "noisy_draws": f"{NOISY_DRAWS:,}"}


def make() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")
