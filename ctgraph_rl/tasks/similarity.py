"""Similarity of tasks: exact measures of goals, optimal actions, images and graphs, as matrices.

All measures are shares in [0, 1] and symmetric. States of two graphs are matched by the branches that lead to them, in
the *common tree*: branches and depth up to the smaller of both. *Optimal* actions maximise the expected return;
those above a task's branching factor fail. Where nothing is at stake, all actions are optimal. Goals that change, and
noise and rotation on read, are left aside.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import torch
from torch import Tensor

from ctgraph_rl.checks import require, require_all
from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.tasks.images import ImageSet
from ctgraph_rl.tasks.memory import bank_bytes
from ctgraph_rl.tasks.task import Task
from ctgraph_rl.tasks.values import MAX_ENUMERATED_STATES, BestActions, is_needle, smallest_tree

ROUNDING = 1e-9
"""Actions are equally good within this difference, relative to the task's largest value."""

MAX_COMPARED_BYTES = 2**31
"""Largest image set that is compared."""

CHOOSING = (StateType.WAIT, StateType.DECISION)

ON_THE_WAY = 0
ELSEWHERE = 1
"""The two kinds of nodes of a collapsed tree."""

ActionSets = dict[tuple[StateType, int], Tensor]
"""Whether actions are optimal at nodes, by kind and level: bool [nodes, actions]."""


def shared_decisions(tasks: Sequence[Task]) -> Tensor:
    """The first decisions that two goals share, relative to the shorter goal; float64 [T, T].

    1.2.1 and 1.2 share 1.0, 1.2.1 and 1.1.1 share 1/3.

    Example:
        >>> import curricula
        >>> shared_decisions(curricula.load("ct2_interfering").tasks).tolist()
        [[1.0, 0.0], [0.0, 1.0]]
    """

    def share(one: Task, other: Task) -> float:
        shared = 0
        for a, b in zip(one.goal_decisions, other.goal_decisions, strict=False):
            if a != b:
                break
            shared += 1
        return shared / min(len(one.goal), len(other.goal))

    return _matrix(_tasks(tasks), share)


def state_agreement(tasks: Sequence[Task]) -> Tensor:
    """Share of the wait and decision states of the common tree with equal sets of optimal actions; float64 [T, T].

    Two needles take O(depth); other rewards visit every state.

    Raises:
        ValueError: for rewards other than `Needle` beyond `values.MAX_ENUMERATED_STATES` states.
    """

    def share(one: _Choices, other: _Choices) -> float:
        tree = _common(one.task, other.task)
        count = _equal_on_ways if one.collapsed and other.collapsed else _equal_everywhere
        equal = 0
        for kind in CHOOSING:
            for level in range(tree.depth + (kind == StateType.WAIT)):
                equal += count(one, other, kind, level, tree.branching_factor)
        return equal / (tree.num_decision_states + tree.num_wait_states)

    return _matrix(_choices(tasks), share)


def observation_agreement(tasks: Sequence[Task]) -> Tensor:
    """Share of the observations of both tasks whose optimal memoryless actions are equal; float64 [T, T].

    For each image that wait and decision states of both tasks can show, a task leaves the actions that are optimal in
    all of its states that can show it. Tasks agree where they leave the same actions, and any at all: the diagonal is
    below 1 for tasks that need memory. nan where no image is shown in both.

    Raises:
        ValueError: beyond `values.MAX_ENUMERATED_STATES` states where every state has to be visited, and for image sets
            of more than `MAX_COMPARED_BYTES`.
    """

    def share(one: dict[bytes, tuple[bool, ...]], other: dict[bytes, tuple[bool, ...]]) -> float:
        shown = one.keys() & other.keys()
        return sum(one[i] == other[i] and any(one[i]) for i in shown) / len(shown) if shown else math.nan

    found = []
    for choice in _choices(tasks):
        left: dict[bytes, Tensor] = {}  # for each image, the actions that are optimal in all states that show it
        for ids, actions in _shown_with_actions(choice):
            for content in _contents(choice.task, ids):
                left[content] = left.get(content, actions) & actions
        found.append({content: tuple(actions.tolist()) for content, actions in left.items()})
    return _matrix(found, share)


def shared_images(tasks: Sequence[Task]) -> Tensor:
    """Images shown in both tasks as a share of those in either (Jaccard), by content; float64 [T, T].

    Vectors of different lengths are padded with zeros.

    Raises:
        ValueError: for image sets of more than `MAX_COMPARED_BYTES`, and too many states with unique ids.
    """
    shown = []
    for task in _tasks(tasks):
        of_task: set[bytes] = set()
        for kind in StateType:
            of_task.update(_contents(task, _ids(task, kind)))
        shown.append(of_task)
    return _matrix(shown, lambda one, other: len(one & other) / len(one | other))


def graph_containment(tasks: Sequence[Task]) -> Tensor:
    """Share of the smaller graph's decision states that the larger graph has too; float64 [T, T].

    1 if the larger has at least the depth and branching factor of the smaller, whatever their wait probabilities. A
    decision state with branches swapped in one task only is not shared.
    """

    def share(one: Task, other: Task) -> float:
        smaller = min(one.graph.num_decision_states, other.graph.num_decision_states)
        common = _common(one, other)
        b = common.branching_factor
        rewired = set()  # decision states of the common tree that lead elsewhere in one of the tasks
        if one.swapped_branches != other.swapped_branches:
            for swap in filter(None, (one.swapped_branches, other.swapped_branches)):
                path, (first, _) = swap
                if len(path) < common.depth and max((*path, first)) <= b:
                    rewired.add(path)
        return (common.num_decision_states - len(rewired)) / smaller

    return _matrix(_tasks(tasks), share)


MEASURES: dict[str, Callable[[Sequence[Task]], Tensor]] = {
    "shared decisions on the way to the goals": shared_decisions,
    "states with the same optimal actions": state_agreement,
    "observations with the same optimal actions": observation_agreement,
    "shared images": shared_images,
    "containment of the smaller graph": graph_containment,
}


def _tasks(tasks: Sequence[Task]) -> tuple[Task, ...]:
    return require_all(Task, "tasks", tasks)


def _matrix(items: Sequence[Any], share: Callable[[Any, Any], float]) -> Tensor:
    matrix = torch.zeros(len(items), len(items), dtype=torch.float64, device="cpu")
    for i, one in enumerate(items):
        for j, other in enumerate(items[: i + 1]):
            matrix[i, j] = matrix[j, i] = share(one, other)
    return matrix


def _common(one: Task, other: Task) -> CTGraph:
    b = min(one.graph.branching_factor, other.graph.branching_factor)
    return CTGraph(b, min(one.graph.depth, other.graph.depth))


@dataclass(frozen=True)
class _Choices:
    """The optimal actions of a task by kind and level: of every node or, collapsed, on the way and off."""

    task: Task
    sets: ActionSets
    collapsed: bool

    @cached_property
    def goal_nodes(self) -> list[int]:
        graph = self.task.graph
        nodes = graph.nodes_to(graph.node_at(self.task.goal))
        return [node - graph.first_node(level) for level, node in enumerate(nodes)]

    def of_path(self, kind: StateType, path: tuple[int, ...]) -> Tensor:
        """The set at a node of a collapsed tree."""
        level = len(path)
        return self.sets[kind, level][ON_THE_WAY if path == self.task.goal[:level] else ELSEWHERE]

    def of_nodes(self, kind: StateType, level: int, nodes: Tensor) -> Tensor:
        """The sets at nodes by number within a level."""
        if self.collapsed:
            nodes = torch.where(nodes == self.goal_nodes[level], ON_THE_WAY, ELSEWHERE)
        return self.sets[kind, level][nodes]


def _choices(tasks: Sequence[Task]) -> list[_Choices]:
    tasks = _tasks(tasks)
    num_actions = 1 + max(task.graph.branching_factor for task in tasks)
    return [_Choices(task, _optimal_sets(task, num_actions), is_needle(task)) for task in tasks]


def _optimal_sets(task: Task, num_actions: int) -> ActionSets:
    tree = smallest_tree(task, is_needle(task))
    best = BestActions(task, gamma=1.0)
    step = task.step_reward
    fails = best.failing
    steps = 2 * (task.graph.depth + 1) / (1 - task.graph.wait_prob)
    margin = ROUNDING * (abs(task.goal_reward) + abs(task.fail_reward) + abs(step) * steps)  # of the largest value
    arrival = tree.end_rewards() + (step if task.extra_end_step else 0.0)
    sets = {}
    for level in reversed(range(task.graph.depth + 1)):
        sets[StateType.WAIT, level] = _best(best.waiting(arrival).unsqueeze(-1), fails, num_actions, 0, margin)
        if level > 0:
            children = tree.children(best.at_wait(arrival, level), level - 1)
            deciding = step + children
            sets[StateType.DECISION, level - 1] = _best(deciding, fails, num_actions, 1, margin)
            arrival = best.at_decision(children, level - 1)
    return sets


def _best(values: Tensor, fails: float, num_actions: int, first: int, margin: float) -> Tensor:
    """The sets of best actions: ``values`` [n, m] are those from ``first`` on; any other fails."""
    best = values.amax(-1, keepdim=True).clamp_min(fails) - margin
    sets = (fails >= best).repeat(1, num_actions)
    sets[:, first : first + values.shape[1]] = values >= best
    return sets


def _equal_on_ways(one: _Choices, other: _Choices, kind: StateType, level: int, b: int) -> int:
    """Equal states of a level: those on the ways to two needles singly, all others at once."""
    ways = {one.task.goal[:level], other.task.goal[:level]}
    inside = [path for path in ways if max(path, default=1) <= b]
    equal = sum(one.of_path(kind, path).equal(other.of_path(kind, path)) for path in inside)
    others_equal = one.sets[kind, level][ELSEWHERE].equal(other.sets[kind, level][ELSEWHERE])
    return equal + (b**level - len(inside)) * others_equal


def _equal_everywhere(one: _Choices, other: _Choices, kind: StateType, level: int, b: int) -> int:
    sets = []
    for choice in (one, other):
        nodes = torch.zeros(1, dtype=torch.int64, device="cpu")
        for _ in range(level):
            below = choice.task.graph.branching_factor * nodes.unsqueeze(1)
            nodes = (below + torch.arange(b, device="cpu")).flatten()
        sets.append(choice.of_nodes(kind, level, nodes))
    return int((sets[0] == sets[1]).all(1).sum())


def _shown_with_actions(choice: _Choices) -> Iterator[tuple[Sequence[int], Tensor]]:
    task = choice.task
    for kind in CHOOSING:
        for level in _levels(task, kind):
            if not task.observations.is_unique(kind):
                sets = choice.sets[kind, level]
                yield _ids(task, kind), sets[: len(sets) if level else 1].all(0)
                continue
            ids = _unique_ids(task, kind, level)
            sets = choice.of_nodes(kind, level, torch.arange(len(ids), device="cpu"))
            for number, actions in zip(ids, sets, strict=True):
                yield [number], actions


def _ids(task: Task, kind: StateType) -> Sequence[int]:
    first, last = task.observations.ids(kind)
    if not task.observations.is_unique(kind):
        return range(first, last + 1)
    ids = []
    for level in _levels(task, kind):
        ids += _unique_ids(task, kind, level)
    return ids


def _levels(task: Task, kind: StateType) -> range:
    depth = task.graph.depth
    if kind == StateType.WAIT:
        return range(depth + 1)
    return range(depth) if kind == StateType.DECISION else range(depth, depth + 1)


def _unique_ids(task: Task, kind: StateType, level: int) -> list[int]:
    graph = task.graph
    states = graph.num_states
    limit = MAX_ENUMERATED_STATES
    require((states <= limit, f"unique ids on this graph need a visit to each of its {states} states, limit {limit}"))
    number = torch.arange(graph.branching_factor**level, device="cpu")
    return task.observations.unique_id(graph, kind, level, number).tolist()


def _contents(task: Task, ids: Sequence[int]) -> Iterator[bytes]:
    needed = bank_bytes([task])
    variants = task.images.num_variants
    rule = f"images of {needed:,} bytes are too many to compare, the limit is {MAX_COMPARED_BYTES:,}; use fewer"
    require((needed <= MAX_COMPARED_BYTES, rule))
    digests = _digests(task.images)  # type: ignore[arg-type]
    for i in ids:
        yield from digests[i * variants : (i + 1) * variants]


@lru_cache(maxsize=256)
def _digests(images: ImageSet) -> list[bytes]:
    rows = images.bank(0).numpy()
    vectors = rows.ndim == 2
    shape = repr(rows.shape[2:]).encode()
    digests = []
    for row in rows:
        content = row.tobytes().rstrip(b"\0") if vectors else shape + row.tobytes()
        digests.append(hashlib.blake2b(content, digest_size=16).digest())
    return digests
