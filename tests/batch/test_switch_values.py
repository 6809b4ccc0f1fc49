"""The switches of the authors' implementation in time: goals, values and the loop."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from helpers.oracles import (
    ALPHA,
    END,
    FAIL,
    HOME,
    binomial_p_value,
    confounding,
    is_uniform,
    one_hot,
    surjective,
    tree_states,
    tree_step,
)
from helpers.probability_tables import success_prob
from helpers.task_families import extra, legacy_number, read, unique
from tensordict import TensorDict
from torch import Tensor

from ctgraph_rl import (
    Block,
    CTGraphEnv,
    Curriculum,
    Evaluation,
    Needle,
    ReferenceLinear,
    Task,
    evaluate,
    learn_curriculum,
)
from ctgraph_rl.policies import NavigationPolicy, OptimalPolicy, RandomPolicy, SearchPolicy

# Goals


def goals_of_episodes(env: CTGraphEnv, num_episodes: int) -> list[list[int]]:
    """The goal of each episode by row."""
    goals = []
    for _ in range(num_episodes):
        env.reset()
        goals.append(env.goal_leaf.clone())
    return torch.stack(goals, 1).tolist()


def first_episodes(goals: list[int]) -> list[int]:
    """Numbers of the episodes that have another goal than the one before; counted from 1."""
    return [k for k, (before, now) in enumerate(pairwise(goals), 2) if now != before]


def test_a_file_with_five_episodes_changes_the_goal_at_episodes_5_10_15_20():
    tasks = [read(d=20, episodes=(5, 6)), replace(read(d=20, episodes=(5, 6)), legacy_goal_change=False)]

    legacy, normal = goals_of_episodes(CTGraphEnv(tasks, seed=1), 24)

    assert (legacy[:4], normal[:5]) == ([0] * 4, [0] * 5)
    assert first_episodes(legacy) == [5, 10, 15, 20]
    assert first_episodes(normal) == [6, 11, 16, 21]
    assert [normal] == goals_of_episodes(CTGraphEnv(tasks[1:], seed=1, first_row=1), 24)


def test_goals_that_last_one_episode_are_never_the_tasks_own():
    task = read(d=20, episodes=(1, 2))

    goals = goals_of_episodes(CTGraphEnv([task, replace(task, legacy_goal_change=False)]), 12)

    assert [first_episodes([0, *row]) for row in goals] == [list(range(2, 14)), list(range(3, 14))]


def test_a_random_number_of_episodes_excludes_the_last_of_the_file_and_the_first_goal_has_one_less():
    goals = goals_of_episodes(CTGraphEnv([read(d=20, episodes=(2, 5))] * 600), 30)

    changes = [first_episodes([0, *row]) for row in goals]
    lasts = [[later - earlier for earlier, later in zip([2, *row], row, strict=False)] for row in changes]
    assert is_uniform([sum(stays[0] == n for stays in lasts) for n in (1, 2, 3)])
    assert is_uniform([sum(stays.count(n) for stays in (row[1:] for row in lasts)) for n in (2, 3, 4)], 1e-9)
    assert {n for stays in lasts for n in stays[1:]} == {2, 3, 4}
    assert {stays[0] for stays in lasts} == {1, 2, 3}


def test_the_goal_after_one_that_lasted_no_episode_lasts_for_a_number_drawn_anew():
    goals = goals_of_episodes(CTGraphEnv([read(d=20, episodes=(1, 4))] * 3000), 5)

    changes = [first_episodes([0, *row]) for row in goals]
    second = [row[1] - 2 for row in changes if row[0] == 2]
    assert binomial_p_value(len(second), 3000, 1 / 3) >= ALPHA
    assert is_uniform([second.count(n) for n in (1, 2, 3)])


def test_a_legacy_count_without_changes_leaves_goals_alone():
    changing = replace(surjective(), goal_change=(1, 1))
    env = CTGraphEnv([replace(surjective(goal=(2, 1)), legacy_goal_change=True), changing])

    goals = goals_of_episodes(env, 20)

    assert (set(goals[0]), len(set(goals[1]))) == ({2}, 4)


# Values


def value_by_sweeps(task: Task, gamma: float, policy: Tensor | None = None) -> float:
    """Value iteration over the states by the decisions taken; without a policy the best action is taken."""
    b, d, p = task.graph.branching_factor, task.graph.depth, task.graph.wait_prob
    values = dict.fromkeys(tree_states(b, d), 0.0)

    def entered(kind, path) -> float:
        if kind == FAIL:
            return task.fail_reward
        if kind != END:
            return 0.0
        if task.reward_fn == Needle():
            return task.goal_reward * (path == task.goal)
        weights = range(d, 0, -1)
        kept = sum(w * (1 - abs(a - g)) for w, a, g in zip(weights, path, task.goal, strict=True))
        return task.goal_reward * kept / sum(weights)

    def worth(state, action: int) -> float:
        if state[0] == END:
            return task.step_reward if task.extra_end_step else 0.0
        value = task.step_reward
        for stays, prob in ((True, p), (False, 1 - p)):
            after = tree_step(b, d, state, action, stays)
            value += prob * (entered(*after) * (after != state) + gamma * values.get(after, 0.0))
        return value

    def probs(state) -> list[float]:
        first, last = task.observations.ids(state[0])
        if task.observations.is_unique(state[0]):
            return policy[first + legacy_number(b, state[1]) % (last - first + 1)].tolist()
        return policy[first : last + 1].mean(0).tolist()

    for _ in range(40 if p else 2 * d + 3):
        for state in reversed(values):
            actions = [worth(state, action) for action in range(b + 1)]
            mean = 0.0 if policy is None else sum(x * y for x, y in zip(probs(state), actions, strict=True))
            values[state] = max(actions) if policy is None else mean
    return values[HOME, ()]


SHAPES = [
    unique(3, 2, legacy_index=True),
    unique(3, 2, 0.25, legacy_index=True, decisions=False),
    unique(2, 3, 0.25, legacy_index=True, waits=False),
    unique(4, 1, 0.25, 3, legacy_index=True),
    confounding(2, 2, 0.25, legacy_index=True),
]
REWARDS = [
    {"step_reward": -0.25, "fail_reward": -1.0},
    {"step_reward": 0.125, "reward_fn": ReferenceLinear(), "goal_reward": 2.0},
    {"fail_reward": -0.5, "reward_fn": ReferenceLinear()},
]


@pytest.mark.parametrize("gamma", [0.0, 0.75, 1.0])
@pytest.mark.parametrize("rewards", REWARDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_values_are_those_of_value_iteration_with_and_without_an_extra_step(shape, rewards, gamma):
    b, generator = shape.graph.branching_factor, torch.Generator().manual_seed(1)
    policy = torch.rand(shape.images.num_images, b + 1, generator=generator, dtype=torch.float64)
    policy /= policy.sum(-1, keepdim=True)

    for task in (replace(shape, **rewards), extra(shape, **rewards)):
        assert task.optimal_value(gamma) == pytest.approx(value_by_sweeps(task, gamma), rel=1e-6, abs=1e-12)
        assert task.policy_value(policy, gamma) == pytest.approx(value_by_sweeps(task, gamma, policy), rel=1e-6)


def test_an_extra_step_costs_one_step_reward_after_an_end_and_none_after_a_failure():
    normal = replace(surjective(goal=(1, 1)), step_reward=-0.125)
    waits_well, fails = torch.tensor([1.0, 0, 0]).repeat(5, 1), torch.tensor([0, 1.0, 0]).repeat(5, 1)
    waits_well[3] = torch.tensor([0, 1.0, 0])

    for gamma in (0.5, 1.0):
        found = [
            extra(normal).policy_value(policy, gamma) - normal.policy_value(policy, gamma)
            for policy in (waits_well, fails)
        ]
        assert found == [-0.125 * gamma**6, 0.0]
    assert (extra(normal).optimal_value(1.0), normal.optimal_value(1.0)) == (1 - 7 / 8, 1 - 6 / 8)
    assert extra(normal, step_reward=-0.5).optimal_value(1.0) == -1.0  # it fails at once
    assert success_prob(extra(normal), waits_well) == success_prob(normal, waits_well) == 1.0


def test_the_value_of_the_best_policy_is_what_it_gets():
    task = extra(unique(3, 2, goal=(3, 2), legacy_index=True), step_reward=-1 / 16, fail_reward=-1.0)

    ends = evaluate(OptimalPolicy, [task, replace(task, extra_end_step=False)], 3)

    assert ends["episode_reward"][..., 0].tolist() == [[1 - 7 / 16] * 3, [1 - 6 / 16] * 3]
    assert task.optimal_value(1.0) == 1 - 7 / 16


# Policies and the loop


MIXED = [extra(surjective(2, 2, goal=(1, 2))), surjective(2, 2, goal=(2, 1)), extra(surjective(3, 1, 0.5, goal=(3,)))]


def outcomes(policy: type[RandomPolicy], tasks: list[Task], num_steps: int, num_episodes: int) -> Tensor:
    """The outcomes of each row's first episodes."""
    torch.manual_seed(0)
    env = CTGraphEnv(tasks)
    data = env.rollout(num_steps, policy(env), break_when_any_done=False)["next"]
    return torch.stack([row["outcome"][row["done"]][:num_episodes] for row in data])


def test_the_optimal_policy_reaches_every_goal_and_navigation_never_fails():
    assert outcomes(OptimalPolicy, MIXED * 5, 70, 5).unique().tolist() == [3]
    assert outcomes(NavigationPolicy, MIXED * 20, 70, 5).unique().tolist() == [2, 3]


def test_the_random_policy_reaches_the_goal_as_often_as_without_an_extra_step():
    task = extra(surjective(2, 1))

    wins = (outcomes(RandomPolicy, [task] * 2000, 60, 8) == 3).sum().item()

    assert binomial_p_value(wins, 16_000, task.graph.reward_prob_random) >= ALPHA


def test_the_searcher_tries_each_end_state_once_and_then_stays_with_the_goal():
    found = outcomes(SearchPolicy, MIXED * 40, 100, 8)

    first = (found == 3).int().argmax(1)
    assert (found == 3).any(1).all()
    assert all((row[index:] == 3).all() for row, index in zip(found, first, strict=True))
    assert first.max() <= 3 and set(first[:: len(MIXED)].tolist()) == {0, 1, 2, 3}


class Fixed:
    """An agent that waits, decides for the first branch and learns nothing."""

    num_envs, num_steps = 4, 5

    def __init__(self) -> None:
        self.batches = []

    def policy(self, data):
        return data.set("action", (data["observation"][..., 3] > 0).long())

    def initial_state(self, num_envs):
        return TensorDict(batch_size=[num_envs])

    def start_task(self, task=None):
        pass

    def learn(self, batch):
        self.batches.append(batch.clone())
        return {"loss": 0.0}

    end_task = start_task


def test_a_curriculum_of_switched_tasks_is_learned_and_evaluated_with_episodes_of_one_more_step():
    first, second = (extra(one_hot(goal=goal), step_reward=-1 / 8) for goal in ((1, 1), (2, 1)))
    blocks = (Block((first, second), 56), Block(replace(first, extra_end_step=False), 48))
    agent = Fixed()

    log = learn_curriculum(Curriculum("switched", 1, "here", blocks, Evaluation(3)), agent)

    evaluated = [(m["return_mean"], m["success_rate"], m["length_mean"]) for m in log.of_kind("evaluation")]
    assert evaluated == [(1 / 8, 1.0, 7.0), (-7 / 8, 0.0, 7.0), (1 / 4, 1.0, 6.0)] * 3
    trained = [(m["episodes"], m["return_mean"], m["length_mean"]) for m in log.of_kind("training")]
    assert trained == [
        (0, None, None),
        (4, -3 / 8, 7.0),
        (4, -3 / 8, 7.0),
        (0, None, None),
        (4, 1 / 4, 6.0),
        (4, 1 / 4, 6.0),
    ]
    data = torch.cat(agent.batches[:3], 1)
    assert data["is_init"][0, :, 0].nonzero().flatten().tolist() == [0, 7]
    assert data["next", "reward"][0, :7, 0].tolist() == [-1 / 8] * 5 + [7 / 8, -1 / 8]
