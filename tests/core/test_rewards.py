"""What steps pay: the rewards of end states, their noise, the reward of a step, the cue."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import pytest
import torch
from helpers.oracles import ALPHA, act, optimal, play, surjective

from ctgraph_rl import CTGraph, CTGraphEnv, Gradient, Needle, ReferenceLinear, Task
from ctgraph_rl.core.philox import STREAM_REWARD, draw, normal, normal_table
from ctgraph_rl.core.rewards import Arrival

CLT_BOUND = 5.0
"""A mean of many draws is further than 5 standard errors from its expectation less than once in 1 / ALPHA times."""


def arrival(b: int, d: int, goal: int, max_depth: int | None = None) -> Arrival:
    """Every end state of a tree at once."""
    leaf = torch.arange(b**d)
    rest = (torch.full_like(leaf, value) for value in (goal, b, d))
    return Arrival(leaf, *rest, max_depth=max_depth or d)


def decisions(b: int, d: int) -> list[tuple[int, ...]]:
    return list(product(range(b), repeat=d))


def rewards_at_the_end(task: Task, num_rows: int, seed: int = 0) -> torch.Tensor:
    env = CTGraphEnv([task] * num_rows, seed=seed)
    return play(env, optimal)["episode_reward"].squeeze(-1).double()


def test_the_needle_pays_one_at_the_goal_and_nothing_elsewhere():
    share = Needle()(arrival(3, 2, goal=5))

    assert share.tolist() == [0, 0, 0, 0, 0, 1, 0, 0, 0]


@pytest.mark.parametrize(("b", "d", "goal"), [(2, 2, 1), (3, 2, 4), (2, 4, 15), (4, 3, 0)])
def test_the_gradient_is_the_corrected_equation_of_the_paper(b, d, goal):
    wanted = decisions(b, d)[goal]

    share = Gradient()(arrival(b, d, goal))

    weights = [b**k for k in reversed(range(d))]
    lost = [sum(w * abs(a - g) for w, a, g in zip(weights, taken, wanted, strict=True)) for taken in decisions(b, d)]
    torch.testing.assert_close(share, torch.tensor([1 - x / (b**d - 1) for x in lost]), atol=1e-6, rtol=0)
    assert share[goal] == 1


def test_the_gradient_is_equally_spaced_from_zero_to_one_when_the_goal_is_the_last_end_state():
    share = Gradient()(arrival(2, 3, goal=7))

    torch.testing.assert_close(share, torch.arange(8) / 7)


def test_the_gradient_of_a_deep_tree_is_finite_and_one_at_the_goal():
    deep = Arrival(*(torch.tensor([value]) for value in (3**30 - 1, 3**30 - 1, 3, 30)), max_depth=30)
    opposite = deep._replace(leaf=torch.tensor([0]))

    assert Gradient()(deep).tolist() == [1.0]
    assert Gradient()(opposite).abs().item() < 1e-6


@pytest.mark.parametrize("reward_fn", [Gradient(), ReferenceLinear()])
def test_a_row_is_paid_the_same_beside_deeper_rows(reward_fn):
    alone = reward_fn(arrival(2, 3, goal=2))

    assert torch.equal(reward_fn(arrival(2, 3, goal=2, max_depth=9)), alone)


def test_the_linear_reward_of_the_reference_comes_in_thirds_at_depth_two():
    share = ReferenceLinear()(arrival(2, 2, goal=0))

    torch.testing.assert_close(share, torch.tensor([1, 2 / 3, 1 / 3, 0]))


def test_the_linear_reward_of_the_reference_falls_to_minus_one_with_three_branches():
    share = ReferenceLinear()(arrival(3, 2, goal=0))

    assert share.min().item() == -1
    assert share.argmin().item() == 8


def test_a_step_reward_is_paid_at_every_step_in_addition():
    task = replace(surjective(), step_reward=0.5, goal_reward=2.0, fail_reward=-1.0)
    env = CTGraphEnv([task])
    env.reset()

    paid = [act(env, optimal(env))["reward"].item() for _ in range(6)]
    env.reset()
    failed = [act(env, [action])["reward"].item() for action in (0, 1)]

    assert paid == [0.5] * 5 + [2.5]
    assert failed == [0.5, -0.5]


def test_additive_noise_has_the_mean_of_the_reward_and_the_given_deviation():
    n = 10_000

    paid = rewards_at_the_end(replace(surjective(), reward_std=0.5, goal_reward=2.0), n)

    assert abs(paid.mean().item() - 2) < CLT_BOUND * 0.5 / math.sqrt(n)
    assert abs(paid.var().item() - 0.25) < CLT_BOUND * 0.25 * math.sqrt(2 / n)


def test_additive_noise_is_paid_at_every_end_state_and_multiplicative_noise_only_with_a_reward():
    wrong_goal = replace(surjective(goal=(2, 2)), reward_std=0.5)
    rows = 64
    env = CTGraphEnv([wrong_goal] * rows + [replace(wrong_goal, reward_noise="multiplicative")] * rows)

    paid = play(env, lambda env: (env.state_type == 2).long())["episode_reward"].squeeze(-1)

    assert paid[:rows].unique().numel() == rows
    assert not paid[rows:].any()


def test_multiplicative_noise_scales_with_the_reward():
    n = 10_000

    paid = rewards_at_the_end(replace(surjective(), reward_std=0.1, goal_reward=3.0, reward_noise="multiplicative"), n)

    assert abs(paid.mean().item() - 3) < CLT_BOUND * 0.3 / math.sqrt(n)
    assert abs(paid.var().item() - 0.09) < CLT_BOUND * 0.09 * math.sqrt(2 / n)


def test_the_noise_of_a_row_is_its_own_and_follows_from_seed_and_row():
    task = replace(surjective(), reward_std=1.0)

    paid = rewards_at_the_end(task, 8, seed=3)

    assert paid.unique().numel() == 8
    assert torch.equal(
        play(CTGraphEnv([task] * 4, seed=3, first_row=4), optimal)["episode_reward"][:, 0].double(), paid[4:]
    )
    assert not torch.equal(rewards_at_the_end(task, 8, seed=4), paid)


def test_normal_numbers_are_the_quantiles_of_their_words():
    words = torch.arange(0, 2**32, 2**14 + 1)
    tail = ((words >> 1).double() + 0.5) / 2**32
    expected = -torch.special.ndtri(tail) * torch.where((words & 1).bool(), 1.0, -1.0)

    found = normal(words, normal_table())

    assert (found - expected).abs().max() < 2e-6


def test_normal_numbers_pass_a_kolmogorov_smirnov_test():
    n = 2**16
    words = torch.randint(0, 2**32, (n,), generator=torch.Generator().manual_seed(0))

    probs = torch.special.ndtr(normal(words, normal_table())).sort().values

    steps = torch.arange(n + 1, dtype=torch.float64) / n
    distance = torch.maximum((steps[1:] - probs).abs().max(), (probs - steps[:-1]).abs().max())
    assert distance < math.sqrt(math.log(2 / ALPHA) / (2 * n))  # Dvoretzky-Kiefer-Wolfowitz-Massart


def test_the_extreme_words_give_opposite_finite_numbers():
    found = normal(torch.tensor([0, 1, 2**32 - 2, 2**32 - 1]), normal_table())

    assert found[0] == -found[1]
    assert 6.2 < found[1] < 6.4
    assert found[2:].abs().max() < 1e-6


def test_the_cue_shows_the_share_of_the_reward_in_the_middle_of_end_states_only():
    task = replace(surjective(goal=(1, 2), reward_cue=True), reward_fn=Gradient(), goal_reward=5.0, step_reward=0.25)
    plain = replace(task, observations=replace(task.observations, reward_cue=False))
    cued, bare = CTGraphEnv([task] * 4), CTGraphEnv([plain] * 4)
    cued.reset()
    bare.reset()
    paths = torch.tensor(decisions(2, 2)) + 1

    for step in range(6):
        action = paths[:, (step - 2) // 2] if step in (2, 4) else torch.zeros(4, dtype=torch.int64)
        shown, under = act(cued, action)["observation"][:, 0], act(bare, action)["observation"][:, 0]
        if step < 5:
            assert torch.equal(shown, under)

    square = shown[:, 3:9, 3:9]
    assert [row.unique().tolist() for row in square] == [[169], [254], [0], [84]]  # 1 - 1/3, 1, 1 - 3/3, 1 - 2/3
    under[:, 3:9, 3:9] = square
    assert torch.equal(shown, under)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"reward_std": -0.1}, "reward_std must be >= 0, got -0.1"),
        ({"reward_std": math.nan}, "reward_std must be a finite number, got nan"),
        ({"step_reward": math.inf}, "step_reward must be a finite number, got inf"),
        ({"reward_noise": "gaussian"}, "reward_noise must be one of .*additive.*multiplicative.*, got 'gaussian'"),
    ],
)
def test_rewards_out_of_range_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        replace(surjective(), **fields)


def test_a_cue_needs_a_positive_goal_reward():
    with pytest.raises(ValueError, match="reward_cue needs goal_reward > 0, got 0"):
        replace(surjective(reward_cue=True), goal_reward=0)


def test_gradient_rewards_of_rows_with_other_trees_are_their_own():
    shallow = replace(surjective(2, 2, goal=(2, 2)), reward_fn=Gradient())
    deep = replace(surjective(3, 4, goal=(3, 3, 3, 3)), reward_fn=Gradient())
    env = CTGraphEnv([replace(shallow, graph=CTGraph(2, 2)), deep])

    paid = play(CTGraphEnv([shallow, deep], check_actions=False), lambda env: (env.state_type == 2).long())[
        "episode_reward"
    ]

    assert env.max_depth == 4
    assert paid.flatten().tolist() == [0.0, 0.0]


def test_the_noise_is_the_normal_number_of_the_word_where_the_step_begins_added_or_times_the_reward():
    additive = replace(surjective(), reward_std=0.5, goal_reward=3.0)
    env = CTGraphEnv([additive, replace(additive, reward_noise="multiplicative")], seed=3, first_row=5)
    ticks = torch.tensor([6, 6])  # the first observation and five steps: where the last step begins
    z = normal(draw(torch.tensor(3), torch.tensor([5, 6]), ticks, STREAM_REWARD)[0], normal_table())

    paid = play(env, optimal)["reward"].squeeze(-1).double()

    expected = torch.stack([3 + 0.5 * z[0], 3 * (1 + 0.5 * z[1])])
    torch.testing.assert_close(paid, expected, atol=1e-6, rtol=0)
    assert z.abs().min() > 0.01


def test_rewards_whose_noise_would_be_infinite_are_refused():
    with pytest.raises(ValueError, match=r"goal_reward times reward_std must be at most 1e\+30 in size"):
        replace(surjective(), goal_reward=1e20, reward_std=1e20, reward_noise="multiplicative")
    with pytest.raises(ValueError, match="reward_cue needs goal_reward > 0, got 1e-50"):
        replace(surjective(reward_cue=True), goal_reward=1e-50)
