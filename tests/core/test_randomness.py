import dataclasses
import math

import pytest
import torch
from helpers.oracles import (
    ALPHA,
    WAIT,
    act,
    binomial_p_value,
    confounding,
    fully_observable,
    is_uniform,
    one_hot,
    record,
    scripts,
    surjective,
)

from ctgraph_rl import CTGraphEnv
from ctgraph_rl.core.philox import STREAM_STEP, draw

RANDOM = confounding(2, 2, 0.5, goal=(1, 2), read_noise=50, read_rotation=40)
"""A task with everything that is random: waits, ids, noise and rotation."""

MIXED = [
    surjective(2, 1, goal=(2,)),
    RANDOM,
    surjective(2, 3, p=0.5, goal=(1, 2, 1)),
    fully_observable(3, 2, goal=(3, 1)),
    confounding(4, 1, p=0.9, goal=(4,), read_noise=9),
    surjective(3, 2, goal=(2, 2), image_seed=2, read_rotation=20),
    dataclasses.replace(RANDOM, fail_reward=-0.5),
    RANDOM,
]


def rows_of(env, num_steps=30, rows=slice(None)):
    """Data of an environment under the script of these rows of a batch of eight."""
    return record(env, scripts(num_steps, 8)[:, rows])


def test_a_batch_of_eight_equals_two_batches_of_four():
    whole = rows_of(CTGraphEnv([RANDOM] * 8, seed=5))

    first = rows_of(CTGraphEnv([RANDOM] * 4, seed=5), rows=slice(4))
    second = rows_of(CTGraphEnv([RANDOM] * 4, seed=5, first_row=4), rows=slice(4, 8))

    assert (torch.cat([first, second]) == whole).all()
    assert whole["next", "done"].any() and whole["observation"].unique().numel() > 200


def test_a_row_of_a_mixed_batch_equals_the_same_task_alone():
    mixed = rows_of(CTGraphEnv(MIXED, seed=5))

    for row, task in enumerate(MIXED):
        alone = rows_of(CTGraphEnv([task], seed=5, first_row=row), rows=slice(row, row + 1))
        assert (mixed[row : row + 1] == alone).all(), row


def test_a_one_hot_row_of_a_mixed_batch_equals_the_same_task_alone():
    tasks = [one_hot(2, 2, 0.5), one_hot(3, 1, 0.9, goal=(3,))]

    mixed = record(CTGraphEnv(tasks, seed=5), scripts(60, 2))
    alone = record(CTGraphEnv(tasks[1:], seed=5, first_row=1), scripts(60, 2)[:, 1:])

    assert (mixed[1:] == alone).all()


def test_a_rows_data_do_not_depend_on_the_actions_of_other_rows():
    tasks = [RANDOM] * 4
    actions = scripts(60, 4)
    others = actions.clone()
    others[:, 1:] = scripts(60, 3, seed=1)

    one, other = record(CTGraphEnv(tasks), actions), record(CTGraphEnv(tasks), others)

    assert (one[0] == other[0]).all()
    assert not (one[1:] == other[1:]).all()


def test_the_same_seed_gives_the_same_data():
    one, other = (rows_of(CTGraphEnv([RANDOM] * 8, seed=7)) for _ in range(2))

    assert (one == other).all()


def test_different_seeds_give_different_data_in_every_row():
    observations = [rows_of(CTGraphEnv([RANDOM] * 8, seed))["observation"] for seed in (0, 1, 2, 2**32, 2**32 + 1)]

    assert len(torch.cat(observations).flatten(1).unique(dim=0)) == 5 * 8


def test_a_row_of_one_seed_is_not_the_neighbouring_row_of_the_next_seed():
    one, other = (rows_of(CTGraphEnv([RANDOM] * 8, seed), rows=[0] * 8)["observation"] for seed in (3, 4))

    same = [torch.equal(one[row], other[column]) for row in range(8) for column in range(8)]

    assert not any(same)


def test_no_two_rows_share_their_sequence():
    env = CTGraphEnv([confounding(p=0.5)] * 1024, seed=1, check_actions=False)

    ids = []
    for _ in range(12):
        env.reset()
        act(env, [0] * 1024)
        ids.append(env.observation_id.clone())

    assert len(torch.stack(ids, -1).unique(dim=0)) == 1024


def test_no_two_rows_share_a_draw_at_any_step():
    rows, ticks = torch.arange(1024).view(-1, 1), torch.arange(64)

    words = torch.stack(draw(torch.tensor(1), rows, ticks, STREAM_STEP), -1).view(-1, 4)

    assert len(words.unique(dim=0)) == 1024 * 64


def test_no_two_rows_see_the_same_noise():
    env = CTGraphEnv([surjective(read_noise=50)] * 256, seed=1)

    observation = env.reset()["observation"]

    assert len(observation.flatten(1).unique(dim=0)) == 256


def test_noise_is_new_at_every_observation():
    env = CTGraphEnv([surjective(p=0.99, read_noise=50)] * 4, seed=1)

    observations = [env.reset()["observation"] for _ in range(10)]

    assert len(torch.cat(observations).flatten(1).unique(dim=0)) == 40


@pytest.mark.parametrize("p", [0.5, 0.9])
def test_a_wait_state_is_kept_with_probability_p(p):
    rows = 12_500
    env = CTGraphEnv([one_hot(p=p)] * rows, seed=1)
    env.reset()
    act(env, [0] * rows)

    act(env, [0] * rows)

    stayed = (env.state_type == WAIT).sum().item()
    assert binomial_p_value(stayed, rows, p) >= ALPHA


@pytest.mark.parametrize("p", [0.5, 0.9])
def test_staying_once_says_nothing_about_staying_again(p):
    rows = 12_500
    env = CTGraphEnv([one_hot(p=p)] * rows, seed=1, check_actions=False)
    env.reset()
    act(env, [0] * rows)

    act(env, [0] * rows)
    once = env.state_type == WAIT
    act(env, [0] * rows)
    twice = once & (env.state_type == WAIT)

    assert binomial_p_value(twice.sum().item(), once.sum().item(), p) >= ALPHA


def test_every_row_of_a_batch_waits_with_its_own_p():
    env = CTGraphEnv([one_hot(p=0.0), one_hot(p=0.5)] * 5_000, seed=1)
    env.reset()
    act(env, [0] * 10_000)

    act(env, [0] * 10_000)

    stayed = env.state_type == WAIT
    assert not stayed[::2].any()
    assert binomial_p_value(stayed[1::2].sum().item(), 5_000, 0.5) >= ALPHA


def test_the_wait_the_id_and_the_angle_of_one_step_are_independent():
    task = confounding(p=0.5, read_rotation=1)
    env = CTGraphEnv([task] * 10_000, seed=1)
    env.reset()
    act(env, [0] * 10_000)

    observation = act(env, [0] * 10_000)["observation"][:, 0]

    stayed, ids = env.state_type == WAIT, env.observation_id
    turned = (observation != task.images.images[ids]).flatten(1).any(1)
    assert is_uniform(torch.bincount((2 * (ids - 2) + turned)[stayed], minlength=16).tolist())


def test_torchs_generator_is_left_alone():
    torch.manual_seed(0)
    before = torch.get_rng_state()

    env = CTGraphEnv([RANDOM] * 8, seed=5)
    rows_of(env)
    env.set_seed(6)
    env.set_tasks([RANDOM] * 8)
    env.reset()

    assert torch.equal(torch.get_rng_state(), before)


def test_torchs_generator_has_no_influence():
    torch.manual_seed(0)
    one = rows_of(CTGraphEnv([RANDOM] * 8, seed=5))

    torch.manual_seed(1)
    other = rows_of(CTGraphEnv([RANDOM] * 8, seed=5))

    assert (one == other).all()


def test_set_seed_replays():
    env = CTGraphEnv([RANDOM] * 8, seed=5)
    expected = rows_of(env)

    env.set_seed(6)
    other = rows_of(env)
    env.set_seed(5)

    assert not (other == expected).all()
    assert (rows_of(env) == expected).all()


def test_without_a_seed_change_the_next_episodes_are_new():
    env = CTGraphEnv([RANDOM] * 8, seed=5)

    first, second = rows_of(env), rows_of(env)

    assert not torch.equal(first["observation"], second["observation"])


@pytest.mark.parametrize("seed", [-1, 2**63, 0.5, None])
def test_a_seed_out_of_range_is_refused(seed):
    env = CTGraphEnv([RANDOM])

    with pytest.raises(ValueError, match=rf"seed must be an integer in \[0, 2\*\*63\), got {seed!r}"):
        env.set_seed(seed)


def words_of(seed: int, rows: int, ticks: int, stream: int = STREAM_STEP) -> torch.Tensor:
    """The first word of each row at each tick, centred and scaled: float64 [rows, ticks]."""
    row, tick = torch.arange(rows).unsqueeze(-1), torch.arange(ticks)
    word = draw(torch.tensor(seed), row, tick, stream)[0].double()
    return (word / 2**32 - 0.5) * math.sqrt(12)


def test_rows_streams_seeds_and_ticks_are_uncorrelated():
    """Correlations of 4096 draws are normal with deviation 1/64; the largest of 6112 stays below 6.2 deviations."""
    n, rows = 4096, 96
    first = words_of(0, rows, n)

    among = (first @ first.T / n).tril(-1)
    seeds = (first * words_of(1, rows, n)).mean(1)
    streams = (first * words_of(0, rows, n, stream=1)).mean(1)
    shifted = torch.cat([(first[:-1, :-lag] * first[1:, lag:]).mean(1) for lag in range(1, 16)])

    largest = max(value.abs().max().item() for value in (among, seeds, streams, shifted))
    assert largest < 6.2 / math.sqrt(n)


def test_no_two_draws_of_many_rows_and_ticks_are_equal():
    words = draw(torch.tensor(3), torch.arange(512).unsqueeze(-1), torch.arange(512), STREAM_STEP)

    pairs = (words[0] << 31 | words[1] >> 1).flatten()

    assert pairs.unique().numel() == 512 * 512
