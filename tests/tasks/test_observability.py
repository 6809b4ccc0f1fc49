"""What a task shows of its state, and the ceiling of fixed sequences, against enumeration."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import pytest
from helpers.oracles import confounding, fully_observable, surjective

from ctgraph_rl import CTGraph, Gradient, Needle, StateType, Task
from ctgraph_rl.tasks.configurations import CONFIGURATIONS, ct_graph
from ctgraph_rl.tasks.observability import POLICIES, state_entropy, states_per_observation
from ctgraph_rl.tasks.values import open_loop_ceiling

State = tuple[StateType, tuple[int, ...]]
"""A kind of state, and the decisions that led there."""

HOME: State = (StateType.HOME, ())
ENDINGS = (StateType.END, StateType.FAIL)


def following(task: Task, state: State, action: int) -> dict[State, float]:
    """Where an action leads, by the definitions of section 2 of the paper."""
    (kind, path), p = state, task.graph.wait_prob
    if kind == StateType.HOME:
        return {(StateType.WAIT, ()): 1.0}
    if kind == StateType.DECISION:
        return {(StateType.WAIT, (*path, action)) if action else (StateType.FAIL, ()): 1.0}
    if action:
        return {(StateType.FAIL, ()): 1.0}
    onward = StateType.END if len(path) == task.graph.depth else StateType.DECISION
    return {state: p, (onward, path): 1 - p}


def probabilities(task: Task, policy: str, state: State) -> list[float]:
    """Of each action, by the definitions of section 2.2 of the paper."""
    kind, path = state
    b = task.graph.branching_factor
    if policy == "random":
        return [1 / (b + 1)] * (b + 1)
    if kind != StateType.DECISION:
        return [1.0] + [0.0] * b
    if policy == "navigation":
        return [0.0] + [1 / b] * b
    return [float(action == task.goal[len(path)]) for action in range(b + 1)]


def visits(task: Task, policy: str) -> dict[State, float]:
    """Expected visits of each state in an episode, by going on until what is left is below rounding."""
    found: dict[State, float] = defaultdict(float)
    alive: dict[State, float] = {HOME: 1.0}
    while alive and max(alive.values()) > 1e-18:
        after: dict[State, float] = defaultdict(float)
        for state, mass in alive.items():
            found[state] += mass
            if state[0] not in ENDINGS:
                for action, chance in enumerate(probabilities(task, policy, state)):
                    for target, share in following(task, state, action).items():
                        after[target] += mass * chance * share
        alive = after
    return found


def counted_entropy(task: Task, policy: str) -> float:
    """H(state | observation) from the joint distribution of states and ids."""
    joint: dict[tuple[State, object], float] = defaultdict(float)
    for state, mass in visits(task, policy).items():
        first, last = task.observations.ids(state[0])
        own = task.observations.is_unique(state[0])
        for shown in [state] if own else range(first, last + 1):
            joint[state, shown] += mass / (1 if own else last - first + 1)
    total = sum(joint.values())
    of_shown: dict[object, float] = defaultdict(float)
    for (_, shown), mass in joint.items():
        of_shown[shown] += mass
    return -sum(mass / total * math.log2(mass / of_shown[shown]) for (_, shown), mass in joint.items() if mass > 0)


TASKS = {
    **{name: make() for name, make in CONFIGURATIONS.items()},
    "b=3": ct_graph(3, 2, 0.3, (3, 1), fully_observable=False),
    "decisions": replace(confounding(p=0.5), observations=replace(fully_observable().observations, unique_waits=False)),
}


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_entropy_of_the_state_is_that_of_the_joint_distribution(task, policy):
    assert state_entropy(task, policy) == pytest.approx(counted_entropy(task, policy), rel=1e-9, abs=1e-12)


def test_a_fully_observable_task_leaves_nothing_open_and_a_surjective_one_does():
    assert {state_entropy(CONFIGURATIONS["CT-FO-B2"](), policy) for policy in POLICIES} == {0.0}
    assert state_entropy(surjective(), "optimal") == pytest.approx((3 * math.log2(3) + 2) / 7)
    assert state_entropy(surjective(), "navigation") > state_entropy(surjective(), "optimal")


def test_states_per_observation_count_the_states_of_a_kind():
    shared, own = states_per_observation(surjective()), states_per_observation(fully_observable())

    assert shared == {"wait": 7, "decision": 3, "end": 4}
    assert own == {"wait": 1, "decision": 1, "end": 1}


def test_observability_refuses_what_it_does_not_know():
    full = ct_graph(3, 2)
    legacy = replace(full, observations=replace(full.observations, legacy_index=True))

    with pytest.raises(ValueError, match="policy must be one of random, navigation, optimal, got 'greedy'"):
        state_entropy(full, "greedy")
    for measure in (state_entropy, states_per_observation):
        with pytest.raises(ValueError, match="not a legacy_index with branching_factor=3"):
            measure(legacy)


def best_sequence(task: Task, length: int) -> float:
    """The best return of a fixed sequence of actions after the home state; what has not ended by then gets nothing."""
    return max(sequence_return(task, actions) for actions in product(range(3), repeat=length))


def sequence_return(task: Task, actions: tuple[int, ...]) -> float:
    alive, total = {(StateType.WAIT, ()): 1.0}, 0.0
    for action in actions:
        total += sum(mass * paid for _, mass, paid in arrivals(task, alive, action))
        after: dict[State, float] = defaultdict(float)
        for state, mass in alive.items():
            for target, share in following(task, state, action).items():
                if target[0] not in ENDINGS:
                    after[target] += mass * share
        alive = after
    return total


def arrivals(task: Task, alive: dict[State, float], action: int) -> Iterator[tuple[State, float, float]]:
    """The endings that an action leads to, with their probability and reward."""
    for state, mass in alive.items():
        for target, share in following(task, state, action).items():
            if target[0] in ENDINGS:
                at_goal = target == (StateType.END, task.goal)
                paid = task.goal_reward if at_goal else task.fail_reward if target[0] == StateType.FAIL else 0.0
                yield target, mass * share, paid


@pytest.mark.parametrize("goal", [(1, 1), (1, 2)])
@pytest.mark.parametrize("p", [0.2, 0.5, 0.9])
def test_no_fixed_sequence_beats_the_open_loop_ceiling_and_long_ones_approach_it(p, goal):
    task = ct_graph(2, 2, p, goal, fully_observable=False)
    steps_at_the_end = 8 - 4  # of 8 actions, 2 leave the first wait states and 2 decide

    best = best_sequence(task, 8)

    assert best == pytest.approx((1 - p) ** 2 * (1 - p**steps_at_the_end), rel=1e-12)
    assert open_loop_ceiling(task) == pytest.approx((1 - p) ** 2, rel=1e-12)


def test_where_failing_costs_all_episodes_that_miss_the_goal_pay_it():
    task = replace(ct_graph(2, 1, 0.25, (2,)), goal_reward=2.0, fail_reward=-1.0)
    sequence = (0, 2) + (0,) * 30

    assert open_loop_ceiling(task) == pytest.approx(0.75 * 2 - 0.25)
    assert sequence_return(task, sequence) == pytest.approx(open_loop_ceiling(task))
    assert best_sequence(task, 8) <= open_loop_ceiling(task)


def test_episodes_of_one_length_need_no_observation():
    assert open_loop_ceiling(replace(surjective(goal=(2, 1)), reward_fn=Gradient(), step_reward=-0.1)) == pytest.approx(
        replace(surjective(goal=(2, 1)), reward_fn=Gradient(), step_reward=-0.1).optimal_value(1.0)
    )
    assert open_loop_ceiling(surjective(goal=(2, 1))) == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reward_fn": Gradient()}, "the open-loop ceiling is exact only for the Needle reward.* got Gradient"),
        ({"goal_reward": -1.0}, "goal_reward > 0.* got -1.0"),
        ({"fail_reward": 0.5}, "fail_reward <= 0.* got 0.5"),
        ({"step_reward": 0.1}, "step_reward = 0.* got 0.1"),
    ],
)
def test_the_open_loop_ceiling_of_other_rewards_is_refused_where_waiting_is_random(change, message):
    task = replace(ct_graph(2, 2, 0.5), reward_fn=Needle())

    with pytest.raises(ValueError, match=message):
        open_loop_ceiling(replace(task, **change))
    assert open_loop_ceiling(replace(task, graph=CTGraph(2, 2), **change)) is not None
