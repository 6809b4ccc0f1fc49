"""The ceiling without memory, against enumeration of all policies."""

import math
from collections import Counter
from collections.abc import Iterator
from fractions import Fraction
from itertools import product

import pytest
import torch
from helpers.probability_tables import (
    F64,
    Mixed,
    OneAtTheGoal,
    make_task,
    random_policy,
    rows_of,
    table,
    uniform,
)
from torch import Tensor

from ctgraph_rl import StateType, Task
from ctgraph_rl.tasks.values import MAX_ENUMERATED_STATES
from curricula.paper import ct_su_b1


def deterministic_policies(task: Task) -> Iterator[Tensor]:
    """Every map from wait and decision ids to actions."""
    num_actions = task.graph.branching_factor + 1
    rows = [*rows_of(task, StateType.WAIT), *rows_of(task, StateType.DECISION)]
    for actions in product(range(num_actions), repeat=len(rows)):
        policy = uniform(task)
        policy[rows] = torch.eye(num_actions, dtype=F64)[list(actions)]
        yield policy


@pytest.mark.parametrize(
    ("goal", "deterministic", "stochastic"),
    [((1, 1), 1.0, 1.0), ((2, 2), 1.0, 1.0), ((1, 2), 0.0, 0.25), ((2, 1), 0.0, 0.25)],
)
def test_ceilings_of_ct_su_b1(goal, deterministic, stochastic):
    task = ct_su_b1(goal)

    ceilings = [task.memoryless_ceiling(deterministic=True), task.memoryless_ceiling()]

    assert ceilings == [deterministic, stochastic]


def test_two_decision_images_let_a_deterministic_policy_have_a_quarter():
    task = make_task(2, 2, decisions=2, goal=(1, 2), goal_reward=8.0)

    ceilings = [task.memoryless_ceiling(deterministic=True), task.memoryless_ceiling()]

    assert ceilings == [2.0, 2.0]


@pytest.mark.parametrize("goal", [(1, 1), (1, 2), (2, 1), (1, 1, 2), (2, 1, 2)])
@pytest.mark.parametrize(
    ("waits", "decisions", "fail_reward"), [(1, 1, 0.0), (1, 1, -1.0), (2, 2, -1.0), (1, 3, 0.0), (1, 4, 0.0)]
)
def test_the_best_of_all_deterministic_policies_has_the_deterministic_ceiling(goal, waits, decisions, fail_reward):
    task = make_task(2, len(goal), 0.5, waits=waits, decisions=decisions, goal=goal, fail_reward=fail_reward)

    best = max(task.policy_value(policy) for policy in deterministic_policies(task))

    assert best == pytest.approx(task.memoryless_ceiling(deterministic=True), rel=1e-12, abs=1e-15)


def test_unique_waits_do_not_help_a_deterministic_policy_that_forgets_them():
    task = make_task(2, 2, 0.5, unique="w", goal=(1, 2), fail_reward=-1.0)
    same = make_task(2, 2, 0.5, unique="w", goal=(2, 2), fail_reward=-1.0)
    wait_or_fail = product([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], repeat=7)

    policies = [(waits, decide) for waits in wait_or_fail for decide in torch.eye(3, dtype=F64)]
    best = {task: -math.inf, same: -math.inf}
    for waits, decide in policies:
        policy = table(task, [1.0, 0.0, 0.0], decide.tolist())
        policy[list(rows_of(task, StateType.WAIT))] = torch.tensor(waits, dtype=F64)
        best = {each: max(value, each.policy_value(policy)) for each, value in best.items()}

    assert list(best.values()) == [0.0, 1.0]
    assert [each.memoryless_ceiling(deterministic=True) for each in best] == [0.0, 1.0]


@pytest.mark.parametrize("num_ids", [1, 2, 3, 4, 7, 11])
@pytest.mark.parametrize("goal", [(1, 1, 1), (1, 2, 3), (1, 1, 2, 3), (3, 3, 3, 1, 1, 2), (2, 2, 2, 2, 2, 2, 2, 3, 1)])
def test_the_division_of_images_among_decisions_is_the_best_of_all_divisions(goal, num_ids):
    task = make_task(3, len(goal), decisions=num_ids, goal=goal)
    counts = Counter(goal)

    divisions = [n for n in product(range(num_ids + 1), repeat=3) if sum(n) == num_ids]
    best = max(math.prod(Fraction(n[a - 1], num_ids) ** count for a, count in counts.items()) for n in divisions)

    assert task.memoryless_ceiling(deterministic=True) == pytest.approx(float(best), rel=1e-13, abs=0)
    assert task.memoryless_ceiling(deterministic=True) <= task.memoryless_ceiling() * (1 + 1e-13)


@pytest.mark.parametrize("goal", [(1, 2), (1, 1, 2), (1, 2, 3, 3), (2, 2, 2)])
@pytest.mark.parametrize("unique", ["", "w"])
def test_the_stochastic_ceiling_is_attained_and_never_exceeded(goal, unique):
    task = make_task(3, len(goal), 0.5, waits=2, decisions=2, unique=unique, goal=goal, fail_reward=-0.5)
    ceiling, generator = task.memoryless_ceiling(), torch.Generator().manual_seed(3)
    best = table(task, [1.0, 0.0, 0.0, 0.0], [0.0] + [goal.count(a) / len(goal) for a in (1, 2, 3)])

    noise = [random_policy(task, 4, generator, power=power) for power in (1, 3, 9) for _ in range(7)]
    nearby = [(1 - share) * best + share * policy for policy in noise for share in (1.0, 0.1, 1e-3)]

    assert task.policy_value(best) == pytest.approx(ceiling, rel=1e-12)
    assert max(task.policy_value(policy) for policy in nearby) < ceiling
    assert ceiling == pytest.approx(math.prod((goal.count(a) / len(goal)) ** goal.count(a) for a in {*goal}), rel=1e-15)


@pytest.mark.parametrize("unique", ["d", "wd"])
@pytest.mark.parametrize("deterministic", [False, True])
def test_unique_decisions_allow_the_whole_goal_reward(unique, deterministic):
    task = make_task(2, 2, 0.5, unique=unique, goal=(1, 2), goal_reward=3.0, fail_reward=-1.0)

    assert task.memoryless_ceiling(deterministic) == 3.0


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"reward_fn": Mixed()}, "Needle reward.*got Mixed"),
        ({"goal_reward": 0.0}, "goal_reward > 0"),
        ({"goal_reward": -1.0}, "goal_reward > 0"),
        ({"fail_reward": 0.1}, "fail_reward <= 0"),
        ({"reward_fn": Mixed(), "goal_reward": -1.0, "fail_reward": 1.0}, "Needle.*goal_reward > 0.*fail_reward <= 0"),
    ],
)
def test_a_ceiling_that_would_not_be_exact_is_refused(fields, message):
    task = make_task(2, 2, **fields)

    with pytest.raises(ValueError, match=message):
        task.memoryless_ceiling()


def test_enumeration_stops_at_its_documented_limit():
    largest, beyond = (make_task(2, d, reward_fn=OneAtTheGoal()) for d in (19, 20))

    assert largest.graph.num_states == MAX_ENUMERATED_STATES == 2**21
    assert largest.optimal_value(1.0) == 1.0
    for value in (lambda: beyond.optimal_value(1.0), lambda: beyond.policy_value(uniform(beyond))):
        with pytest.raises(ValueError, match=r"OneAtTheGoal.*4194304 states.*limit of 2097152 \(2\*\*21\)"):
            value()
