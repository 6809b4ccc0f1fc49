"""Performance profiles and the probability of improvement, as in rliable (Agarwal et al. 2021).

Scores are mean returns at the last evaluation of each task. Intervals are percentiles of a bootstrap over the seeds of
each task and agent; those of few seeds cover less than stated.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from ctgraph_rl.report.figures.gallery import CaptionedFigure, left_out
from ctgraph_rl.report.figures.learning_curves import named
from ctgraph_rl.report.sections import Result, Section
from ctgraph_rl.report.style import MOST_AGENTS, agent_style, beside, figure_width, new_figure, short

FEWEST_SEEDS = 3

RESAMPLES = 2000
"""Bootstrap samples, as in rliable's examples."""

TAILS = (0.025, 0.975)

THRESHOLDS = 101

Scores = Mapping[str, np.ndarray]
"""Each task's scores of all seeds, float64 [seeds]."""

BOOTSTRAP = f"percentiles of {RESAMPLES:,} bootstrap samples stratified by task, at 95 %"


class Interval(NamedTuple):
    """An estimate and its interval; arrays for a curve."""

    value: Any
    low: Any
    high: Any


def scores(result: Result) -> dict[str, np.ndarray]:
    """Return an agent's mean returns at the last evaluation of each trained task."""
    found: dict[str, list[float]] = {}
    for run in result.finished:
        for task in run.tasks:
            value = run.returns.get(task)
            if value is not None:
                found.setdefault(task, []).append(value)
    return {task: np.array(values, dtype=np.float64) for task, values in found.items()}


def performance_profile(of_tasks: Scores, thresholds: np.ndarray) -> Interval:
    """Return the share of runs and tasks with a score above each threshold, float64 [thresholds], with its interval.

    Args:
        thresholds: float64 [thresholds].
    """
    rng = np.random.default_rng(0)
    drawn = np.concatenate([_drawn(values, rng) for values in of_tasks.values()], axis=1)
    shares = np.stack([(drawn > threshold).mean(axis=1) for threshold in thresholds], axis=1)
    low, high = np.quantile(shares, TAILS, axis=0)
    above = _pooled(of_tasks)[:, None] > thresholds
    return Interval(above.mean(axis=0), low, high)


def _pooled(of_tasks: Scores) -> np.ndarray:
    return np.concatenate(list(of_tasks.values()))


def probability_of_improvement(first: Scores, second: Scores) -> Interval:
    """Return the probability that a run of one agent is better than one of another, the mean over shared tasks.

    It is the statistic of Mann and Whitney over the number of pairs of seeds; equal scores count half.
    """
    rng = np.random.default_rng(0)
    tasks = [task for task in first if task in second]
    value = np.mean([_better(first[task][None], second[task][None])[0] for task in tasks])
    drawn = np.mean([_better(_drawn(first[task], rng), _drawn(second[task], rng)) for task in tasks], axis=0)
    low, high = np.quantile(drawn, TAILS)
    return Interval(float(value), float(low), float(high))


def _drawn(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return values[rng.integers(len(values), size=(RESAMPLES, len(values)))]


def _better(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    one = first[:, :, None]
    other = second[:, None, :]
    points = (one > other) + 0.5 * (one == other)
    return np.asarray(points.mean(axis=(1, 2)))


def _shown(section: Section) -> list[Result]:
    return [result for result in section.results if len(result.finished) >= FEWEST_SEEDS and scores(result)]


def profiles(section: Section) -> CaptionedFigure | None:
    """Return all agents' performance profiles; None without two agents of enough seeds."""
    shown = _shown(section)
    if len(shown) < 2:
        return None
    caption = (
        "Performance profiles: the share of runs and tasks whose mean return at the last evaluation is above a "
        f"threshold. Bands: {BOOTSTRAP}.{left_out(len(shown), MOST_AGENTS, 'agents')}"
    )
    shown = shown[:MOST_AGENTS]
    every = np.concatenate([_pooled(scores(result)) for result in shown])
    thresholds = np.linspace(min(0.0, every.min()), max(1.0, every.max()), THRESHOLDS)
    figure = new_figure(figure_width(), 2.5)
    axes = figure.subplots()
    for result in shown:
        look = agent_style(section.results.index(result), result.agent)
        profile = performance_profile(scores(result), thresholds)
        axes.plot(thresholds, profile.value, label=named(result), markevery=THRESHOLDS // 8, **look)
        axes.fill_between(thresholds, profile.low, profile.high, color=look["color"], alpha=0.18, linewidth=0)
    axes.set(xlabel="threshold of the return", ylabel="share of runs above", ylim=(-0.03, 1.03))
    figure.legend(loc="outside upper left", ncols=min(beside(3), len(shown)))
    return CaptionedFigure("profiles", "Performance profiles", caption, figure)


def improvements(section: Section) -> CaptionedFigure | None:
    """Return the probabilities of improvement of all pairs of agents; None without two agents of enough seeds."""
    shown = _shown(section)
    if len(shown) < 2:
        return None
    caption = (
        "Probability of improvement: how likely a run of one agent has a higher mean return at the last evaluation "
        "than a run of the other, as a mean over tasks. Equal returns count half, so equal agents have 0.5. Bars: "
        f"{BOOTSTRAP}.{left_out(len(shown), MOST_AGENTS, 'agents')}"
    )
    pairs = list(combinations(shown[:MOST_AGENTS], 2))
    figure = new_figure(figure_width(), 0.8 + 0.36 * len(pairs))
    axes = figure.subplots()
    for row, (first, second) in enumerate(pairs):
        found = probability_of_improvement(scores(first), scores(second))
        colour = agent_style(section.results.index(first), first.agent)["color"]
        axes.barh(row, found.high - found.low, left=found.low, height=0.6, color=colour, alpha=0.6)
        axes.plot([found.value] * 2, [row - 0.35, row + 0.35], "k-", marker="", linewidth=1.2)
    names = [f"{short(first.agent)}\nover {short(second.agent)}" for first, second in pairs]
    axes.set_yticks(range(len(pairs)), names)
    axes.invert_yaxis()
    axes.axvline(0.5, color="0.4", linestyle="--", linewidth=0.8)
    axes.set(xlim=(-0.02, 1.02), xlabel="P(a run of the first is better)")
    return CaptionedFigure("improvement", "Probability of improvement", caption, figure)
