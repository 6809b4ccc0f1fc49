"""A stream through Gymnasium's vector interface, for the loops of others."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

import ctgraph_rl.gym
import curricula

ID = "ctgraph/Stream-v0"


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_rows_change_to_the_next_task_when_their_episodes_end_after_a_block(mode):
    envs = gymnasium.make_vec(ID, num_envs=4, num_tasks=3, num_frames=64, seed=5, autoreset_mode=mode).unwrapped
    stream = curricula.load("stream", num_tasks=3, num_frames=64, seed=5)
    first, infos = envs.reset(seed=0)
    observations = first
    assert infos["optimum"].tolist() == [1.0] * 4

    for step in range(1, 80):
        shown = infos["task"]
        for row in range(4):
            own = stream.tasks[shown[row]].images.images.numpy()
            assert (observations[row] == own).all((1, 2)).any()
            assert shown[row] <= 4 * step // 64
        observations, _, _, _, infos = envs.step(np.random.default_rng(step).integers(0, 3, 4))

    assert infos["task"].tolist() == [2] * 4  # the last task stays
    again, infos = envs.reset()
    assert infos["task"].tolist() == [2] * 4
    again, infos = envs.reset(seed=0)
    assert (infos["task"].tolist(), again.tolist()) == ([0] * 4, first.tolist())
    assert stream.tasks[0] == envs.stream.tasks[0]


def test_a_stream_shows_task_ids():
    stream = curricula.load("stream", num_tasks=2, num_frames=8, depth=1, seed=5)
    envs = ctgraph_rl.gym.StreamVectorEnv(4, stream, task_ids=stream.task_ids)
    envs.reset(seed=0)

    seen = [envs.step(np.zeros(4, np.int64))[0]["task_id"].tolist() for _ in range(8)]

    assert seen[0] == [[1, 0]] * 4
    assert seen[-1] == [[0, 1]] * 4


def test_the_end_of_a_stream_is_told():
    envs = gymnasium.make_vec(ID, num_envs=4, num_tasks=2, num_frames=64, seed=5)
    envs.reset(seed=0)
    for _ in range(31):
        envs.step(np.zeros(4, np.int64))

    with pytest.warns(UserWarning, match="the stream of 128 frames is over, its last task stays"):
        envs.step(np.zeros(4, np.int64))


def test_regret_is_told_where_an_episode_ends():
    envs = gymnasium.make_vec(ID, num_envs=16, num_tasks=3, num_frames=640, goal_reward=2.0, depth=1)
    envs.reset(seed=0)
    returns = np.zeros(16)
    found = set()

    for step in range(200):
        _, rewards, terminated, _, infos = envs.step(np.random.default_rng(step).integers(0, 3, 16))
        returns += rewards
        assert (infos["_regret"] == terminated).all()
        assert (infos["regret"] == np.where(terminated, 2.0 - returns, 0.0)).all()
        found |= set(infos["regret"][terminated].tolist())
        returns[terminated] = 0.0

    assert found == {0.0, 2.0}


@pytest.mark.slow
def test_a_cleanrl_like_loop_learns_the_stream():
    """One linear layer and REINFORCE, a batch of steps at a time."""
    torch.manual_seed(0)
    envs = gymnasium.make_vec(ID, num_envs=64, num_tasks=2, num_frames=64 * 400, depth=1, order="drifting")
    policy = torch.nn.Linear(144, 3)
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.02)
    observations, _ = envs.reset(seed=1)
    solved = []
    for _ in range(40):
        terms, rewards, ends = [], [], []
        for _ in range(20):
            logits = policy(torch.from_numpy(observations).flatten(1).float() / 255)
            chosen = torch.distributions.Categorical(logits=logits)
            actions = chosen.sample()
            observations, reward, terminated, truncated, _ = envs.step(actions.numpy())
            terms.append(chosen.log_prob(actions))
            rewards.append(torch.from_numpy(reward).float())
            ends.append(torch.from_numpy(terminated | truncated))
        solved.append(sum(r.sum() for r in rewards).item() / max(sum(e.sum() for e in ends).item(), 1))
        returns = torch.zeros(64)
        loss = torch.zeros(())
        for term, reward, end in zip(reversed(terms), reversed(rewards), reversed(ends), strict=True):
            returns = reward + 0.95 * returns * ~end
            loss = loss - (term * (returns - 0.1)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    assert solved[0] < 0.2
    assert max(solved) > 0.6


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 3, "num_frames": 64}, "num_frames=64 of a block must be a multiple of num_envs=3; nearest: 63"),
        ({"orders": "similar"}, "stream has no orders"),
        ({"seed": -1}, r"seed must be an integer in \[0, 2\*\*63\), got -1"),
        ({"stream": 5}, "stream must be a Stream, got 5"),
        (
            {"stream": curricula.load("stream", num_tasks=2), "num_tasks": 3, "depth": 1},
            "^a stream that is given has its settings, got num_tasks=3, depth=1 beside it: leave them out",
        ),
    ],
)
def test_a_value_out_of_range_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make_vec(ID, **settings)
