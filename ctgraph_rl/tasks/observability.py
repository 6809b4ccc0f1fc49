"""How much of its state a task shows: states per observation, and the entropy of the state given the observation.

Observations are ids: noise and rotation on read are left out. Every observation of an episode counts, the last one in
the fail state or an end state, too, but not that of the home state after an ``extra_end_step``. Ids of different kinds
of states never overlap, so an observation says the kind of its state, and all that is open is the place in the
tree. Levels count decisions: level k has b^k wait states and, below the depth, b^k decision states.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from ctgraph_rl.checks import require
from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.tasks.task import Task

POLICIES: dict[str, Callable[[CTGraph], tuple[float, float, bool]]] = {
    "random": lambda graph: (
        1 / (graph.branching_factor + 1),
        graph.branching_factor / (graph.branching_factor + 1),
        False,
    ),
    "navigation": lambda graph: (1.0, 1.0, False),
    "optimal": lambda graph: (1.0, 1.0, True),
}
"""The policies of section 2.2 of the paper: the probability to wait at a wait state, that to decide at a decision
state, and whether decisions are those of the goal instead of uniform."""

PLACED = (StateType.WAIT, StateType.DECISION, StateType.END)
"""Kinds of which a graph may have several states."""


def states_per_observation(task: Task) -> dict[str, int]:
    """Return for wait, decision and end states how many states may show one and the same observation.

    1 where each state has its own id.

    Raises:
        ValueError: for a ``legacy_index`` with more than two branches, where unlike numbers of states share ids.
    """
    require(_index_rule(task))
    x = task.observations
    graph = task.graph
    counts = {kind: getattr(graph, f"num_{kind.name.lower()}_states") for kind in PLACED}
    return {kind.name.lower(): 1 if x.is_unique(kind) else count for kind, count in counts.items()}


def state_entropy(task: Task, policy: str = "random") -> float:
    """Return H(state | observation) in bits, with observations as often as a policy meets them.

    With v(s) the expected visits of state s in an episode and v(O) those of all states that show the same ids as s,

        H = -sum_s v(s) / v * log2(v(s) / v(O)),    v = sum_s v(s).

    0 for a fully observable task. Wait states are counted once for every step in them.

    Args:
        task: any task; its goal counts only for the optimal policy.
        policy: ``random``, uniform over the b + 1 actions; ``navigation``, waits at wait states and decides uniformly;
            ``optimal``, waits at wait states and decides for the goal.

    Raises:
        ValueError: for an unknown policy, and a ``legacy_index`` with more than two branches.
    """
    require((policy in POLICIES, f"policy must be one of {', '.join(POLICIES)}, got {policy!r}"), _index_rule(task))
    waits, decides, knows_goal = POLICIES[policy](task.graph)
    visits = _visits(task.graph, waits, decides)
    open_bits = 0.0
    for kind in PLACED:
        if not task.observations.is_unique(kind):
            open_bits += _bits(visits[kind], 1 if knows_goal else task.graph.branching_factor)
    arrived = sum(visits[StateType.END].values())
    return open_bits / (1 + sum(sum(of_kind.values()) for of_kind in visits.values()) + 1 - arrived)


def _visits(graph: CTGraph, waits: float, decides: float) -> dict[StateType, dict[int, float]]:
    """Expected visits of each kind of state by level; home has one visit, and the fail state the rest of the ends."""
    p = graph.wait_prob
    depth = graph.depth
    leaves = waits * (1 - p) / (1 - waits * p)
    reached = [(leaves * decides) ** level for level in range(depth + 1)]
    return {
        StateType.WAIT: {level: share / (1 - waits * p) for level, share in enumerate(reached)},
        StateType.DECISION: {level: leaves * share for level, share in enumerate(reached[:depth])},
        StateType.END: {depth: leaves * reached[depth]},
    }


def _bits(by_level: dict[int, float], branches: int) -> float:
    """-sum_s v(s) log2(v(s) / v) for levels whose ``branches``^level states are visited equally often."""
    total = sum(by_level.values())
    return sum(v * (level * math.log2(branches) - math.log2(v / total)) for level, v in by_level.items() if v > 0)


def _index_rule(task: Task) -> tuple[bool, str]:
    b = task.graph.branching_factor
    x = task.observations
    own = not (x.legacy_index and b > 2 and any(map(x.is_unique, PLACED)))
    return own, f"observability is exact where no states share an id, not with a legacy_index with branching_factor={b}"
