"""The layout of a tree in a figure: leaves side by side, every other node in the middle of what is below it.

A tree with few end states is laid out whole, a larger one as the paths to some of them. Nodes are heap indices: branch
a of node n is b * n + a, and the root is 0. Time and memory grow with the nodes laid out, not with the tree. The pixels
of `ctgraph_rl.batch.render` have a separate rasteriser and places, for the speed of whole batches.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ctgraph_rl.core.graph import CTGraph

MOST_LEAVES = 32
"""End states up to which a tree is drawn whole."""
MOST_PATHS = 8
"""End states that are drawn of a larger tree."""
MOST_STUBS = 3
"""Branches left out that are hinted at on each side of those drawn."""
MOST_DIGITS = 14
"""Characters up to which the decisions of a path are written out."""


@dataclass(frozen=True)
class Layout:
    """The nodes of a tree that are drawn, and their places.

    Args:
        graph: the tree.
        x: the place of every node drawn, in (0, 1); from top to bottom, and from left to right within a level.
        level: the number of decisions taken at every node drawn.
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
    def stubs(self) -> list[tuple[int, int]]:
        """Hints at branches left out: a node, and how far to the left (below 0) or right of those drawn."""
        b = self.graph.branching_factor
        hints = []
        for node, branches in self._branches().items():
            left = min(branches) - 1
            right = b - max(branches)
            hints += [(node, -1 - k) for k in range(min(left, MOST_STUBS))]
            hints += [(node, 1 + k) for k in range(min(right, MOST_STUBS))]
        return hints

    @property
    def left_out(self) -> dict[int, int]:
        """The number of branches left out at each node where some are."""
        b = self.graph.branching_factor
        return {node: b - len(drawn) for node, drawn in self._branches().items() if len(drawn) < b}

    def _branches(self) -> dict[int, list[int]]:
        """The decisions drawn at each node, in 1..b."""
        branches: dict[int, list[int]] = {}
        for node in self.x:
            if node:
                branches.setdefault(self.graph.parent(node), []).append(self.graph.decision(node))
        return branches


def lay_out(graph: CTGraph, ends: Iterable[int], most_leaves: int = MOST_LEAVES) -> Layout:
    """Place the whole tree, or the paths to some of its end states where it has more than ``most_leaves``.

    Args:
        graph: the tree.
        ends: end states, at least one.
        most_leaves: end states up to which all are drawn.
    """
    first = graph.num_decision_states
    count = graph.num_end_states
    chosen = range(first, first + count) if count <= most_leaves else sorted(set(ends))
    x = {end: (i + 0.5) / len(chosen) for i, end in enumerate(chosen)}
    level = dict.fromkeys(x, graph.depth)
    below = x
    for depth in reversed(range(graph.depth)):
        row: dict[int, list[float]] = {}
        for node, place in below.items():
            row.setdefault(graph.parent(node), []).append(place)
        below = {node: (places[0] + places[-1]) / 2 for node, places in row.items()}
        x = below | x
        level = dict.fromkeys(below, depth) | level
    return Layout(graph, x, level)


def in_digits(decisions: Sequence[int], sign: str = "") -> str:
    """Write decisions in short, as ``121``, or with a sign between them; a dot where one has two digits."""
    text = (sign if max(decisions) < 10 else ".").join(map(str, decisions))
    return text if len(text) <= MOST_DIGITS else f"{text[: MOST_DIGITS // 2]}...{text[-MOST_DIGITS // 2 :]}"
