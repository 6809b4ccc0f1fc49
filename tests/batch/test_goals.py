"""Goals that change: from the environment's own randomness, and from outside."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.oracles import act, optimal, surjective

from ctgraph_rl import CTGraphEnv
from ctgraph_rl.core.philox import STREAM_GOAL, draw, randint_wide


def goals_of_episodes(env: CTGraphEnv, num_episodes: int) -> torch.Tensor:
    """The goal of each row in each episode, int64 [episodes, N]."""
    goals = []
    for _ in range(num_episodes):
        env.reset()
        goals.append(env.goal_leaf.clone())
    return torch.stack(goals)


def lengths_of_stays(goals: list[int]) -> list[int]:
    """How many episodes each goal lasted, without the last one that is cut."""
    changes = [i for i in range(1, len(goals)) if goals[i] != goals[i - 1]]
    return [later - earlier for earlier, later in zip([0, *changes], changes, strict=False)]


def test_a_goal_stays_without_a_change():
    env = CTGraphEnv([surjective(goal=(1, 2))] * 3)

    assert goals_of_episodes(env, 20).unique().tolist() == [1]


def test_the_first_goal_is_the_tasks_and_lasts_as_long_as_said():
    task = replace(surjective(2, 20, goal=(1,) * 20), goal_change=(3, 3))

    goals = goals_of_episodes(CTGraphEnv([task] * 5), 12)

    assert not goals[:3].any()
    stays = [lengths_of_stays(row) for row in goals.T.tolist()]
    assert stays == [[3, 3, 3]] * 5


def test_a_goal_lasts_for_a_number_of_episodes_drawn_from_the_whole_range():
    task = replace(surjective(2, 20, goal=(1,) * 20), goal_change=(2, 4))

    stays = [
        stay for row in goals_of_episodes(CTGraphEnv([task] * 200), 40).T.tolist() for stay in lengths_of_stays(row)
    ]

    counts = [stays.count(length) for length in (1, 2, 3, 4, 5)]
    assert counts[0] == counts[4] == 0
    expected, spread = len(stays) / 3, (len(stays) * 2 / 9) ** 0.5
    assert all(abs(count - expected) < 5 * spread for count in counts[1:4])


def test_new_goals_are_uniform_over_all_end_states():
    task = replace(surjective(3, 2, goal=(1, 1)), goal_change=(1, 1))

    goals = goals_of_episodes(CTGraphEnv([task] * 3000), 2)[1]

    counts = goals.bincount(minlength=9)
    assert (counts - 3000 / 9).abs().max() < 5 * (3000 * 8 / 81) ** 0.5


def test_a_changed_goal_is_what_is_rewarded():
    task = replace(surjective(2, 3, goal=(1, 1, 1)), goal_change=(1, 1))
    env = CTGraphEnv([task] * 50)
    env.reset()
    env.reset()

    for _ in range(8):
        bits = env.goal_leaf
        level = (env.node + 1).double().log2().floor().long()
        action = torch.where(env.state_type == 2, 1 + (bits >> (2 - level).clamp_min(0)) % 2, 0)
        last = act(env, action)

    assert env.goal_leaf.unique().numel() > 3
    assert last["outcome"].unique().tolist() == [3]
    assert last["reward"].unique().tolist() == [1.0]


def test_the_changes_of_a_row_follow_from_seed_and_row():
    task = replace(surjective(2, 20, goal=(1,) * 20), goal_change=(1, 3))

    goals = goals_of_episodes(CTGraphEnv([task] * 8, seed=5), 10)

    assert torch.equal(goals_of_episodes(CTGraphEnv([task] * 4, seed=5, first_row=4), 10), goals[:, 4:])
    assert not torch.equal(goals_of_episodes(CTGraphEnv([task] * 8, seed=6), 10), goals)


def test_a_row_without_changes_keeps_its_goal_beside_rows_with_changes():
    changing = replace(surjective(2, 20, goal=(1,) * 20), goal_change=(1, 1))

    goals = goals_of_episodes(CTGraphEnv([surjective(2, 20, goal=(2,) * 20), changing]), 6)

    assert goals[:, 0].unique().tolist() == [2**20 - 1]
    assert goals[:, 1].unique().numel() == 6


def test_goals_can_be_set_in_the_middle_of_an_episode():
    env = CTGraphEnv([surjective()] * 2)
    env.reset()
    for _ in range(3):
        act(env, optimal(env))

    env.set_goals(["1.2", (1, 1)])
    for _ in range(3):
        last = act(env, optimal(env))

    assert last["outcome"].flatten().tolist() == [2, 3]


def test_goals_can_be_set_as_numbers_of_end_states():
    env = CTGraphEnv([surjective()] * 2)

    env.set_goals(torch.tensor([3, 2]))

    assert env.goal_leaf.tolist() == [3, 2]


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        ([(1, 3), (1, 1)], "goal must be 2 decisions in 1..2"),
        (["1.3", "1.1"], "goal must be 2 decisions in 1..2, such as 1.1, got 1.3"),
        ([1, 2], r"goals must be decisions, got \[1, 2\]: write decisions as"),
        ([(1, 1)], "one goal per row"),
        (torch.tensor([0, 4]), r"goals must be end states of the rows' trees, got \[4\]"),
        (torch.tensor([0.0, 1.0]), "goals must be int64 of shape"),
    ],
)
def test_goals_that_no_tree_has_are_refused(goals, message):
    env = CTGraphEnv([surjective()] * 2)

    with pytest.raises(ValueError, match=message):
        env.set_goals(goals)


@pytest.mark.parametrize("change", [(0, 3), (3, 2), (1,), 4, (1.0, 2)])
def test_a_range_of_episodes_out_of_order_is_refused(change):
    with pytest.raises(ValueError, match="goal_change must be"):
        replace(surjective(), goal_change=change)


def test_wide_draws_are_the_exact_product_of_sixty_four_bits():
    high = torch.tensor([1, 3, 2**31, 3**39, 2**62])
    upper, lower = torch.tensor([0, 2**32 - 1, 123456789, 2**31]), torch.tensor([0, 2**32 - 1, 987654321, 5])

    found = [randint_wide((u, w), high).tolist() for u, w in zip(upper, lower, strict=True)]

    words = [int(u) << 32 | int(w) for u, w in zip(upper, lower, strict=True)]
    assert found == [[word * int(h) >> 64 for h in high] for word in words]


def test_a_goals_duration_and_the_next_goal_are_three_different_words_of_the_rows_stream():
    task = replace(surjective(2, 20, goal=(1,) * 20), goal_change=(2, 4))
    expected = []
    for row in (7, 8, 9):
        goal = left = 0
        for tick in range(1, 31):
            words = list(map(int, draw(*map(torch.tensor, (5, row, tick)), STREAM_GOAL)))
            goal = ((words[1] << 32) + words[2]) >> 44 if left == 1 else goal
            left = left - 1 if left > 1 else 2 + (words[0] * 3 >> 32)
            expected.append(goal)

    goals = goals_of_episodes(CTGraphEnv([task] * 3, seed=5, first_row=7), 30)

    assert goals.T.flatten().tolist() == expected


def test_new_tasks_start_the_count_of_episodes_anew():
    tasks = [replace(surjective(2, 20, goal=(1,) * 20), goal_change=(3, 3))] * 5
    env = CTGraphEnv(tasks)
    goals_of_episodes(env, 2)

    env.set_tasks(tasks)
    goals = goals_of_episodes(env, 4)

    assert not goals[:3].any()
    assert goals[3].all()


def test_a_seed_starts_the_goals_and_the_count_of_episodes_anew():
    env = CTGraphEnv([replace(surjective(2, 20, goal=(1,) * 20), goal_change=(3, 3))] * 5, seed=4)
    expected = goals_of_episodes(env, 8)

    env.set_seed(4)
    goals = goals_of_episodes(env, 8)

    assert not goals[:3].any()
    assert torch.equal(goals, expected)
