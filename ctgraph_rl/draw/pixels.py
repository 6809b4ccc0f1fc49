"""Pictures of a batch's rows: the observation on the left, the tree and the position in it on the right.

Trees are placed in pixels, drawn at twice the size in palette numbers, then reduced to RGB by the mean of 2x2 pixels.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ctgraph_rl.checks import is_int, require, takes_numbers
from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.draw.layout import DECISION, END, FAIL, FAIL_KEY, HOME, HOME_KEY, WAIT, Key, lay_out
from ctgraph_rl.tasks.task import Task

STATE_COLOURS: dict[StateType, tuple[int, int, int]] = {
    StateType.HOME: (0, 114, 178),
    StateType.WAIT: (86, 180, 233),
    StateType.DECISION: (230, 159, 0),
    StateType.END: (0, 158, 115),
    StateType.FAIL: (213, 94, 0),
}
"""Blue, sky blue, orange, bluish green and vermillion of Okabe and Ito, distinct with any colour vision."""

BACKGROUND = 5
EDGE = 6
GOAL = 7
OUTLINE = 8
WAY = 9
EXTRA_COLOURS = ((255, 255, 255), (176, 176, 176), (204, 121, 167), (0, 0, 0), (0, 0, 0))
PALETTE = np.array([*STATE_COLOURS.values(), *EXTRA_COLOURS], np.uint16)
"""Colours by number; a state type's number is its value."""
PANEL_GREY = 208
OFF_GREY = 64  # around an observation, and where a one-hot vector is 0
MIN_SIZE = 48
SCALE = 2  # of a picture in pixels, and of its canvas relative to it
LEAF_WIDTH = 6  # a tree with more than size // LEAF_WIDTH end states is drawn as a summary


class Mark(NamedTuple):
    """Centre and radius of a drawn state in pixels."""

    x: float
    y: float
    radius: float


Pixels = NDArray[np.uint8]
MarkLine = tuple[Mark, Mark]


@takes_numbers
def render(
    tasks: Sequence[Task], state_type: Tensor, node: Tensor, goal_leaf: Tensor, observation: Tensor, size: int = 192
) -> Tensor:
    """Draw every row: its observation and its tree with the goal and the current position.

    A star is below the goal, a thick dark line is the way so far, and a black outline the current state. On failure the
    outline is around the fail mark, top right. A cross is at the decision state, also for the wait state before it, or
    at the wait state before an end. A small cross marks swapped branches. Trees that are too wide show the paths to the
    current node and the goal, with stubs.

    Args:
        state_type: int64 [N], values of `StateType`.
        node: int64 [N], heap indices of the positions.
        goal_leaf: int64 [N], numbers of the end states with the goal.
        observation: uint8 [N, 1, r, r], or [N, K] when one-hot.
        size: height of a picture in pixels, at least 48.

    Returns:
        uint8 [N, size, 2 * size, 3] on the CPU.

    Raises:
        ValueError: for no rows, different numbers of rows, and a wrong shape or size.
    """
    n = len(tasks)
    lengths = [len(tensor) for tensor in (state_type, node, goal_leaf, observation)]
    require(
        (n > 0 and set(lengths) == {n}, f"render needs N >= 1 rows of each, got {n} and {lengths}"),
        (observation.ndim in (2, 4), f"observation must be [N, 1, r, r] or [N, K], got {list(observation.shape)}"),
        (is_int(size, MIN_SIZE), f"size must be an integer >= {MIN_SIZE}, got {size!r}"),
    )
    pictures = np.full((n, size, 2 * size, 3), PANEL_GREY, np.uint8)
    _show(pictures[:, :, :size], observation.detach().cpu().numpy())
    states = zip(state_type.tolist(), node.tolist(), goal_leaf.tolist(), strict=True)
    for picture, task, state in zip(pictures, tasks, states, strict=True):
        canvas = _draw_row(task, *state, size)
        packed = np.pad(PALETTE, ((0, 0), (0, 1))).view(np.uint64)[:, 0]
        parts = packed[canvas].reshape(len(canvas) // SCALE, SCALE, -1, SCALE)
        total = parts[:, 0, :, 0] + parts[:, 0, :, 1] + parts[:, 1, :, 0] + parts[:, 1, :, 1]
        channels = total.view(np.uint16).reshape(*total.shape, 4)[..., :3]
        picture[:, size:] = (channels // SCALE**2).astype(np.uint8)
    return torch.from_numpy(pictures)


def _show(panels: Pixels, observation: Pixels) -> None:
    one_hot = observation.ndim == 2
    size = panels.shape[1]
    if one_hot:
        n, entries = observation.shape
        columns = math.ceil(math.sqrt(entries))
        rows = math.ceil(entries / columns)
        grid = np.full((n, rows * columns), PANEL_GREY, np.uint8)
        grid[:, :entries] = np.where(observation != 0, 255, OFF_GREY)
        images = grid.reshape(n, rows, columns)
    else:
        images = observation[:, 0]
    room = size - 2 * (size // 16)
    longest = max(images.shape[1:])
    for axis, length in enumerate(images.shape[1:], 1):
        if longest > room:
            images = np.maximum.reduceat(images, np.arange(length * room // longest) * longest // room, axis)
        images = images.repeat(max(room // longest, 1), axis)
    if one_hot and room >= 4 * longest:
        cell = room // longest
        images[:, ::cell] = PANEL_GREY
        images[:, :, ::cell] = PANEL_GREY
    height, width = images.shape[1:]
    top = (size - height) // 2
    left = (size - width) // 2
    panels[:, top : top + height, left : left + width] = images[..., None]


def _draw_row(task: Task, kind: int, node: int, goal_leaf: int, size: int) -> Pixels:
    graph = task.graph
    unit = size / 192
    is_leaf = node >= graph.num_decision_states
    goal = graph.num_decision_states + goal_leaf
    whole = graph.num_end_states <= size // LEAF_WIDTH
    base, marks = _picture(graph, size, () if whole else (node, goal))
    canvas = base.copy()
    failed = kind == FAIL
    shown_kind = WAIT if is_leaf else DECISION
    place = marks[shown_kind if failed else StateType(kind), node]
    way = [marks[DECISION, passed] for passed in graph.nodes_to(node)[:-1]]
    _lines(canvas, pairwise([marks[HOME_KEY], *way, place]), 2 * unit, WAY)
    mark = marks[END, goal]
    x = mark.x
    y = mark.y + mark.radius + 10.5 * unit
    reach = 5.5 * unit
    points = []
    for k in range(6):
        turn = 0.8 * math.pi * k
        points.append(Mark(x + reach * math.sin(turn), y - reach * math.cos(turn), 0))
    _lines(canvas, pairwise(points), 1.5 * unit, GOAL)
    _discs(canvas, [Mark(x, y, 2 * unit)], GOAL)
    swap = marks.get((DECISION, -1 if task.swapped_node is None else task.swapped_node))
    if swap is not None:
        _cross(canvas, swap, 0.6 * swap.radius, unit, OUTLINE)
    if failed:
        _cross(canvas, place, place.radius + 2.5 * unit, 2 * unit, kind)
    current = marks[FAIL_KEY] if failed else place
    outline = _ring(current.radius + 2 * unit, current.radius + 4.5 * unit)
    _fill(canvas, np.array([current[:2]]), outline, OUTLINE)
    return canvas


@lru_cache(maxsize=128)
def _picture(graph: CTGraph, size: int, nodes: tuple[int, ...]) -> tuple[Pixels, dict[Key, Mark]]:
    gap = 0.785 * size / (graph.depth + 1)
    home = Mark(size / 2, size / 14, min(size / 32, 0.5 * gap))
    fail = Mark(size * 0.925, size * 0.075, size / 25)
    layout = lay_out(graph, nodes, size // LEAF_WIDTH)
    widths = Counter(layout.level.values())
    marks = {HOME_KEY: home, FAIL_KEY: fail}
    edges = []
    for node, x in layout.x.items():
        level = layout.level[node]
        radius = min(size / 32, 0.3 * gap, 0.39 * size / widths[level])
        mark = Mark(x * size, home.y + gap * (level + 1), radius)
        above = marks[DECISION, graph.parent(node)] if node else home
        marks[layout.kind(node), node] = mark
        marks[WAIT, node] = Mark((above.x + mark.x) / 2, (above.y + mark.y) / 2, 0.6 * min(above.radius, mark.radius))
        edges.append((above, mark))
    stubs = []
    for node, x in layout.stubs:
        start = marks[DECISION, node]
        end = Mark(start.x + 0.75 * (x * size - start.x), start.y + 0.5 * gap, 0.6 * start.radius)
        stubs.append((start, end))
    canvas = np.full((SCALE * size, SCALE * size), BACKGROUND, np.uint8)
    _lines(canvas, [*edges, *stubs], size / 192, EDGE)
    _discs(canvas, [end for _, end in stubs], WAIT)
    for kind in (WAIT, DECISION, END, HOME, FAIL):
        _discs(canvas, [mark for (of_kind, _), mark in marks.items() if of_kind == kind], kind)
    _cross(canvas, fail, size / 60, size / 96, BACKGROUND)
    return canvas, marks


def _cross(canvas: Pixels, mark: Mark, reach: float, width: float, colour: int) -> None:
    lines = []
    for x in (-reach, reach):
        lines.append((Mark(mark.x - x, mark.y - reach, 0), Mark(mark.x + x, mark.y + reach, 0)))
    _lines(canvas, lines, width, colour)


@lru_cache(maxsize=1024)
def _ring(inner: float, outer: float) -> NDArray[np.int64]:
    reach = math.ceil(outer * SCALE)
    axis = np.arange(-reach, reach + 1) / SCALE
    distance = np.hypot(axis[:, None], axis)
    return np.argwhere((distance > inner) & (distance <= outer)) - reach


def _fill(canvas: Pixels, centres: NDArray[np.float64], offsets: NDArray[np.int64], colour: int) -> None:
    middles = (centres * SCALE).round().astype(np.int64)
    points = (middles[:, None] + offsets).reshape(-1, 2).T
    inside = (points.min(0) >= 0) & (points.max(0) < len(canvas))
    x, y = points[:, inside]
    if colour == WAY:
        free = canvas[y, x] >= BACKGROUND
        x = x[free]
        y = y[free]
    canvas[y, x] = colour


def _discs(canvas: Pixels, marks: list[Mark], colour: int) -> None:
    circles = np.array(marks).reshape(-1, 3)
    for radius in np.unique(circles[:, 2]).tolist():
        _fill(canvas, circles[circles[:, 2] == radius, :2], _ring(-1, radius), colour)


def _lines(canvas: Pixels, lines: Iterable[MarkLine], width: float, colour: int) -> None:
    ends = np.array(list(lines))[..., :2]
    start = ends[:, 0]
    way = ends[:, 1] - start
    steps = math.ceil(SCALE * abs(way).max()) + 1
    points = start + np.linspace(0, 1, steps)[:, None, None] * way
    _fill(canvas, points.reshape(-1, 2), _ring(-1, width / 2), colour)
