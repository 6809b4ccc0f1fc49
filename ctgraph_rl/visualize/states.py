"""The states of a laid-out tree and the transitions between them, as pictures and DOT files show them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from ctgraph_rl.core.graph import WAIT_ACTION, StateType
from ctgraph_rl.tasks.task import Task
from ctgraph_rl.visualize.layout import Layout

HOME, WAIT, DECISION, END, FAIL = StateType

Key = tuple[StateType, int]
"""A state: its type and its node, the heap index that ``env.node`` gives. Home and fail have node 0."""

HOME_KEY = (HOME, 0)
FAIL_KEY = (FAIL, 0)


class Edge(NamedTuple):
    """A transition that an action makes, waiting in place and failing aside."""

    start: Key
    end: Key
    action: int | None
    """None at home, which any action leaves."""


def kind_of(layout: Layout, node: int) -> StateType:
    """Return whether a node is a decision or an end state."""
    return END if layout.level[node] == layout.graph.depth else DECISION


def states(layout: Layout, waits: bool = True) -> Iterator[Key]:
    """All states drawn but fail, from top to bottom.

    Args:
        layout: what is drawn.
        waits: wait states among them.
    """
    yield HOME_KEY
    for node in layout.x:
        if waits:
            yield WAIT, node
        yield kind_of(layout, node), node


def edges(task: Task, layout: Layout, waits: bool = True) -> Iterator[Edge]:
    """All transitions of a task between them; without wait states, to what these lead to."""
    for node in layout.x:
        here = kind_of(layout, node), node
        above = (DECISION, layout.graph.parent(node)) if node else HOME_KEY
        action = task.decision_to(node) if node else None
        yield Edge(above, (WAIT, node) if waits else here, action)
        if waits:
            yield Edge((WAIT, node), here, WAIT_ACTION)


def ids_at(task: Task, state: Key, level: int) -> tuple[int, int]:
    """The first and the last id that a state may show.

    Args:
        task: any task.
        state: a state of its graph.
        level: the decisions taken before it.
    """
    kind, node = state
    x = task.observations
    graph = task.graph
    first, last = x.ids(kind)
    if not x.is_unique(kind):
        return first, last
    within_level = node - graph.first_node(level)
    number = first + (x.first_of_level(graph, kind, level) + within_level) % (last - first + 1)
    return number, number


def ids_text(task: Task, state: Key, level: int) -> str:
    """An id, or the first and the last one with a dash."""
    first, last = ids_at(task, state, level)
    return str(first) if first == last else f"{first}-{last}"
