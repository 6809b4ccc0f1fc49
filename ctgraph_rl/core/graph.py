"""The shape of a CT-graph and its closed forms.

Soltoggio et al. 2023 (arXiv 2302.10887), section 2; ``docs/explanation/errata.md`` corrects its misprints.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction

from ctgraph_rl.checks import is_int, is_real, make_fields_plain, require, takes_numbers

WAIT_ACTION = 0
"""The action A^0 that leaves a wait state; decisions are the actions 1..b."""

MAX_STATES = 2**63 - 1
"""Positions are int64 heap indices."""


class StateType(IntEnum):
    """The five kinds of states: S^H, S^W, S^D, S^E and S^F of the paper."""

    HOME = 0
    WAIT = 1
    DECISION = 2
    END = 3
    FAIL = 4


@dataclass(frozen=True)
class CTGraph:
    """A b-ary tree of decision states with a wait state before every decision and end state.

    Args:
        branching_factor: b >= 2, decisions at a decision state.
        depth: d >= 1, decisions on the way to an end state.
        wait_prob: p in [0, 1), the probability to stay when waiting.

    Raises:
        ValueError: for values out of range, and trees whose states do not fit int64.

    Example:
        >>> graph = CTGraph(branching_factor=2, depth=2, wait_prob=0.5)
        >>> graph.num_states, graph.num_end_states
        (16, 4)
        >>> graph.reward_prob_navigation
        0.25
    """

    branching_factor: int
    depth: int
    wait_prob: float = 0.0

    def __post_init__(self) -> None:
        make_fields_plain(self)
        b = self.branching_factor
        d = self.depth
        p = self.wait_prob
        shape_ok = is_int(b, 2) and is_int(d, 1)
        # 2**63 > 2**63 - 1: beyond depth 63 no tree fits, and b**d need not be computed.
        fits = not shape_ok or (d < 64 and self.num_states <= MAX_STATES)
        require(
            (is_int(b, 2), f"branching_factor must be an integer >= 2, got {b!r}"),
            (is_int(d, 1), f"depth must be an integer >= 1, got {d!r}"),
            (is_real(p, 0) and p < 1, f"wait_prob must be in [0, 1), got {p!r}"),
            (fits, f"depth={d} with branching_factor={b} gives more than 2**63 - 1 states; use a smaller depth"),
        )
        object.__setattr__(self, "wait_prob", float(p))

    @property
    def num_end_states(self) -> int:
        """b^d, the leaves."""
        return self.branching_factor**self.depth

    @property
    def num_decision_states(self) -> int:
        """1 + b + ... + b^(d-1)."""
        return self.first_node(self.depth)

    @property
    def num_wait_states(self) -> int:
        """One before each decision and end state."""
        return self.num_decision_states + self.num_end_states

    @property
    def num_states(self) -> int:
        """|S|, home and fail included."""
        return self.num_wait_states + self.num_decision_states + self.num_end_states + 2

    @takes_numbers
    def first_node(self, level: int) -> int:
        """Return the first node after ``level`` decisions, (b^level - 1) / (b - 1); nodes are heap indices."""
        return (self.branching_factor**level - 1) // (self.branching_factor - 1)

    def parent(self, node: int) -> int:
        """Return the parent of ``node`` > 0."""
        return (node - 1) // self.branching_factor

    def decision(self, node: int) -> int:
        """Return the decision, in 1..b, from the parent of ``node`` > 0."""
        return (node - 1) % self.branching_factor + 1

    @takes_numbers
    def nodes_to(self, node: int) -> tuple[int, ...]:
        """Return the nodes from the root 0 to ``node``, both included."""
        nodes = [node]
        while nodes[-1] > 0:
            nodes.append(self.parent(nodes[-1]))
        return tuple(reversed(nodes))

    @takes_numbers
    def path(self, node: int) -> tuple[int, ...]:
        """Return the decisions, in 1..b, from the root to ``node``: its goal, if it is an end state."""
        return tuple(map(self.decision, self.nodes_to(node)[1:]))

    @takes_numbers
    def node_at(self, path: Iterable[int]) -> int:
        """Return the node that decisions lead to from the root."""
        node = 0
        for decision in path:
            node = self.branching_factor * node + decision
        return node

    @takes_numbers
    def leaf_of(self, goal: Iterable[int]) -> int:
        """Return the number of a goal's end state: its base-b digits are the decisions less 1."""
        return self.node_at(goal) - self.num_decision_states

    @property
    def exact_reward_prob_random(self) -> Fraction:
        """`reward_prob_random` without rounding, for the float ``wait_prob``."""
        b = self.branching_factor
        p = Fraction(self.wait_prob)
        return (b + 1) * ((1 - p) / ((b + 1) * (b + 1 - p))) ** (self.depth + 1)

    @property
    def reward_prob_random(self) -> float:
        """P_R: the probability that a uniformly random policy reaches one given end state.

        (b + 1) * ((1 - p) / ((b + 1) (b + 1 - p)))^(d + 1), the paper's closed form, correctly rounded. 0.0 below the
        smallest float, where `exact_reward_prob_random` serves.
        """
        return float(self.exact_reward_prob_random)

    @property
    def end_prob_random(self) -> float:
        """P_E: the probability that a uniformly random policy reaches any end state, b^d P_R, correctly rounded."""
        return float(self.num_end_states * self.exact_reward_prob_random)

    @property
    def reward_prob_navigation(self) -> float:
        """P_RNP: the same for a policy that waits when it must and decides at random, b^-d."""
        return 1 / self.num_end_states

    @property
    def expected_episode_length(self) -> float:
        """E[rho]: mean steps to an end state, (d + 1) / (1 - p) + d + 1.

        Of a policy that always waits at wait states; one that waits with probability a stays with a p instead of p.
        """
        return (self.depth + 1) / (1 - self.wait_prob) + self.depth + 1

    @takes_numbers
    def episode_length_prob(self, length: int) -> float:
        """P(rho = length): one step at home, d decisions, and d + 1 wait states left with probability 1 - p per step.

        A negative binomial: C(w - 1, d) (1 - p)^(d+1) p^(w-d-1) for w = length - d - 1 steps in wait states, under the
        policy of `expected_episode_length`.

        Args:
            length: steps of an episode; below 2 (d + 1) the result is 0.0.

        Raises:
            ValueError: if ``length`` is not an integer.
        """
        require((is_int(length), f"length must be an integer, got {length!r}"))
        waits = self.depth + 1
        p = self.wait_prob
        stays = length - 2 * waits
        if stays < 0 or (p == 0 and stays > 0):
            return 0.0
        log_stays = stays * math.log(p) if stays else 0.0
        return math.exp(math.log(math.comb(stays + waits - 1, stays)) + waits * math.log1p(-p) + log_stays)

    @property
    def expected_search_episodes(self) -> float:
        """E[kappa]: mean episodes to the goal when end states are tried without replacement, (b^d + 1) / 2."""
        return (self.num_end_states + 1) / 2
