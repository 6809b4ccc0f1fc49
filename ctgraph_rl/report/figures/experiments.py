"""Several experiments in one figure: a panel for each curriculum, and one legend."""

from __future__ import annotations

from collections.abc import Sequence

from ctgraph_rl.report.figures.gallery import CaptionedFigure, left_out
from ctgraph_rl.report.figures.learning_curves import BANDS, draw_means
from ctgraph_rl.report.sections import Section
from ctgraph_rl.report.style import MOST_AGENTS, agent_style, agents_legend, frames_axis, panels, short

MOST_EXPERIMENTS = 12

COLUMNS = 3


def experiments(found: Sequence[Section]) -> CaptionedFigure | None:
    """Return the mean returns on several curricula; None for fewer than two with a finished run."""
    measured = [section for section in found if section.finished]
    if len(measured) < 2:
        return None
    agents = left_out(len(_agents(measured)), MOST_AGENTS, "agents")
    cut = left_out(len(measured), MOST_EXPERIMENTS, "curricula") + agents
    caption = (
        "Mean return over all tasks of each curriculum at its evaluations, over the frames learned from. Lines: means "
        f"over seeds; bands: {BANDS}; thin lines: single seeds. Dashed: ends of blocks.{cut}"
    )
    shown = measured[:MOST_EXPERIMENTS]
    looks = {agent: agent_style(position, agent) for position, agent in enumerate(_agents(shown)[:MOST_AGENTS])}
    grid = panels(len(shown), COLUMNS, 1.7, sharey=True)
    figure = grid[0, 0].figure
    for axes, section in zip(grid.ravel(), shown, strict=False):
        draw_means(axes, section, looks)
        axes.set_title(short(section.name))
        frames_axis(axes)
    for row in grid:
        row[0].set_ylabel("mean return")
    figure.supxlabel("frames", fontsize=8)
    agents_legend(figure, list(zip(map(short, looks), looks.values(), strict=True)))
    return CaptionedFigure("experiments", "All experiments", caption, figure)


def _agents(found: Sequence[Section]) -> list[str]:
    agents: dict[str, None] = {}
    for section in found:
        agents |= dict.fromkeys(result.agent for result in section.results)
    return list(agents)
