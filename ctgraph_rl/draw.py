"""The graphs and goals of a curriculum as a figure, with a panel for each graph.

Of a small tree all decision and end states are drawn; of a large one the ways to some goals, with stubs for the other
branches. Wait states are left out: there is one before each decision and end state.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ctgraph_rl.curriculum import Curriculum
from ctgraph_rl.graph import CTGraph

MOST_PANELS = 12
MOST_LEAVES = 32
"""End states up to which a tree is drawn whole."""
MOST_GOALS = 8
"""Goals that a large graph's panel shows."""
MOST_STUBS = 3
"""Branches not drawn that are hinted at on each side."""
MOST_LEVEL = 4
"""End states up to which labels stand level."""
MOST_DIGITS = 14
"""Characters up to which a goal's decisions are written out."""
COLUMNS = 3

Path_ = tuple[int, ...]
Places = dict[Path_, tuple[float, float]]


def draw_graphs(curriculum: Curriculum, path: Path | str) -> None:
    """Draw the graphs and goals of a curriculum; black and grey on white.

    Args:
        curriculum: any curriculum.
        path: the picture to write; its ending decides the format.

    Raises:
        ModuleNotFoundError: without matplotlib; names the extra to install.
    """
    goals = goals_by_graph(curriculum)
    panels = list(goals)[:MOST_PANELS]
    columns = min(COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    figure = new_figure(max(4.4 * columns, 6), 3.4 * rows + 0.9)
    left_out = f" ({len(goals) - len(panels)} more graphs not drawn)" if len(goals) > len(panels) else ""
    figure.suptitle(f"{curriculum.name}, version {curriculum.version}, {curriculum.fingerprint}{left_out}", fontsize=11)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, graph in zip(axes, panels, strict=False):
        _draw_panel(panel, graph, goals[graph])
    for panel in axes[len(panels) :]:
        panel.axis("off")
    figure.supxlabel("circle: decision state    square: end state    star: goal, with its decisions", fontsize=9)
    figure.savefig(path, dpi=160)


def new_figure(width: float, height: float) -> Any:
    """An empty figure, sizes in inches.

    Raises:
        ModuleNotFoundError: without matplotlib; names the extra to install.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("figures need matplotlib: pip install 'ctgraph_rl[plot]'") from error
    return Figure(figsize=(width, height), layout="constrained")


def goals_by_graph(curriculum: Curriculum) -> dict[CTGraph, dict[Path_, str]]:
    """For each graph its goals, each with a label of its decisions and the blocks that train it."""
    blocks: dict[CTGraph, dict[Path_, list[int]]] = {}
    for number, block in enumerate(curriculum.blocks, 1):
        for task in dict.fromkeys(block.tasks):
            blocks.setdefault(task.graph, {}).setdefault(task.goal, []).append(number)
    return {graph: {goal: _label(goal, of) for goal, of in goals.items()} for graph, goals in blocks.items()}


def _label(goal: Path_, blocks: Sequence[int]) -> str:
    numbers = sorted(set(blocks))
    where = f"blocks {', '.join(map(str, numbers))}" if len(numbers) <= 3 else f"{len(numbers)} blocks"
    where = f"block {numbers[0]}" if len(numbers) == 1 else where
    digits = ("" if max(goal) < 10 else ".").join(map(str, goal))
    if len(digits) > MOST_DIGITS:
        digits = f"{digits[: MOST_DIGITS // 2]}...{digits[-MOST_DIGITS // 2 :]}"
    return f"{digits}\n{where}"


def _draw_panel(axes: Any, graph: CTGraph, goals: Mapping[Path_, str]) -> None:
    whole = graph.num_end_states <= MOST_LEAVES
    shown = list(goals) if whole else sorted(list(goals)[:MOST_GOALS])
    leaves = _leaves(graph) if whole else shown
    level = len(leaves) <= MOST_LEVEL
    places = _places(leaves, graph.depth)
    stubs = [] if whole else _stubs(graph, places, 1 / max(len(leaves), 3))
    ways = {goal[:k] for goal in shown for k in range(graph.depth + 1)}
    _draw_edges(axes, places, stubs, ways)
    _draw_states(axes, graph, places, set(shown), _mark_size(len(leaves), graph.depth))
    for goal in shown:
        _write(axes, places[goal], goals[goal], level=level)
    axes.set_title(_title(graph, len(goals), len(shown)), fontsize=9)
    axes.set(xlim=(-0.02, 1.02), ylim=(-graph.depth - _room(graph.depth, level), 0.3))
    axes.axis("off")


def _title(graph: CTGraph, goals: int, shown: int) -> str:
    shape = f"b={graph.branching_factor}, d={graph.depth}, p={graph.wait_prob:g}"
    some = f", {shown} shown" if shown < goals else ""
    return f"{shape}: {goals:,} {'goal' if goals == 1 else 'goals'}{some}, {graph.num_end_states:,} end states"


def _room(depth: int, level: bool) -> float:
    """Height below the end states for labels, in decisions."""
    return (0.16 if level else 0.32) * depth + 0.2


def _leaves(graph: CTGraph) -> list[Path_]:
    leaves: list[Path_] = [()]
    for _ in range(graph.depth):
        leaves = [(*leaf, decision) for leaf in leaves for decision in range(1, graph.branching_factor + 1)]
    return leaves


def _places(leaves: Sequence[Path_], depth: int) -> Places:
    """Leaves side by side, every other state in the middle of what is below it; x in [0, 1], y the level below 0."""
    places = {leaf: ((i + 0.5) / len(leaves), -float(depth)) for i, leaf in enumerate(leaves)}
    for level in reversed(range(depth)):
        below: dict[Path_, list[float]] = {}
        for path in [path for path in places if len(path) == level + 1]:
            below.setdefault(path[:-1], []).append(places[path][0])
        places |= {path: ((min(xs) + max(xs)) / 2, -float(level)) for path, xs in below.items()}
    return places


def _stubs(graph: CTGraph, places: Places, width: float) -> list[Any]:
    """Short lines from the states drawn towards branches that are not, left or right of those that are."""
    lines = []
    for path, (x, y) in places.items():
        drawn = [place[-1] for place in places if place[:-1] == path and place]
        if drawn:
            left, right = min(drawn) - 1, graph.branching_factor - max(drawn)
            sides = [-1 - k for k in range(min(left, MOST_STUBS))] + [1 + k for k in range(min(right, MOST_STUBS))]
            lines += [[(x, y), (x + side * width / 7, y - 0.45)] for side in sides]
    return lines


def _draw_edges(axes: Any, places: Places, stubs: list[Any], ways: set[Path_]) -> None:
    from matplotlib.collections import LineCollection

    edges = [(path, [places[path[:-1]], place]) for path, place in places.items() if path]
    plain = [line for path, line in edges if path not in ways]
    axes.add_collection(LineCollection([*plain, *stubs], colors="0.6", linewidths=0.8, zorder=1))
    axes.add_collection(LineCollection([line for path, line in edges if path in ways], colors="0", linewidths=1.6))


def _mark_size(leaves: int, depth: int) -> float:
    return max(3.0, 9.0 - leaves / 6 - depth / 4)


def _draw_states(axes: Any, graph: CTGraph, places: Places, goals: set[Path_], size: float) -> None:
    kinds = {
        "o": [place for path, place in places.items() if len(path) < graph.depth],
        "s": [place for path, place in places.items() if len(path) == graph.depth and path not in goals],
        "*": [places[goal] for goal in goals],
    }
    for marker, points in kinds.items():
        if points:
            width, fill = (max(2 * size, 9), "0") if marker == "*" else (size, "1")
            style = {"markersize": width, "markerfacecolor": fill, "markeredgecolor": "0"}
            axes.plot(*zip(*points, strict=True), marker, zorder=3, clip_on=False, **style)


def _write(axes: Any, place: tuple[float, float], text: str, level: bool) -> None:
    """A goal's label below it, upright where there is little room."""
    words = text if level else text.replace("\n", "  ")
    axes.annotate(
        words,
        place,
        xytext=(0, -9),
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize=7,
        rotation=0 if level else 90,
    )
