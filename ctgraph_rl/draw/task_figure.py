"""A figure of one task: its graph with what its states show, or what a policy does there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ctgraph_rl.core.graph import WAIT_ACTION, StateType
from ctgraph_rl.draw.layout import (
    DECISION,
    END,
    FAIL,
    FAIL_KEY,
    HOME,
    HOME_KEY,
    MOST_LEAVES,
    MOST_PATHS,
    WAIT,
    Edge,
    Key,
    lay_out,
    write_ids,
    write_short,
)
from ctgraph_rl.draw.style import PlanePoint, colour, draw_lines, goal_mark, mark, new_figure, shape_of, stub_lines
from ctgraph_rl.tasks.task import Task

Counted = Mapping[Any, float]
PerAction = Mapping[Any, Any]

ROOM, ROOM_FOR_NUMBERS = 30.0, 50.0
"""Points between end states from which actions, loops and ways to fail are drawn, and numbers at them."""
MOST_WAIT_LEVELS = 6

LARGEST_MARK = 24.0
LEGEND_WIDTH = 5.5

SMALLEST_TEXT = 4.0
INITIALS = {kind: kind.name[0] for kind in StateType}
GREY = "0.65"
DASHES = (0, (2, 1))
RING: dict[str, Any] = {"marker": "o", "markerfacecolor": "none", "markeredgecolor": "0", "linestyle": "none"}


def task_figure(task: Task, **overlays: Any) -> Any:
    """Return a new figure of a size that fits `draw_task`, with the same arguments."""
    graph = task.graph
    side_by_side = graph.num_end_states if graph.num_end_states <= MOST_LEAVES else MOST_PATHS
    beside = 0.9 if overlays.get("policy") else 0.65
    width = min(max(5.5, beside * side_by_side), 14.0)
    figure = new_figure(width, 1.2 + 0.75 * min(2 * graph.depth + 2, 9))
    draw_task(figure.subplots(), task, **overlays)
    return figure


def draw_task(
    axes: Any,
    task: Task,
    visits: Counted | None = None,
    policy: PerAction | None = None,
    ids: bool = True,
    legend: bool = True,
) -> None:
    """Draw a task's graph: each state in the colour and shape of its kind, and a star at the goal.

    Wait states that may last have a loop; dashed arrows are actions that fail. Nodes hold ids of observations, the
    first and last where one is drawn. Beyond 32 end states only the paths to the goal and the most visited ones are
    drawn.

    States are keys (state type, node), as in ``env.state_type`` and ``env.node``; home and fail have node 0. States
    missing in a mapping have no overlay.

    Args:
        axes: matplotlib axes, at their final size.
        visits: how often each state was visited, from `ctgraph_rl.play.visits.visits`: numbers in the nodes instead of
            ids, and the width of edges.
        policy: b + 1 action probabilities of each state: numbers at edges; the likeliest action is black.
        ids: observation ids in the nodes; False: initials of the kinds.
        legend: name shapes and colours below the tree.
    """
    _TaskPicture(axes, task, visits or {}, policy=policy or {}, ids=ids).draw(legend)


class _TaskPicture:
    def __init__(self, axes: Any, task: Task, visits: Counted, policy: PerAction, ids: bool) -> None:
        self.axes = axes
        self.task = task
        self.visits = visits
        self.ids = ids
        self.graph = task.graph
        self.goal = task.graph.node_at(task.goal)
        self.policy = {key: [float(chance) for chance in of] for key, of in policy.items()}
        counts = {}
        for (kind, node), count in visits.items():
            if kind == END and node != self.goal:
                counts[node] = count
        most_visited = sorted(counts, key=lambda node: -counts[node])[: MOST_PATHS - 1]
        self.layout = lay_out(self.graph, [self.goal, *most_visited])
        self.waits = self.layout.is_whole or self.graph.depth <= MOST_WAIT_LEVELS
        self.places = {state: self._place(state) for state in self.layout.states(self.waits)}
        box = self.axes.get_window_extent()
        points = 72 / self.axes.figure.dpi
        beside = points * box.width / len(self.layout.leaves)
        below = points * box.height / (self.height + 2)
        share = 0.52 if beside >= ROOM else 0.75
        self.size = max(2.0, min(LARGEST_MARK, share * beside, 0.55 * below))
        self.has_room = beside >= ROOM
        self.has_numbers = beside >= ROOM_FOR_NUMBERS

    def _place(self, state: Key) -> PlanePoint:
        """x in (0, 1), y a row of states below 0."""
        kind, node = state
        x = self.layout.x[node]
        if kind == HOME:
            return x, 0.0
        rows = self.layout.level[node] + 1
        return x, -float(2 * rows - (kind == WAIT) if self.waits else rows)

    @property
    def height(self) -> float:
        """Rows of states below home."""
        return -min(y for _, y in self.places.values())

    def draw(self, legend: bool) -> None:
        self._draw_edges()
        self._draw_states()
        self._draw_goal()
        if self.has_room:
            if self.graph.wait_prob > 0:
                points = [place for (kind, _), place in self.places.items() if kind == WAIT]
                ring = RING | {"markersize": 0.7 * self.size, "transform": self._moved(x=-0.55 * self.size)}
                self.axes.plot(*zip(*points, strict=True), zorder=2, **ring)
            self._draw_ways_to_fail()
        title = f"{shape_of(self.graph)}, goal {write_short(self.task.goal)}"
        if not self.layout.is_whole:
            waits = "" if self.waits else ", wait states left out"
            title += f"\n{len(self.layout.leaves)} of {self.graph.num_end_states:,} end states drawn{waits}"
        self.axes.set_title(title, fontsize=9)
        self.axes.set(xlim=(-0.02, 1.02), ylim=(-self.height - 0.9, 0.6))
        self.axes.axis("off")
        if legend:
            self._draw_legend()

    def _draw_edges(self) -> None:
        found = sorted(self.layout.edges(self.task, self.waits), key=self._is_strong)
        lines = []
        colours = []
        widths = []
        for edge in found:
            lines.append([self.places[edge.start], self.places[edge.end]])
            colours.append("0" if self._is_strong(edge) else GREY)
            widths.append(self._width(edge))
        draw_lines(self.axes, lines, colors=colours, linewidths=widths)
        row = 1.0 if self.waits else 0.5
        nodes = {node: place for (kind, node), place in self.places.items() if kind == DECISION}
        draw_lines(self.axes, stub_lines(self.layout, nodes, 0.7 * row), colors=GREY, linewidths=0.8)
        if self.has_room:
            for edge, ((x, y), (end_x, end_y)) in zip(found, lines, strict=True):
                if edge.action is not None:
                    numbers = self._numbers(edge.start, (edge.action,))
                    words = f"{edge.action}" + (f": {numbers}" if numbers else "")
                    box = {"facecolor": "1", "edgecolor": "none", "pad": 0.6}
                    middle = (x + 0.55 * (end_x - x), y + 0.55 * (end_y - y))
                    self.axes.text(*middle, words, fontsize=6.5, ha="center", va="center", bbox=box, zorder=2)

    def _is_strong(self, edge: Edge) -> bool:
        chances = self.policy.get(edge.start)
        if chances is not None and edge.action is not None:
            return chances[edge.action] == max(chances)
        if self.visits or self.policy:
            return bool(self.visits.get(edge.end, 0))
        return edge.end[1] in self.graph.nodes_to(self.goal)

    def _width(self, edge: Edge) -> float:
        if self.visits:
            return 0.8 + 3.2 * min(1.0, self.visits.get(edge.end, 0) / max(1, self.visits.get(HOME_KEY, 1)))
        if edge.start in self.policy and edge.action is not None:
            return 0.8 + 2 * self.policy[edge.start][edge.action]
        return 1.6 if self._is_strong(edge) else 0.8

    def _numbers(self, state: Key, actions: Sequence[int]) -> str:
        if not self.has_numbers or state not in self.policy:
            return ""
        return f"{sum(_pick(self.policy[state], actions)):.2f}"

    def _draw_states(self) -> None:
        for state, place in (*self.places.items(), (FAIL_KEY, (0.97, 0.0))):
            kind, _ = state
            self.axes.plot(*place, zorder=3, clip_on=False, **mark(kind, self.size))
            words = self._words(state)
            fits = min(8.0, 1.25 * self.size / max(len(words), 2))
            if fits >= SMALLEST_TEXT:
                ink = "1" if kind == HOME else "0"
                self.axes.text(*place, words, fontsize=fits, color=ink, ha="center", va="center", zorder=4)

    def _words(self, state: Key) -> str:
        if self.visits:
            return _short(self.visits.get(state, 0))
        return write_ids(self.task, state, self.layout.level[state[1]]) if self.ids else INITIALS[state[0]]

    def _draw_goal(self) -> None:
        size = max(7.0, min(13.0, self.size))
        drop = -0.5 * self.size - 0.6 * size
        self.axes.plot(
            *self.places[END, self.goal],
            transform=self._moved(y=drop),
            zorder=3,
            clip_on=False,
            **goal_mark(size),
        )
        for end in () if self.layout.is_whole else self.layout.leaves:
            under = 0, drop - 0.6 * size
            path = write_short(self.graph.path(end))
            self._note(path, self.places[END, end], under, fontsize=6, ha="center", va="top")

    def _moved(self, x: float = 0.0, y: float = 0.0) -> Any:
        from matplotlib.transforms import offset_copy

        return offset_copy(self.axes.transData, fig=self.axes.figure, x=x, y=y, units="points")

    def _draw_ways_to_fail(self) -> None:
        base = {"arrowstyle": "<|-", "linestyle": DASHES, "color": colour(FAIL), "shrinkB": 0, "mutation_scale": 6}
        for (kind, node), place in self.places.items():
            if kind in (WAIT, DECISION):
                b = self.graph.branching_factor
                right = (WAIT_ACTION,) if kind == WAIT else range(1, b + 1)
                most = max(b + 1, len(self.policy.get((kind, node), ())))
                wrong = [action for action in range(most) if action not in right]
                arrow = base | {"linewidth": 0.8 + 2 * sum(_pick(self.policy.get((kind, node), ()), wrong))}
                self._note("", place, (1.1 * self.size, 0), arrowprops=arrow, zorder=2)
                numbers = self._numbers((kind, node), wrong)
                side = -1 if kind == WAIT else 1  # away from branches
                beside = "top" if kind == WAIT else "bottom"
                shift = (0.55 * self.size, 3 * side)
                self._note(numbers, place, shift, va=beside, fontsize=6, color=colour(FAIL))

    def _note(self, words: str, place: PlanePoint, shift: PlanePoint, **style: Any) -> None:
        self.axes.annotate(words, place, xytext=shift, textcoords="offset points", **style)

    def _draw_legend(self) -> None:
        from matplotlib.lines import Line2D

        kinds = [kind for kind in StateType if kind != WAIT or self.waits]
        marks = [Line2D([], [], label=kind.name.lower(), **mark(kind, 7)) for kind in kinds]
        marks.append(Line2D([], [], label="goal", **goal_mark(10)))
        if self.has_room:
            marks.append(Line2D([], [], label="a wrong action", color=colour(FAIL), linestyle=DASHES, linewidth=1))
        if self.has_room and self.graph.wait_prob > 0:
            marks.append(Line2D([], [], label="stays with p", markersize=6, **RING))
        spec = self.axes.get_subplotspec()
        width = self.axes.figure.get_figwidth() / (1 if spec is None else spec.get_gridspec().ncols)
        nodes = "visits" if self.visits else "observation ids" if self.ids else ""
        numbers = ["probability"] if self.policy and self.has_numbers else []
        at_edges = f"at edges: {', '.join(['action', *numbers])}" if self.has_room else ""
        black = "black: the likeliest action" if self.policy else ""
        meaning = "; ".join(filter(None, [f"in nodes: {nodes}" if nodes else "", at_edges, black]))
        self.axes.legend(
            handles=marks,
            ncols=math.ceil(len(marks) / math.ceil(LEGEND_WIDTH / width)),
            loc="upper center",
            bbox_to_anchor=(0.5, 0.02),
            fontsize=7,
            frameon=False,
            title=meaning,
            title_fontsize=7,
            handletextpad=0.3,
            columnspacing=1.0,
        )


def _pick(numbers: Sequence[float], actions: Sequence[int]) -> list[float]:
    return [numbers[action] for action in actions if action < len(numbers)]


def _short(count: float) -> str:
    if count >= 1e6:
        return f"{count / 1e6:.0f}M"
    return f"{count / 1e3:.0f}k" if count >= 1e4 else f"{count:.4g}"
