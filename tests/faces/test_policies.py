"""Reference policies get exactly what theory says."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from helpers.oracles import surjective

import curricula
from ctgraph_rl import CTGraphEnv, evaluate
from ctgraph_rl.metrics.adaptation import exact_search
from ctgraph_rl.policies import NavigationPolicy, OptimalPolicy, RandomPolicy, SearchPolicy

MIXED = [surjective(2, 3, goal=(1, 2, 2)), surjective(3, 2, goal=(3, 2))]


def outcomes(policy_type: type[RandomPolicy], tasks: list, num_steps: int, seed: int = 0) -> torch.Tensor:
    """The outcome of every finished episode, [row, episode] as far as all rows got."""
    torch.manual_seed(seed)
    env = CTGraphEnv(tasks)
    data = env.rollout(num_steps, policy_type(env), break_when_any_done=False)
    ends = [row["outcome"][row["done"]] for row in data["next"]]
    return torch.stack([end[: min(map(len, ends))] for end in ends])


def test_the_optimal_policy_always_reaches_the_goal_of_every_tree():
    found = outcomes(OptimalPolicy, MIXED * 4, 40)

    assert found.unique().tolist() == [3]


def test_the_optimal_policy_follows_a_goal_that_was_set():
    env = CTGraphEnv([surjective()] * 4)
    env.reset()
    env.set_goals(torch.arange(4))

    data = env.rollout(6, OptimalPolicy(env), auto_reset=False, tensordict=env.reset())

    assert data["next", "leaf"][:, -1, 0].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("policy_type", "prob"),
    [(RandomPolicy, surjective(3, 1).graph.reward_prob_random), (NavigationPolicy, 1 / 3)],
)
def test_random_and_navigation_policies_reach_the_goal_as_often_as_the_closed_forms_say(policy_type, prob):
    wins = outcomes(policy_type, [surjective(3, 1)] * 400, 200)[:, :25] == 3

    n = wins.numel()
    assert n == 10_000
    assert abs(wins.sum().item() - n * prob) < 5 * math.sqrt(n * prob * (1 - prob))


def test_a_navigation_policy_never_fails():
    assert 1 not in outcomes(NavigationPolicy, MIXED * 20, 60)


def test_the_searcher_tries_each_end_state_at_most_once_and_then_stays_with_the_goal():
    found = outcomes(SearchPolicy, MIXED * 50, 120)

    first = (found == 3).int().argmax(1)
    assert (found == 3).any(1).all()
    assert all((row[index:] == 3).all() for row, index in zip(found, first, strict=True))
    assert first[0::2].max() <= 7 and first[1::2].max() <= 8


ROWS = 2000


@pytest.mark.parametrize("stays", [True, False])
@pytest.mark.parametrize("extra_end_step", [True, False])
def test_the_searcher_succeeds_in_each_episode_as_often_as_the_closed_form_says(stays, extra_end_step):
    """Goals are drawn uniformly of four, and drawn again after eight episodes where they do not stay."""
    goals = [(1, 1), (1, 2), (2, 1), (2, 2)]
    tasks = []
    for goal in goals:
        task = replace(surjective(2, 2, goal=goal), extra_end_step=extra_end_step)
        tasks.append(task if stays else replace(task, goal_change=(8, 8)))

    ends = evaluate(SearchPolicy, tasks, 16 * ROWS // 4, seed=3, episodes_per_row=16)

    success = (ends["outcome"] == 3).view(ROWS, 16).double()
    life = exact_search(4, 8)
    expected = torch.cat([life, torch.ones(8) if stays else life])
    spread = 5 * (expected * (1 - expected) / ROWS).sqrt()
    assert ((success.mean(0) - expected).abs() <= spread).all()


def test_the_searcher_does_not_know_of_a_goal_that_it_has_not_met():
    """In its first episode after a change it goes to the old goal, whatever the new one is."""
    swapped = curricula.load("penn_a_swap", num_lives=1, num_rows=16).evaluation.held_out

    ends = evaluate(SearchPolicy, swapped, 52 * 40, seed=1, episodes_per_row=52)

    leaf = ends["leaf"].view(-1, 52)
    success = (ends["outcome"] == 3).view(-1, 52)
    assert success[:, 49].all()
    assert (leaf[:, 50] == leaf[:, 49]).all()
    assert success[:, 50].double().mean().item() == pytest.approx(1 / 4, abs=5 * math.sqrt(3 / 16 / len(leaf)))


@pytest.mark.slow
def test_the_searcher_needs_as_many_episodes_as_e_kappa_says():
    task = surjective(3, 2, goal=(2, 1))
    rows = 4000

    kappa = 1 + (outcomes(SearchPolicy, [task] * rows, 60) == 3).int().argmax(1)

    spread = math.sqrt((9**2 - 1) / 12 / rows)
    assert task.graph.expected_search_episodes == 5
    assert abs(kappa.double().mean().item() - 5) < 5 * spread
    assert kappa.unique().tolist() == list(range(1, 10))
