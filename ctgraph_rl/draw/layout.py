"""The layout of a tree for all pictures: leaves side by side, other nodes in the middle above.

A small tree is laid out whole, a larger one as the paths to some nodes. Nodes are heap indices: branch a of node n is b
* n + a, and the root is 0. Time and memory grow with the nodes laid out only.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ctgraph_rl.core.goal import write_goal
from ctgraph_rl.core.graph import WAIT_ACTION, CTGraph, StateType
from ctgraph_rl.tasks.task import Task

HOME, WAIT, DECISION, END, FAIL = StateType

Key = tuple[StateType, int]
"""A state: its type and its node, a heap index as in ``env.node``; home and fail have node 0."""

HOME_KEY = (HOME, 0)
FAIL_KEY = (FAIL, 0)

MOST_LEAVES = 32
MOST_PATHS = 8
MOST_STUBS = 3
"""Stubs of left-out branches on each side of those drawn."""
MOST_DECISIONS = 8


class Edge(NamedTuple):
    """The transition of an action; waiting stays in place, failing leads aside."""

    start: Key
    end: Key
    action: int | None
    """None at home, which any action leaves."""


@dataclass(frozen=True)
class Layout:
    """The nodes of a tree that are drawn, and their places.

    Args:
        x: of every node drawn, in (0, 1); top to bottom, then left to right.
        level: decisions taken at every node drawn.
    """

    graph: CTGraph
    x: dict[int, float]
    level: dict[int, int]

    @property
    def leaves(self) -> list[int]:
        """The end states drawn."""
        return [node for node, level in self.level.items() if level == self.graph.depth]

    @property
    def is_whole(self) -> bool:
        """Whether every end state is drawn."""
        return len(self.leaves) == self.graph.num_end_states

    @property
    def stubs(self) -> list[tuple[int, float]]:
        """Stubs of left-out branches: a node, and the x of a branch left or right of those drawn."""
        b = self.graph.branching_factor
        reach = 2 / max(len(self.leaves), 3) / 7
        hints = []
        for node, branches in self._branches().items():
            if branches:
                first = self.x[b * node + branches[0]]
                last = self.x[b * node + branches[-1]]
                hints += [(node, first - reach * k) for k in range(1, min(branches[0] - 1, MOST_STUBS) + 1)]
                hints += [(node, last + reach * k) for k in range(1, min(b - branches[-1], MOST_STUBS) + 1)]
            else:
                count = min(b, 2 * MOST_STUBS)
                hints += [(node, self.x[node] + reach * (k - (count - 1) / 2)) for k in range(count)]
        return hints

    @property
    def left_out(self) -> dict[int, int]:
        """The number of branches left out by node."""
        b = self.graph.branching_factor
        return {node: b - len(drawn) for node, drawn in self._branches().items() if len(drawn) < b}

    def _branches(self) -> dict[int, list[int]]:
        branches: dict[int, list[int]] = {node: [] for node, level in self.level.items() if level < self.graph.depth}
        for node in self.x:
            if node:
                branches[self.graph.parent(node)].append(self.graph.decision(node))
        return branches

    def kind(self, node: int) -> StateType:
        """Return whether a node is a decision or an end state."""
        return END if self.level[node] == self.graph.depth else DECISION

    def states(self, waits: bool = True) -> Iterator[Key]:
        """Yield all states drawn but fail, from top to bottom, with or without wait states."""
        yield HOME_KEY
        for node in self.x:
            if waits:
                yield WAIT, node
            yield self.kind(node), node

    def edges(self, task: Task, waits: bool = True) -> Iterator[Edge]:
        """Yield all transitions between states; without wait states, to what these lead to."""
        for node in self.x:
            here = self.kind(node), node
            above = (DECISION, self.graph.parent(node)) if node else HOME_KEY
            action = task.decision_to(node) if node else None
            yield Edge(above, (WAIT, node) if waits else here, action)
            if waits:
                yield Edge((WAIT, node), here, WAIT_ACTION)


def lay_out(graph: CTGraph, ends: Iterable[int], most_leaves: int = MOST_LEAVES) -> Layout:
    """Place the whole tree, or the paths to some nodes if it has more than ``most_leaves`` end states.

    Args:
        ends: nodes, at least one.
        most_leaves: end states up to which all are drawn.
    """
    first = graph.num_decision_states
    count = graph.num_end_states
    if count <= most_leaves:
        tips = dict.fromkeys(range(first, first + count), graph.depth)
    else:
        paths = [graph.nodes_to(end) for end in set(ends)]
        inner = {node for path in paths for node in path[:-1]}
        last = [path for path in paths if path[-1] not in inner]
        tips = {path[-1]: len(path) - 1 for path in sorted(last, key=lambda path: graph.path(path[-1]))}
    x = {node: (i + 0.5) / len(tips) for i, node in enumerate(tips)}
    rows: list[list[int]] = []
    below: list[int] = []
    for depth in reversed(range(graph.depth + 1)):
        children: dict[int, list[float]] = {}
        for node in below:
            children.setdefault(graph.parent(node), []).append(x[node])
        for node, places in children.items():
            x[node] = (places[0] + places[-1]) / 2
        below = sorted([*children, *(node for node, level in tips.items() if level == depth)])
        rows.append(below)
    level = {node: depth for depth, row in enumerate(reversed(rows)) for node in row}
    return Layout(graph, {node: x[node] for node in level}, level)


def shown_ids(task: Task, state: Key, level: int) -> tuple[int, int]:
    """Return the first and last id that a state may show.

    Args:
        state: a state of its graph.
        level: the decisions taken before it.
    """
    kind, node = state
    if not task.observations.is_unique(kind):
        return task.observations.ids(kind)
    number = task.observations.unique_id(task.graph, kind, level, node - task.graph.first_node(level))
    return number, number


def write_ids(task: Task, state: Key, level: int) -> str:
    """Return an id, or the first and last one with a dash; arguments as `shown_ids`."""
    first, last = shown_ids(task, state, level)
    return str(first) if first == last else f"{first}-{last}"


def write_short(goal: Sequence[int]) -> str:
    """Write a goal as ``1.2``, without its middle where it is long."""
    if len(goal) <= MOST_DECISIONS:
        return write_goal(goal)
    end = MOST_DECISIONS // 2
    return f"{write_goal(goal[:end])} ... {write_goal(goal[-end:])}"
