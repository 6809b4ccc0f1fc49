"""The graphs and goals of a curriculum as a figure, with a panel for each graph and without wait states."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.draw.layout import MOST_PATHS, lay_out, write_short
from ctgraph_rl.draw.style import (
    PlanePoint,
    draw_lines,
    goal_mark,
    mark,
    new_figure,
    save_figure,
    shape_of,
    stub_lines,
)
from ctgraph_rl.log.escape import figure_text
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import ct_graphs

MOST_PANELS = 12
MOST_LEVEL = 4

COLUMNS = 3


def draw_graphs(curriculum: Curriculum, path: Path | str) -> None:
    """Draw the graphs and goals of a curriculum.

    Args:
        path: the picture; its ending decides the format.

    Raises:
        ModuleNotFoundError: without matplotlib; names the extra to install.
    """
    goals = goals_by_graph(curriculum)
    panels = list(goals)[:MOST_PANELS]
    columns = min(COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    figure = new_figure(max(4.4 * columns, 6), 3.4 * rows + 0.9)
    left_out = f" ({len(goals) - len(panels)} more graphs not drawn)" if len(goals) > len(panels) else ""
    name = figure_text(curriculum.name)
    figure.suptitle(f"{name}, version {curriculum.version}, {curriculum.fingerprint}{left_out}", fontsize=11)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, graph in zip(axes, panels, strict=False):
        _draw_panel(panel, graph, goals[graph])
    for panel in axes[len(panels) :]:
        panel.axis("off")
    figure.supxlabel("diamond: decision state    square: end state    star: goal, with its decisions", fontsize=9)
    save_figure(figure, path)


def goals_by_graph(curriculum: Curriculum) -> dict[CTGraph, dict[tuple[int, ...], str]]:
    """Return each graph's goals, labelled with decisions and the blocks that train them."""
    blocks: dict[CTGraph, dict[tuple[int, ...], list[int]]] = {}
    for number, block in enumerate(curriculum.blocks, 1):
        for task in dict.fromkeys(ct_graphs(block.tasks, "a figure of graphs")):
            blocks.setdefault(task.graph, {}).setdefault(task.goal, []).append(number)
    labels: dict[CTGraph, dict[tuple[int, ...], str]] = {}
    for graph, goals in blocks.items():
        for goal, of_goal in goals.items():
            labels.setdefault(graph, {})[goal] = f"{write_short(goal)}\n{_write_blocks(sorted(set(of_goal)))}"
    return labels


def _write_blocks(numbers: Sequence[int]) -> str:
    if len(numbers) == 1:
        return f"block {numbers[0]}"
    return f"blocks {', '.join(map(str, numbers))}" if len(numbers) <= 3 else f"{len(numbers)} blocks"


def _draw_panel(axes: Any, graph: CTGraph, goals: Mapping[tuple[int, ...], str]) -> None:
    labels = {graph.node_at(goal): label for goal, label in goals.items()}
    layout = lay_out(graph, list(labels)[:MOST_PATHS])
    shown = [end for end in layout.leaves if end in labels]
    places = {node: (x, -float(layout.level[node])) for node, x in layout.x.items()}
    level = len(layout.leaves) <= MOST_LEVEL
    on_path = set(chain.from_iterable(map(graph.nodes_to, shown)))
    plain = stub_lines(layout, places, 0.45)
    to_goals: list[list[PlanePoint]] = []
    for node, place in places.items():
        if node:
            lines = to_goals if node in on_path else plain
            lines.append([places[graph.parent(node)], place])
    draw_lines(axes, plain, colors="0.6", linewidths=0.8)
    draw_lines(axes, to_goals, linewidths=1.6)
    size = max(3.0, 9.0 - len(layout.leaves) / 6 - graph.depth / 4)
    star = goal_mark(max(2 * size, 9))
    for node, place in places.items():
        style = star if node in shown else mark(layout.kind(node), size)
        axes.plot(*place, zorder=3, clip_on=False, **style)
    for end in shown:  # labels stand upright where there is little room
        words = labels[end] if level else labels[end].replace("\n", "  ")
        axes.annotate(
            words,
            places[end],
            (0, -9),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=7,
            rotation=0 if level else 90,
        )
    some = f", {len(shown)} shown" if len(shown) < len(goals) else ""
    count = f"{len(goals):,} {'goal' if len(goals) == 1 else 'goals'}{some}"
    axes.set_title(f"{shape_of(graph)}: {count}, {graph.num_end_states:,} end states", fontsize=9)
    room = (0.16 if level else 0.32) * graph.depth + 0.2  # for labels, in decisions
    axes.set(xlim=(-0.02, 1.02), ylim=(-graph.depth - room, 0.3))
    axes.axis("off")
