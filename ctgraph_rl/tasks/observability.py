"""How much of its state a task shows: states per observation, and the entropy of the state given the observation.

Observations are ids, without noise and rotation on read. Every observation of an episode counts, the last one too, but
not the home state's after an ``extra_end_step``. Ids of different kinds of states never overlap, so an observation
leaves only the place in the tree open. Level k has b^k wait states and, below the depth, b^k decision states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from ctgraph_rl.checks import Rule, one_of, require
from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.core.rewards import Needle
from ctgraph_rl.tasks.task import Task

POLICIES = ("random", "navigation", "optimal")
"""The policies of section 2.2 of the paper."""

PLACED = (StateType.WAIT, StateType.DECISION, StateType.END)

VisitsByLevel = dict[StateType, dict[int, float]]
"""Expected visits by kind and level."""


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
    visits = _visits(task.graph, *_chances(task.graph, policy))
    branches = _branches(task.graph, policy)
    open_bits = 0.0
    for kind in PLACED:
        if not task.observations.is_unique(kind):
            open_bits += _bits(visits[kind], branches)
    count = _count(visits)
    return open_bits / (1 + sum(count.values()) + 1 - count[StateType.END])


def transition_entropy(task: Task, policy: str = "navigation", informed: bool = True) -> float:
    """Return the least bits per step that a predictor of the next observation and reward can need.

    Ids of different kinds of states never overlap, so observations and actions tell the state. Only two things are
    open: whether a wait state is left, and which of its ids a state shows. With v(kind) the expected visits of an
    episode, l(kind) = log2 of the ids that a state draws from (0 for unique ones), a the probability to wait at a wait
    state, c that to decide at a decision state, n = 1 + v(W) + v(D) steps, and h the binary entropy,

        n H = l(W) + v(D) (c l(W) + (1 - c) l(F)) + v(W) (1 - a) l(F)
              + sum over levels k of v(W, k) a (h(p) + p l(W) + (1 - p) l(D, or E at the last level)).

    Rewards follow from the state and add nothing. An uninformed predictor, without last observation and action, needs
    the entropy of the pairs of observation and reward.

    Args:
        task: with a needle and no noise of rewards.
        policy: as in `state_entropy`.
        informed: False gives the entropy of the pairs.

    Raises:
        ValueError: as for `state_entropy`, and for drawn rewards, goals or images, and an extra last step.
    """
    x = task.observations
    p = task.graph.wait_prob
    drawn = task.reward_std or task.goal_change or x.read_noise or x.read_rotation or x.reward_cue
    fixed = task.reward_fn == Needle() and not drawn and not task.extra_end_step
    require(
        *one_of(POLICIES, policy=policy),
        _index_rule(task),
        (fixed, "the entropy of transitions is exact for a Needle reward, with no noise, change or extra step"),
    )
    waits, decides = _chances(task.graph, policy)
    visits = _visits(task.graph, waits, decides)
    count = _count(visits)
    steps = 1 + count[StateType.WAIT] + count[StateType.DECISION]
    bits = {}
    for kind in StateType:
        first, last = (0, 0) if x.is_unique(kind) else x.ids(kind)
        bits[kind] = math.log2(1 + last - first)
    if not informed:
        return _pair_bits(visits, bits, task, _branches(task.graph, policy)) / steps
    wait = bits[StateType.WAIT]
    fail = bits[StateType.FAIL]
    leaving = sum(-share * math.log2(share) for share in (p, 1 - p) if share)
    stay = leaving + p * wait
    total = wait + count[StateType.DECISION] * (decides * wait + (1 - decides) * fail)
    for level, v in visits[StateType.WAIT].items():
        onward = bits[StateType.END if level == task.graph.depth else StateType.DECISION]
        total += v * (waits * (stay + (1 - p) * onward) + (1 - waits) * fail)
    return total / steps


def _pair_bits(visits: VisitsByLevel, bits: Mapping[StateType, float], task: Task, branches: int) -> float:
    """-sum over pairs of c log2(c / n), where a pair of observation and reward comes c times in an episode's n steps.

    Equal pairs are one group: (expected number together, log2 of how many).
    """
    count = _count(visits)
    goal = branches**-task.graph.depth
    groups = [(1 - count[StateType.END], bits[StateType.FAIL])]
    for kind, by_level in visits.items():
        if task.observations.is_unique(kind):
            for level, v in by_level.items():
                groups.append((v, level * math.log2(branches)))
        else:
            shares = (goal, 1 - goal) if kind == StateType.END else (1.0,)
            for share in shares:
                groups.append((share * count[kind], bits[kind]))
    total = sum(count for count, _ in groups)
    return sum(count * (wide - math.log2(count / total)) for count, wide in groups if count > 0)


def _chances(graph: CTGraph, policy: str) -> tuple[float, float]:
    if policy != "random":
        return 1.0, 1.0
    b = graph.branching_factor
    return 1 / (b + 1), b / (b + 1)


def _branches(graph: CTGraph, policy: str) -> int:
    return 1 if policy == "optimal" else graph.branching_factor


def _visits(graph: CTGraph, waits: float, decides: float) -> VisitsByLevel:
    """Expected visits by kind and level; home has one, and the fail state the rest of the ends."""
    p = graph.wait_prob
    leaves = waits * (1 - p) / (1 - waits * p)
    visits: VisitsByLevel = {kind: {} for kind in PLACED}
    for level in range(graph.depth + 1):
        reached = (leaves * decides) ** level
        visits[StateType.WAIT][level] = reached / (1 - waits * p)
        following = StateType.DECISION if level < graph.depth else StateType.END
        visits[following][level] = leaves * reached
    return visits


def _count(visits: VisitsByLevel) -> dict[StateType, float]:
    return {kind: sum(by_level.values()) for kind, by_level in visits.items()}


def _bits(by_level: dict[int, float], branches: int) -> float:
    """-sum_s v(s) log2(v(s) / v) for levels whose ``branches``^level states are visited equally often."""
    total = sum(by_level.values())
    return sum(v * (level * math.log2(branches) - math.log2(v / total)) for level, v in by_level.items() if v > 0)


def _index_rule(task: Task) -> Rule:
    b = task.graph.branching_factor
    x = task.observations
    own = not (x.legacy_index and b > 2 and any(map(x.is_unique, PLACED)))
    return own, f"observability is exact for ids that no states share, not a legacy_index with branching_factor={b}"
