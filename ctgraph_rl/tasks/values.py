"""Exact values of policies by backward induction, the ceiling of those without memory, and random episodes.

With reward r_(t+1) for step t (the first step has t = 0) a return is sum_t gamma^t r_(t+1); every episode ends, so
gamma may be 1. A wait state is left with probability 1 - p per wait; with V' the value of where it leads,

    V(wait) = s + a (1 - p) V' + a p gamma V(wait) + (1 - a) fail_reward    if it waits with probability a,

which is solved for V(wait). Rewards are those of `CTGraphEnv`, here in float64; s = ``step_reward`` for every step, one
more after an end state with ``extra_end_step``. Noise has mean 0 and changes nothing; a goal that changes stays.
Policies see observation ids, which equal images where no two are alike and nothing varies on read.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ctgraph_rl.checks import Rule, fraction, require
from ctgraph_rl.core.graph import WAIT_ACTION, StateType
from ctgraph_rl.core.rewards import Arrival, Needle

if TYPE_CHECKING:
    from ctgraph_rl.tasks.task import Task

MAX_ENUMERATED_STATES = 2**21
"""Largest graph whose states are visited singly; needles have closed forms."""

SUM_TOLERANCE = 1e-6
"""How far an observation's probabilities may sum from 1, for float32 policies."""


def optimal_value(task: Task, gamma: float) -> float:
    """The best expected discounted return from home; a policy may fail deliberately.

    For goal 1 and fail 0 of a needle: gamma^-1 (gamma^2 (1 - p) / (1 - gamma p))^(d + 1). Needles take O(d), other
    rewards visit every state.

    Args:
        gamma: discount, in [0, 1].

    Raises:
        ValueError: for a gamma out of range, and rewards other than `Needle` beyond `MAX_ENUMERATED_STATES` states.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> round(optimal_value(ct_su_b1(), gamma=0.9), 5)  # 0.9^5
        0.59049
    """
    require(*fraction(gamma=gamma))
    tree = _GoalAndAnother(task) if is_needle(task) else smallest_tree(task, False)
    return _value_at_home(tree, BestActions(task, gamma)).item()


def worst_value(task: Task, gamma: float) -> float:
    """The lowest expected discounted return from home; arguments as `optimal_value`."""
    require(*fraction(gamma=gamma))
    return _value_at_home(smallest_tree(task, is_needle(task)), _WorstActions(task, gamma)).item()


def policy_value(task: Task, policy: Tensor, gamma: float = 1.0) -> float:
    """The expected discounted return of a memoryless policy from home.

    Ids that a state draws are averaged. Needles take O(d) when neither waits nor decisions are unique; other tasks
    visit every state.

    Args:
        policy: action probabilities per observation id, float [num_images, A] with A >= b + 1 and rows that sum to 1;
            actions above b fail, as in the environment. The rows of home, end and fail ids have no effect.
        gamma: discount, in [0, 1].

    Raises:
        ValueError: for a policy of another shape, dtype or sum, a gamma out of range, and more than
            `MAX_ENUMERATED_STATES` states where all have to be visited.
    """
    require(*fraction(gamma=gamma), *_policy_rules(task, policy))
    return _value_of_table(task, policy.detach().to("cpu", torch.float64), gamma).item()


@dataclass
class Measures:
    """Exact means over the episodes of a policy."""

    return_mean: float
    success_rate: float
    end_rate: float
    length_mean: float


def policy_measures(task: Task, policies: Tensor, gamma: float = 1.0) -> list[Measures]:
    """The exact measures of memoryless policies; arguments as `policy_value`.

    They are values of other rewards: 1 at the goal; 1 for a failing action; 1 per step.

    Args:
        policies: action probabilities, float [policies, num_images, A].
    """
    rules = [rule for policy in policies for rule in _policy_rules(task, policy)]
    require(*fraction(gamma=gamma), *rules)
    probs = policies.detach().to("cpu", torch.float64)
    needle = replace(task, reward_fn=Needle(), goal_reward=1.0, fail_reward=0.0, step_reward=0.0)
    success = _value_of_table(needle, probs, 1.0)
    ends = 1 + _value_of_table(replace(needle, fail_reward=-1.0), probs, 1.0) - success
    value = success if task == needle and gamma == 1 else _value_of_table(task, probs, gamma)
    length = _value_of_table(replace(needle, step_reward=1.0), probs, 1.0) - success
    rows = torch.stack([value, success, ends.maximum(success), length], dim=-1)  # but for rounding, ends are more
    return [Measures(*row) for row in rows.tolist()]


def memoryless_ceiling(task: Task, deterministic: bool = False) -> float:
    """The best mean return of a policy that sees an observation id and remembers nothing.

    Exact for needles with goal_reward > 0, fail_reward <= 0 and step_reward = 0, where waiting at wait states and
    deciding at decision states loses nothing. With c_a the number of times that the way to the goal takes decision a:

    - unique decisions: every decision can be right; goal_reward.
    - stochastic: decisions have the same probabilities q at every decision state, and prod q_a^c_a is largest at
      q_a = c_a / d (Gibbs' inequality): goal_reward * prod (c_a / d)^c_a.
    - deterministic: the K ids of decision states are divided among the decisions, n_a ids each, so q_a = n_a / K:
      goal_reward * max prod (n_a / K)^c_a, which is 0 when the goal takes more than K different decisions.

    A deterministic policy here is a function of the id; noise and rotation on read could serve it as dice.

    Args:
        deterministic: consider only policies that map an id to one action.

    Raises:
        ValueError: names other rewards; their best policies may fail or seek several end states.
    """
    b = task.graph.branching_factor
    shares_ids = task.observations.legacy_index and task.observations.unique_decisions and b > 2
    own = f"ids that no two states share, not a legacy_index with branching_factor={b}, where they do"
    require(*_needle_rules(task, "memoryless"), (not shares_ids, f"the memoryless ceiling is exact only for {own}"))
    if task.observations.unique_decisions:
        return task.goal_reward
    counts = list(Counter(task.goal_decisions).values())
    first, last = task.observations.decision_ids
    shares = _divided(last - first + 1, counts) if deterministic else [count / task.graph.depth for count in counts]
    return task.goal_reward * math.prod(share**count for share, count in zip(shares, counts, strict=True))


def return_bounds(task: Task) -> tuple[float, float]:
    """Return the lowest and highest return of an episode, undiscounted, without noise; infinite if unbounded.

    A ``step_reward`` has no bound, as an agent may wait on.
    """
    bounds = getattr(task.reward_fn, "bounds", None)
    if bounds is None:
        return -math.inf, math.inf
    paid = [*(share * task.goal_reward for share in bounds(task.graph.branching_factor)), task.fail_reward]
    low = min(paid) if task.step_reward >= 0 else -math.inf
    return low, max(paid) if task.step_reward <= 0 else math.inf


def return_noise(task: Task) -> float:
    """Return the largest standard deviation of a return by the noise of rewards."""
    if task.reward_std == 0 or task.reward_noise == "additive":
        return task.reward_std
    bounds = getattr(task.reward_fn, "bounds", None)
    shares = (-math.inf, math.inf) if bounds is None else bounds(task.graph.branching_factor)
    return task.reward_std * max(abs(share * task.goal_reward) for share in shares)


def open_loop_ceiling(task: Task) -> float:
    """The best mean return of a fixed sequence of actions that ignores observations.

    With p = 0 the best one is optimal (section 3.3 of the paper). Else, for needles with goal_reward > 0, fail_reward
    <= 0 and step_reward = 0: each of the d wait states before a decision must be left at a fixed step, best the first,
    with probability 1 - p; the last may take any time. So the goal is reached with probability (1 - p)^d, and all other
    episodes fail.

    Raises:
        ValueError: names other rewards, with p > 0.
    """
    if task.graph.wait_prob == 0:
        return optimal_value(task, 1.0)
    require(*_needle_rules(task, "open-loop"))
    reaches = (1 - task.graph.wait_prob) ** task.graph.depth
    return reaches * task.goal_reward + (1 - reaches) * task.fail_reward


def random_episode_length(task: Task) -> float:
    """Return the mean steps of an episode under the uniformly random policy.

    A wait state takes (b + 1) / (b + 1 - p) steps and leads on with probability w = (1 - p) / (b + 1 - p), a decision
    state with probability c = b / (b + 1). Hence

        1 + (b + 1) / (b + 1 - p) sum_{k=0..d} (w c)^k + w sum_{k=0..d-1} (w c)^k,

    and w (w c)^d more with an ``extra_end_step``. Correctly rounded, for the float that ``wait_prob`` is.
    """
    return float(_random_episode_length(task))


def random_frames_to_goal(task: Task) -> float:
    """Return that policy's mean frames until it first reaches the goal, failed episodes included.

    This is `random_episode_length` over P_R (Wald's identity), less the step after the goal with an ``extra_end_step``,
    also for a goal that changes. inf beyond floats.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> round(random_frames_to_goal(ct_su_b1()))
        651
    """
    frames = _random_episode_length(task) / task.graph.exact_reward_prob_random - task.extra_end_step
    try:
        return float(frames)
    except OverflowError:
        return math.inf


def _divided(num_ids: int, counts: list[int]) -> list[float]:
    """Shares n_a / K with sum n_a = K, integer n_a, that maximise prod (n_a / K)^c_a.

    One id each, then to the decision whose c_a ln n_a gains most: optimal, as each term is concave in n_a (Fox 1966,
    Operations Research 14). With fewer ids than decisions the product is 0.
    """
    if num_ids < len(counts):
        return [0.0] * len(counts)
    ids = [1] * len(counts)
    for _ in range(num_ids - len(counts)):
        gains = [count * math.log1p(1 / n) for n, count in zip(ids, counts, strict=True)]
        ids[gains.index(max(gains))] += 1
    return [n / num_ids for n in ids]


def _random_episode_length(task: Task) -> Fraction:
    b = task.graph.branching_factor
    d = task.graph.depth
    p = Fraction(task.graph.wait_prob)
    wait = (b + 1) / (b + 1 - p)
    leaves = (1 - p) / (b + 1 - p)
    reached = [(leaves * b / (b + 1)) ** k for k in range(d + 1)]
    return 1 + wait * sum(reached) + leaves * (sum(reached[:d]) + task.extra_end_step * reached[d])


def _value_of_table(task: Task, policy: Tensor, gamma: float) -> Tensor:
    shared = not (task.observations.unique_waits or task.observations.unique_decisions)
    return _value_at_home(smallest_tree(task, is_needle(task) and shared), _Memoryless(task, gamma, policy))


def _value_at_home(tree: _EveryNode | _GoalPath, chooser: BestActions | _Memoryless) -> Tensor:
    after_end = chooser.gamma * tree.task.step_reward if tree.task.extra_end_step else 0.0
    values = chooser.at_wait(tree.end_rewards() + after_end, tree.task.graph.depth)
    for level in reversed(range(tree.task.graph.depth)):
        decided = chooser.at_decision(tree.children(values, level), level)
        values = chooser.at_wait(chooser.gamma * decided, level)
    return tree.task.step_reward + chooser.gamma * values[..., 0]


def end_rewards(task: Task) -> Tensor:
    """What each end state pays, float64 [b^d]."""
    graph = task.graph
    leaf = torch.arange(graph.num_end_states, device="cpu")
    goal = torch.full_like(leaf, task.goal_leaf)
    b = torch.full_like(leaf, graph.branching_factor)
    depth = torch.full_like(leaf, graph.depth)
    share = task.reward_fn(Arrival(leaf, goal, b, depth, graph.depth))
    return task.goal_reward * share.to(torch.float64)


def smallest_tree(task: Task, collapses: bool) -> _EveryNode | _GoalPath:
    """The smallest tree that is exact."""
    if collapses:
        return _GoalPath(task)
    states = task.graph.num_states
    limit = MAX_ENUMERATED_STATES
    too_many = f"{type(task.reward_fn).__name__} on this graph needs a visit to each of its {states} states"
    require((states <= limit, f"{too_many}, more than the limit of {limit} (2**21); use a smaller depth"))
    return _EveryNode(task)


@dataclass(frozen=True)
class _EveryNode:
    task: Task

    def end_rewards(self) -> Tensor:
        return end_rewards(self.task)

    def children(self, values: Tensor, level: int) -> Tensor:
        """By parent and decision: float64 [..., b^level, b]."""
        by_branch = values.unflatten(-1, (-1, self.task.graph.branching_factor))
        swap = self.task.swapped_branches
        node = self.task.swapped_node
        if swap is None or node is None or len(swap[0]) != level:
            return by_branch
        by_decision = by_branch.clone()
        first, second = (branch - 1 for branch in swap[1])
        number = node - self.task.graph.first_node(level)
        by_decision[..., number, [first, second]] = by_branch[..., number, [second, first]]
        return by_decision


@dataclass(frozen=True)
class _GoalPath:
    """Two nodes per level: on the way to a needle, and any off it, which are worth the same."""

    task: Task

    def end_rewards(self) -> Tensor:
        return torch.tensor([self.task.goal_reward, 0.0], dtype=torch.float64, device="cpu")

    def children(self, values: Tensor, level: int) -> Tensor:
        """By parent and decision: float64 [..., 2, b]."""
        children = values[..., 1:, None].expand(*values.shape, self.task.graph.branching_factor).clone()
        children[..., 0, self.task.goal_decisions[level] - 1] = values[..., 0]
        return children


class _GoalAndAnother(_GoalPath):
    """With two of the b decisions, enough for a best choice."""

    def children(self, values: Tensor, level: int) -> Tensor:
        """By parent, for the goal's decision and any other: float64 [2, 2]."""
        return torch.stack([values, values[1].repeat(2)])


@dataclass(frozen=True)
class BestActions:
    """The best choice at every node."""

    task: Task
    gamma: float

    @property
    def failing(self) -> float:
        """The reward of failing."""
        return self.task.step_reward + self.task.fail_reward

    def waiting(self, arrival: Tensor) -> Tensor:
        """Wait until it ends."""
        p = self.task.graph.wait_prob
        return (self.task.step_reward + (1 - p) * arrival) / (1 - self.gamma * p)

    def at_wait(self, arrival: Tensor, level: int) -> Tensor:
        """Wait until it ends, or fail; the better stays better. float64, as ``arrival``."""
        return self.waiting(arrival).clamp_min(self.failing)

    def at_decision(self, children: Tensor, level: int) -> Tensor:
        """Decide for the best child or fail. float64 [n] of [n, b]."""
        return self.task.step_reward + (self.gamma * children.amax(-1)).clamp_min(self.task.fail_reward)


class _WorstActions(BestActions):
    def at_wait(self, arrival: Tensor, level: int) -> Tensor:
        return self.waiting(arrival).clamp_max(self.failing)

    def at_decision(self, children: Tensor, level: int) -> Tensor:
        return self.task.step_reward + (self.gamma * children.amin(-1)).clamp_max(self.task.fail_reward)


@dataclass(frozen=True)
class _Memoryless:
    task: Task
    gamma: float
    policy: Tensor  # float64 [..., num_images, A]

    def at_wait(self, arrival: Tensor, level: int) -> Tensor:
        """The module's V(wait), solved."""
        probs = self._action_probs(StateType.WAIT, level)
        p = self.task.graph.wait_prob
        waits = probs[..., WAIT_ACTION]
        fails = probs[..., 1:].sum(-1)
        leaves = self.task.step_reward + waits * (1 - p) * arrival + fails * self.task.fail_reward
        return leaves / (1 - self.gamma * p * waits)

    def at_decision(self, children: Tensor, level: int) -> Tensor:
        """The mean over decisions and failing."""
        probs = self._action_probs(StateType.DECISION, level)
        b = self.task.graph.branching_factor
        fails = probs[..., WAIT_ACTION] + probs[..., b + 1 :].sum(-1)
        decided = self.gamma * (probs[..., 1 : b + 1] * children).sum(-1)
        return self.task.step_reward + decided + fails * self.task.fail_reward

    def _action_probs(self, kind: StateType, level: int) -> Tensor:
        """float64 [..., b^level, A] by node where ids are unique, else [..., 1, A], the mean over ids."""
        x = self.task.observations
        if not x.is_unique(kind):
            first, last = x.ids(kind)
            return self.policy[..., first : last + 1, :].mean(-2, keepdim=True)
        number = torch.arange(self.task.graph.branching_factor**level, device="cpu")
        return self.policy[..., x.unique_id(self.task.graph, kind, level, number), :]


def is_needle(task: Task) -> bool:
    """Return whether only the goal pays."""
    return task.reward_fn == Needle()


def _policy_rules(task: Task, policy: Tensor) -> list[Rule]:
    b = task.graph.branching_factor
    images = task.images.num_images
    is_table = isinstance(policy, Tensor) and policy.dim() == 2 and policy.is_floating_point()
    got = (policy.dtype, list(policy.shape)) if isinstance(policy, Tensor) else type(policy).__name__
    shape_rule = f"policy must be a float tensor [{images}, A] with A >= {b + 1}, one row per image, got {got}"
    if not is_table or policy.shape[0] != images or policy.shape[1] < b + 1:
        return [(False, shape_rule)]
    sums = policy.detach().to(torch.float64).sum(-1)
    wrong = ~((policy >= 0).all(-1) & ((sums - 1).abs() <= SUM_TOLERANCE))
    rows = wrong.nonzero().flatten()[:5].tolist()
    return [(not rows, f"rows of policy must be >= 0 and sum to 1, not so rows {rows}")]


def _needle_rules(task: Task, ceiling: str) -> list[Rule]:
    name = type(task.reward_fn).__name__
    goal = task.goal_reward
    fail = task.fail_reward
    step = task.step_reward
    only = f"the {ceiling} ceiling is exact only for"
    return [
        (is_needle(task), f"{only} the Needle reward, where one end state counts, got {name}"),
        (goal > 0, f"{only} goal_reward > 0, where the goal is worth reaching, got {goal}"),
        (fail <= 0, f"{only} fail_reward <= 0, where deliberate failing never pays, got {fail}"),
        (step == 0, f"{only} step_reward = 0, where a longer episode is worth no more, got {step}"),
    ]
