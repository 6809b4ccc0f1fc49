"""Episodes of the batched environment: who reaches the goal, after how many steps, for what reward."""

import dataclasses
from dataclasses import dataclass
from itertools import product

import pytest
import torch
from helpers.oracles import (
    ALPHA,
    FAIL,
    WAIT,
    PlainCTGraph,
    act,
    binomial_p_value,
    is_uniform,
    navigation,
    optimal,
    play,
    scripts,
    surjective,
    uniform,
)

from ctgraph_rl import CTGraphEnv
from ctgraph_rl.core.dynamics import NO_LEAF, OUTCOME_FAIL, OUTCOME_GOAL, OUTCOME_OTHER_END, OUTCOME_RUNNING
from curricula.paper import ct_su_b1


@dataclass(frozen=True)
class PathReward:
    """A user's own reward: the leaf's number."""

    def __call__(self, arrival):
        return arrival.leaf.to(torch.float32)


@pytest.mark.parametrize(("b", "d"), [(2, 1), (2, 2), (3, 2), (2, 4), (4, 3), (2, 16), (2, 60)])
def test_the_optimal_policy_gets_exactly_one_in_exactly_two_times_d_plus_one_steps(b, d):
    goals = [(1,) * d, (b,) * d, tuple(1 + i % b for i in range(d))]
    env = CTGraphEnv([surjective(b, d, goal=goal) for goal in goals])

    last = play(env, optimal)

    assert last["episode_reward"].flatten().tolist() == [1.0, 1.0, 1.0]
    assert last["step_count"].flatten().tolist() == [2 * (d + 1)] * 3
    assert last["outcome"].flatten().tolist() == [OUTCOME_GOAL] * 3
    assert last["leaf"].flatten().tolist() == [task.goal_leaf for task in env.tasks]


@pytest.mark.parametrize(("b", "d"), [(2, 3), (3, 2)])
def test_the_optimal_policy_reaches_every_goal(b, d):
    env = CTGraphEnv([surjective(b, d, goal=goal) for goal in product(range(1, b + 1), repeat=d)])

    last = play(env, optimal)

    assert last["leaf"].flatten().tolist() == list(range(b**d))
    assert last["episode_reward"].sum() == b**d


@pytest.mark.parametrize("p", [0.5, 0.9])
def test_an_optimal_episode_with_waiting_still_gets_exactly_one(p):
    env = CTGraphEnv([surjective(2, 2, p, goal=(1, 2))] * 500, seed=1, check_actions=False)

    last = play(env, optimal)

    assert last["episode_reward"].unique().tolist() == [1.0]
    assert last["step_count"].min() >= 6


@pytest.mark.parametrize("p", [0.5, 0.9])
def test_the_waiting_of_an_optimal_episode_is_as_long_as_e_rho(p):
    task, rows = surjective(2, 2, p, goal=(1, 2)), 5_000
    env = CTGraphEnv([task] * rows, seed=1, check_actions=False)

    steps = play(env, navigation(seed=1))["step_count"].sum().item()

    # 3 * rows escapes need a negative binomial number of tries: escapes among the tries are binomial(tries, 1 - p)
    tries = steps - 3 * rows
    assert task.graph.expected_episode_length == pytest.approx(3 / (1 - p) + 3)
    assert binomial_p_value(3 * rows, tries, 1 - p) >= ALPHA


@pytest.mark.parametrize(
    ("b", "d", "p"),
    [(3, 2, 0.0), *(pytest.param(*shape, marks=pytest.mark.slow) for shape in ((2, 2, 0.0), (2, 4, 0.5)))],
)
def test_a_navigation_policy_gets_the_reward_with_probability_b_to_the_minus_d(b, d, p):
    rows = 20_000
    env = CTGraphEnv([surjective(b, d, p, goal=(b,) * d)] * rows, seed=1, check_actions=False)

    last = play(env, navigation(seed=2))

    assert (last["outcome"] >= OUTCOME_OTHER_END).all()
    assert binomial_p_value(int(last["episode_reward"].sum()), rows, b**-d) >= ALPHA
    assert is_uniform(torch.bincount(last["leaf"].flatten()).tolist())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "prob"),
    [(ct_su_b1((1, 2)), 1 / 243), (surjective(2, 2, 0.5, goal=(2, 1)), 3 / 3375), (surjective(3, 1, 0.5), 1 / 196)],
    ids=["CT-SU-B1", "p=.5", "b=3"],
)
def test_a_uniformly_random_policy_gets_the_reward_with_probability_p_r(task, prob):
    rows, batches, ends = 100_000, 4, task.graph.num_end_states
    env = CTGraphEnv([task] * rows, seed=1, check_actions=False)

    outcomes = torch.cat([play(env, uniform(seed))["outcome"] for seed in range(batches)])

    goals, arrivals = (outcomes == OUTCOME_GOAL).sum().item(), (outcomes >= OUTCOME_OTHER_END).sum().item()
    assert task.graph.reward_prob_random == pytest.approx(prob, rel=1e-12)
    assert binomial_p_value(goals, rows * batches, prob) >= ALPHA / 2
    assert binomial_p_value(arrivals, rows * batches, ends * prob) >= ALPHA / 2


def test_every_row_follows_the_papers_tree_for_any_actions():
    tasks = [surjective(b, d, goal=(b, *[1] * (d - 1))) for b in (2, 3, 4) for d in (1, 2, 3)]
    env, rows, outcomes = CTGraphEnv(tasks), [PlainCTGraph(task) for task in tasks], set()
    data = env.reset()

    for actions in scripts(300, 9, num_actions=5):
        step, data = env.step_and_maybe_reset(data.set("action", actions))
        expected = [row.step(action) for row, action in zip(rows, actions.tolist(), strict=True)]
        for row, now in zip(rows, expected, strict=True):
            if now["done"]:
                row.reset()
            outcomes.add(now["outcome"])

        assert {key: [now[key] for now in expected] for key in expected[0]} == {
            key: step["next", key].flatten().tolist() for key in expected[0]
        }
        assert env.state_type.tolist() == [row.state[0] for row in rows]
        assert env.node.tolist() == [row.numbers[row.state[1]] for row in rows]
        assert data["is_init"].flatten().tolist() == [now["done"] for now in expected]
    assert outcomes == {OUTCOME_RUNNING, OUTCOME_FAIL, OUTCOME_OTHER_END, OUTCOME_GOAL}


def test_outcome_and_leaf_tell_fail_other_ends_and_the_goal_apart():
    env = CTGraphEnv([surjective(2, 2, goal=(2, 1))] * 4)
    env.reset()

    data = [act(env, a) for a in ([0] * 4, [0] * 4, [2, 2, 1, 1], [0] * 4, [1, 2, 2, 1], [0, 0, 0, 2])]

    assert [step["outcome"].sum().item() for step in data[:-1]] == [OUTCOME_RUNNING] * 5
    assert [step["leaf"].unique().item() for step in data[:-1]] == [NO_LEAF] * 5
    assert data[-1]["outcome"].flatten().tolist() == [OUTCOME_GOAL, OUTCOME_OTHER_END, OUTCOME_OTHER_END, OUTCOME_FAIL]
    assert data[-1]["leaf"].flatten().tolist() == [2, 3, 1, NO_LEAF]


def test_the_codes_of_outcomes_are_those_of_the_documentation():
    assert (OUTCOME_RUNNING, OUTCOME_FAIL, OUTCOME_OTHER_END, OUTCOME_GOAL, NO_LEAF) == (0, 1, 2, 3, -1)


@pytest.mark.parametrize("action", [1, 2])
def test_an_action_other_than_wait_at_a_wait_state_fails(action):
    env = CTGraphEnv([surjective()])
    env.reset()
    act(env, [0])

    last = act(env, [action])

    assert (last["outcome"].item(), last["terminated"].item(), env.state_type.item()) == (OUTCOME_FAIL, True, FAIL)


def test_a_wait_action_at_a_decision_state_fails():
    env = CTGraphEnv([surjective()])
    env.reset()
    act(env, [0])
    act(env, [0])

    last = act(env, [0])

    assert (last["outcome"].item(), last["terminated"].item(), env.state_type.item()) == (OUTCOME_FAIL, True, FAIL)


@pytest.mark.parametrize("action", [0, 1, 2])
def test_any_action_leaves_home(action):
    env = CTGraphEnv([surjective()])
    env.reset()

    last = act(env, [action])

    assert (env.state_type.item(), last["outcome"].item(), last["step_count"].item()) == (WAIT, OUTCOME_RUNNING, 1)


def test_an_action_above_a_rows_own_branching_factor_fails_where_it_is_legal_for_another():
    env = CTGraphEnv([surjective(2, 1), surjective(3, 1)])
    env.reset()
    act(env, [3, 3])
    act(env, [0, 0])

    last = act(env, [3, 3])

    assert last["outcome"].flatten().tolist() == [OUTCOME_FAIL, OUTCOME_RUNNING]
    assert env.state_type.tolist() == [FAIL, WAIT]


def test_the_fail_reward_is_paid_once_on_entering_the_fail_state():
    env = CTGraphEnv([dataclasses.replace(surjective(), fail_reward=-0.5)], check_actions=False)
    env.reset()

    steps = [act(env, [action]) for action in (0, 2, 0, 1)]

    assert [step["reward"].item() for step in steps] == [0.0, -0.5, 0.0, 0.0]
    assert [step["episode_reward"].item() for step in steps] == [0.0, -0.5, -0.5, -0.5]


def test_the_goal_reward_is_paid_once_on_entering_the_goal():
    env = CTGraphEnv([dataclasses.replace(surjective(2, 1), goal_reward=2.5, fail_reward=-1.0)], check_actions=False)
    env.reset()

    steps = [act(env, [action]) for action in (0, 0, 1, 0, 0, 1)]

    assert [step["reward"].item() for step in steps] == [0.0, 0.0, 0.0, 2.5, 0.0, 0.0]
    assert [step["terminated"].item() for step in steps] == [False, False, False, True, True, True]


def test_rows_may_have_rewards_of_their_own():
    paths = dataclasses.replace(surjective(2, 2, goal=(2, 1)), reward_fn=PathReward(), goal_reward=0.5)
    env = CTGraphEnv([surjective(2, 2, goal=(2, 2)), paths, surjective(2, 2, goal=(1, 1))])
    env.reset()

    for action in (0, 0, 2, 0, 2):
        act(env, [action] * 3)
    last = act(env, [0, 0, 0])

    assert last["reward"].flatten().tolist() == [1.0, 1.5, 0.0]
    assert last["outcome"].flatten().tolist() == [OUTCOME_GOAL, OUTCOME_OTHER_END, OUTCOME_OTHER_END]
