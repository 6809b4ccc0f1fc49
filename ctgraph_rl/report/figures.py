"""The figures of the page: those of a curriculum, and those of each agent on it, in their order."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from ctgraph_rl.report.gallery import CaptionedFigure
from ctgraph_rl.report.heatmaps import transfer_maps
from ctgraph_rl.report.learning_curves import learning_curves, training_curves
from ctgraph_rl.report.sections import Result, Section
from ctgraph_rl.report.trees import Trees, task_trees

OF_SECTION: tuple[Callable[[Section], CaptionedFigure | None], ...] = (learning_curves, training_curves)
"""Figures of all agents on a curriculum; None where there is nothing to draw."""

OF_AGENT: tuple[Callable[[Section, Result, Trees], CaptionedFigure | None], ...] = (transfer_maps, task_trees)
"""Figures of an agent with finished runs."""


def of_section(section: Section) -> Iterator[CaptionedFigure]:
    """Draw the figures of a curriculum, one after the other."""
    return (figure for draw in OF_SECTION if (figure := draw(section)) is not None)


def of_agent(section: Section, result: Result, trees: Trees) -> Iterator[CaptionedFigure]:
    """Draw the figures of an agent with finished runs, one after the other."""
    return (figure for draw in OF_AGENT if (figure := draw(section, result, trees)) is not None)
