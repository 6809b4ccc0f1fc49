"""How much of its state a task shows: states per observation, and the entropy of the state given the observation.

Observations are ids, without noise and rotation on read. Every observation of an episode counts, the last one too, but
not the home state's after an ``extra_end_step``. Ids of different kinds of states never overlap, so an observation
leaves only the place in the tree open. Level k has b^k wait states and, below the depth, b^k decision states.
"""

from __future__ import annotations

import math

from ctgraph_rl.checks import Rule, one_of, require
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.tasks.task import Task

POLICIES = ("random", "navigation", "optimal")
"""The policies of section 2.2 of the paper."""

PLACED = (StateType.WAIT, StateType.DECISION, StateType.END)


def states_per_observation(task: Task) -> dict[str, int]:
    """Return for wait, decision and end states how many may show one observation; 1: each has its own id.

    Raises:
        ValueError: for a ``legacy_index`` with b > 2, where ids are shared unequally.
    """
    require(_index_rule(task))
    x = task.observations
    graph = task.graph
    found = {}
    for kind in PLACED:
        name = kind.name.lower()
        found[name] = 1 if x.is_unique(kind) else getattr(graph, f"num_{name}_states")
    return found


def state_entropy(task: Task, policy: str = "random") -> float:
    """Return H(state | observation) in bits, weighted by a policy's visits.

    With v(s) the expected visits of state s in an episode and v(O) those of all states with its ids,

        H = -sum_s v(s) / v * log2(v(s) / v(O)),    v = sum_s v(s).

    Every step in a wait state counts. 0 for a fully observable task.

    Args:
        task: its goal counts only for the optimal policy.
        policy: ``random``, uniform over the b + 1 actions; ``navigation``, waits at wait states and decides uniformly;
            ``optimal``, waits at wait states and decides for the goal.

    Raises:
        ValueError: for an unknown policy, and a ``legacy_index`` with more than two branches.
    """
    require(*one_of(POLICIES, policy=policy), _index_rule(task))
    graph = task.graph
    b = graph.branching_factor
    p = graph.wait_prob
    waits = decides = 1.0
    if policy == "random":
        waits = 1 / (b + 1)
        decides = b / (b + 1)
    leaves = waits * (1 - p) / (1 - waits * p)
    visits: dict[StateType, dict[int, float]] = {kind: {} for kind in PLACED}  # by level of the tree
    for level in range(graph.depth + 1):
        reached = (leaves * decides) ** level
        visits[StateType.WAIT][level] = reached / (1 - waits * p)
        following = StateType.DECISION if level < graph.depth else StateType.END
        visits[following][level] = leaves * reached
    count = {kind: sum(by_level.values()) for kind, by_level in visits.items()}
    level_bits = 0.0 if policy == "optimal" else math.log2(b)  # b^level states are visited equally often
    open_bits = 0.0
    for kind in PLACED:
        if not task.observations.is_unique(kind):
            open_bits += sum(
                v * (level * level_bits - math.log2(v / count[kind])) for level, v in visits[kind].items() if v > 0
            )
    return open_bits / (1 + sum(count.values()) + 1 - count[StateType.END])


def _index_rule(task: Task) -> Rule:
    b = task.graph.branching_factor
    x = task.observations
    own = not (x.legacy_index and b > 2 and any(map(x.is_unique, PLACED)))
    return own, f"observability is exact for ids that no states share, not a legacy_index with branching_factor={b}"
