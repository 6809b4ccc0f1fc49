"""The exact value of a policy, against hand calculation and a chain of linear equations."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import pytest
import torch
from helpers.probability_tables import (
    F64,
    GAMMAS,
    GRAPHS,
    Mixed,
    make_task,
    random_policy,
    success_prob,
    table,
    uniform,
)
from torch import Tensor

from ctgraph_rl import Needle, Task
from ctgraph_rl.core.rewards import Arrival
from ctgraph_rl.tasks.values import policy_measures
from curricula.paper import ct_su_b1


@dataclass(frozen=True)
class LastDecision:
    """Pays by the last decision and the depth."""

    def __call__(self, arrival: Arrival) -> Tensor:
        return arrival.leaf % arrival.branching_factor / (4 * arrival.depth).float()


def navigation(task: Task) -> Tensor:
    b = task.graph.branching_factor
    return table(task, [1.0] + [0.0] * b, [0.0] + [1 / b] * b)


@pytest.mark.parametrize(
    ("b", "d", "p", "unique"),
    [(*graph, unique) for graph in GRAPHS for unique in ("", "w", "d", "wd")]
    + [(2, 16, 0.5, ""), (3, 10, 0.9, ""), (3, 30, 0.999, "")],
)
def test_the_uniform_policy_reaches_the_goal_with_p_r(b, d, p, unique):
    task = make_task(b, d, p, waits=2, decisions=3, unique=unique)

    probs = [task.policy_value(uniform(task)), success_prob(task, uniform(task))]

    assert probs == pytest.approx([task.graph.reward_prob_random] * 2, rel=1e-12, abs=0)


@pytest.mark.parametrize(("b", "d", "p"), [*GRAPHS, (3, 30, 0.999)])
def test_the_navigation_policy_reaches_the_goal_with_b_to_the_minus_d(b, d, p):
    task = make_task(b, d, p, waits=2, decisions=3)

    prob = task.policy_value(navigation(task))

    assert prob == pytest.approx(float(b) ** -d, rel=1e-12, abs=0)


@pytest.mark.parametrize(("b", "d", "p"), GRAPHS)
@pytest.mark.parametrize("waits", ["", "w"])
def test_the_optimal_policy_over_unique_decisions_has_the_optimal_value(b, d, p, waits):
    task = make_task(b, d, p, unique=f"{waits}d", goal_reward=2.0, fail_reward=-1.0)
    policy, node = navigation(task), 0
    for decision in task.goal:
        policy[task.observations.decision_ids[0] + node] = torch.eye(b + 1, dtype=F64)[decision]
        node = b * node + decision

    values = {gamma: task.policy_value(policy, gamma) for gamma in GAMMAS}

    assert values == pytest.approx({gamma: task.optimal_value(gamma) for gamma in GAMMAS}, rel=1e-12)
    assert [values[1.0], success_prob(task, policy)] == pytest.approx([2.0, 1.0], rel=1e-12)


def test_a_policy_by_hand_at_d_1_with_every_probability_different():
    task = make_task(2, 1, 0.5, goal=(2,), goal_reward=3.0, fail_reward=-1.0)
    policy = table(task, [0.8, 0.2, 0.0], [0.1, 0.3, 0.6])
    gamma = 0.5

    wait_before = {"goal": (0.4 * 3 - 0.2) / 0.8, "other": -0.2 / 0.8}  # V = 0.4 R + 0.4 * 0.5 V - 0.2
    decision = gamma * (0.6 * wait_before["goal"] + 0.3 * wait_before["other"]) - 0.1
    first_wait = (0.4 * gamma * decision - 0.2) / 0.8

    assert task.policy_value(policy, gamma) == pytest.approx(gamma * first_wait, rel=1e-14)
    assert success_prob(task, policy) == pytest.approx((0.4 / 0.6) * 0.6 * (0.4 / 0.6), rel=1e-14)


def value_by_chain(task: Task, policy: Tensor, gamma: float, end_reward: Callable[[int], float]) -> float:
    """The value by a linear solve over (path, kind, observation id), each id a state of its own."""
    b, d, p = task.graph.branching_factor, task.graph.depth, task.graph.wait_prob
    x = task.observations

    def node(path: tuple[int, ...]) -> int:
        """Its place when the nodes are counted level by level from the root, the branches of a level in order."""
        shorter = sum(b**k for k in range(len(path)))
        return shorter + sum((a - 1) * b ** (len(path) - 1 - k) for k, a in enumerate(path))

    def shown(path: tuple[int, ...], kind: str) -> list[tuple[tuple[int, ...], str, int]]:
        unique = x.unique_waits if kind == "wait" else x.unique_decisions
        first, last = x.wait_ids if kind == "wait" else x.decision_ids
        return [(path, kind, i) for i in ([first + node(path)] if unique else range(first, last + 1))]

    paths = [path for k in range(d + 1) for path in product(range(1, b + 1), repeat=k)]
    states = [s for path in paths for s in shown(path, "wait")]
    states += [s for path in paths if len(path) < d for s in shown(path, "decision")]
    number = {s: i for i, s in enumerate(states)}
    matrix, rewards = torch.eye(len(states), dtype=F64), torch.zeros(len(states), dtype=F64)

    def go(i: int, prob: float, targets: list[tuple[tuple[int, ...], str, int]]) -> None:
        for target in targets:
            matrix[i, number[target]] -= gamma * prob / len(targets)

    for i, (path, kind, image) in enumerate(states):
        for action, prob in enumerate(policy[image].tolist()):
            if kind == "wait" and action == 0:
                go(i, prob * p, shown(path, "wait"))
                if len(path) == d:
                    rewards[i] += prob * (1 - p) * end_reward(node(path) - node((1,) * d))
                else:
                    go(i, prob * (1 - p), shown(path, "decision"))
            elif kind == "decision" and 1 <= action <= b:
                go(i, prob, shown((*path, action), "wait"))
            else:
                rewards[i] += prob * task.fail_reward
    values = torch.linalg.solve(matrix, rewards)
    first_seen = [values[number[s]].item() for s in shown((), "wait")]
    return gamma * sum(first_seen) / len(first_seen)


@pytest.mark.parametrize("unique", ["", "w", "d", "wd"])
@pytest.mark.parametrize(
    ("b", "d", "p", "num_actions"), [(2, 1, 0.5, 3), (2, 2, 0.5, 3), (3, 2, 0.9, 6), (2, 3, 0.0, 4)]
)
@pytest.mark.parametrize("reward_fn", [Needle(), Mixed()])
def test_a_random_policys_value_is_that_of_a_chain_with_one_state_per_image(b, d, p, num_actions, unique, reward_fn):
    fields = {"reward_fn": reward_fn, "goal_reward": 2.0, "fail_reward": -0.5}
    task = make_task(b, d, p, waits=3, decisions=2, unique=unique, **fields)
    policy = random_policy(task, num_actions, torch.Generator().manual_seed(7))

    def end_reward(leaf: int) -> float:
        other = 0.0 if reward_fn == Needle() else (leaf * 5 % 7 - 2) / 8
        return 2.0 if leaf == task.goal_leaf else 2.0 * other

    for gamma in GAMMAS:
        expected = value_by_chain(task, policy, gamma, end_reward)
        assert task.policy_value(policy, gamma) == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_rows_of_home_end_and_fail_have_no_effect_and_float32_is_welcome():
    task = make_task(2, 2, 0.5, waits=2, decisions=2)
    policy = random_policy(task, 3, torch.Generator().manual_seed(1))
    other = policy.clone()
    other[[0, 1, 6]] = torch.tensor([0.0, 0.0, 1.0], dtype=F64)

    value = task.policy_value(policy)

    assert task.policy_value(other) == value
    assert task.policy_value(policy.float()) == task.policy_value(policy.float().double())
    assert task.policy_value(policy.float()) == pytest.approx(value, rel=1e-6)


def test_a_reward_gets_the_branching_factor_and_the_depth():
    task = make_task(3, 2, 0.5, reward_fn=LastDecision(), goal_reward=2.0)

    values = [task.policy_value(navigation(task)), task.optimal_value(1.0)]

    assert values == pytest.approx([2 * (0 + 1 + 2) / 3 / 8, 2 * 2 / 8], rel=1e-14)


def test_a_policy_of_certain_failure_gets_the_fail_reward_when_it_fails():
    task = make_task(2, 2, fail_reward=-2.0)
    fails_waiting = table(task, [0.0, 1.0, 0.0], [0.0, 1.0, 0.0])
    fails_deciding = table(task, [1.0, 0.0, 0.0], [1.0, 0.0, 0.0])

    values = [task.policy_value(policy, 0.5) for policy in (fails_waiting, fails_deciding)]

    assert values == [0.5 * -2, 0.25 * -2]
    assert success_prob(task, fails_waiting) == 0.0


def test_the_success_probability_does_not_depend_on_rewards():
    needle = make_task(2, 2, 0.5, decisions=2)
    policy = random_policy(needle, 3, torch.Generator().manual_seed(2))

    others = [replace(needle, reward_fn=fn, goal_reward=-3.0, fail_reward=2.0) for fn in (Needle(), Mixed())]

    expected = needle.policy_value(policy)
    for task in others:
        [measures] = policy_measures(task, policy.unsqueeze(0))
        assert measures.success_rate == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("gamma", [-0.1, 1.5, math.nan, "1"])
def test_a_gamma_out_of_range_is_refused(gamma):
    task = make_task(2, 2)

    for value in (lambda: task.optimal_value(gamma), lambda: task.policy_value(uniform(task), gamma)):
        with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\]"):
            value()


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (torch.full((4, 3), 1 / 3), r"float tensor \[5, A\] with A >= 3.*got .*\[4, 3\]"),
        (torch.full((5, 2), 1 / 2), r"got .*\[5, 2\]"),
        (torch.full((5,), 1.0), r"got .*\[5\]"),
        (torch.tensor([[1, 0, 0]] * 5), r"got .*int64"),
        ([[1.0, 0.0, 0.0]] * 5, "got 'list'|got list"),
        (torch.full((5, 3), 0.3), r"sum to 1, not so rows \[0, 1, 2, 3, 4\]"),
        (torch.tensor([[1.0, 0, 0]] * 2 + [[1.5, -0.5, 0]] + [[1.0, 0, 0]] * 2), r"not so rows \[2\]"),
        (torch.tensor([[1.0, 0, 0]] * 4 + [[math.nan, 1, 0]]), r"not so rows \[4\]"),
    ],
)
def test_a_policy_that_is_no_table_of_probabilities_is_refused(policy, message):
    task = ct_su_b1()

    with pytest.raises(ValueError, match=message):
        task.policy_value(policy)
