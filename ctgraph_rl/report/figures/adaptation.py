"""Success while evaluated rows adapt, episode by episode, over the best search's curve."""

from __future__ import annotations

from itertools import chain

import torch
from torch import Tensor

from ctgraph_rl.metrics.adaptation import Adaptation
from ctgraph_rl.report.figures.gallery import CaptionedFigure, left_out
from ctgraph_rl.report.figures.learning_curves import choose_looks, named
from ctgraph_rl.report.sections import Result, Section
from ctgraph_rl.report.style import MOST_AGENTS, WIDTHS, beside, figure_width, new_figure
from ctgraph_rl.runs.read import histories

KINDS = ("trained", "held-out")


def adaptation_curves(section: Section) -> CaptionedFigure | None:
    """Return all agents' curves of the last evaluation with adaptation, if any."""
    shown = choose_looks(section)
    kinds = [kind for kind in KINDS if any(_of_seeds(result, kind) for result, _ in shown)]
    if not kinds:
        return None
    caption = (
        "Share of rows that reach the goal in each of their episodes, in the last evaluation: means over the tasks, "
        "trained and held-out ones apart; thin lines: single seeds, thick ones: their means. Dashed: the best search "
        f"for a goal that is drawn uniformly.{left_out(len(section.results), MOST_AGENTS, 'agents')}"
    )
    figure = new_figure(max(WIDTHS["column"], figure_width() * len(kinds) / len(KINDS)), 2.6)
    panels = figure.subplots(1, len(kinds), squeeze=False, sharey=True)[0]
    for axes, kind in zip(panels, kinds, strict=True):
        for result, look in shown:
            seeds = [adaptation.success.mean(dim=0) for adaptation in _of_seeds(result, kind)]
            for success in seeds:
                axes.plot(_episodes(success), success, color=look["color"], linewidth=0.4, marker="", linestyle="-")
            if seeds:
                mean = torch.stack(seeds).mean(dim=0)
                axes.plot(_episodes(mean), mean, label=named(result), markevery=1 + len(mean) // 8, **look)
        exact = next(chain(*(_of_seeds(result, kind) for result, _ in shown))).exact.mean(dim=0)
        axes.plot(_episodes(exact), exact, "k--", marker="", linewidth=1, label="best search")
        axes.set(title=f"{kind} tasks", xlabel="episode of a row", ylim=(-0.05, 1.05))
    panels[0].set_ylabel("share at the goal")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=min(beside(3), len(labels)))
    return CaptionedFigure("adaptation", "Adaptation", caption, figure)


def _of_seeds(result: Result, kind: str) -> list[Adaptation]:
    return [history.adaptation[kind] for history in histories(result.finished) if kind in history.adaptation]


def _episodes(curve: Tensor) -> range:
    return range(1, len(curve) + 1)
