"""Stable-Baselines3 and sb3-contrib, unchanged: through Gymnasium's ids, and through the fast adapter."""

from __future__ import annotations

import importlib
import sys
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from helpers.gym_steps import IDS, assert_equal
from helpers.oracles import confounding, fully_observable, surjective
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

import curricula
from benchmarks import stable
from ctgraph_rl.gym import CTGraphGymEnv, make_task
from ctgraph_rl.sb3 import SB3VecEnv
from ctgraph_rl.tasks import configurations as paper

GOAL = (1, 2)


def adapter(name, num_envs):
    return VecMonitor(SB3VecEnv(num_envs, name, goal=GOAL))


def ids(name, num_envs):
    return make_vec_env(f"ctgraph/{name}-v0", n_envs=num_envs, env_kwargs={"goal": GOAL})


def test_a_life_is_truncated_at_its_end_and_no_episode_ends_before():
    envs = SB3VecEnv(2, "CT-SU-B1", life=9)
    envs.reset()

    steps = [envs.step(np.full(2, 1)) for _ in range(10)]

    assert [done.tolist() for _, _, done, _ in steps] == [[False] * 2] * 8 + [[True] * 2, [False] * 2]
    assert [infos[0]["TimeLimit.truncated"] for _, _, _, infos in steps] == [False] * 8 + [True, False]
    assert "terminal_observation" in steps[8][3][1]


def mean_return(model, name):
    mean, _ = evaluate_policy(model, make_vec_env(f"ctgraph/{name}-v0", seed=1000, env_kwargs={"goal": GOAL}), 50)
    return mean


def play(envs, num_steps, seed):
    rng, results = np.random.default_rng(seed), []
    envs.seed(seed)
    results.append((envs.reset(), envs.reset_infos))
    for _ in range(num_steps):
        actions = rng.integers(3, size=envs.num_envs) * rng.integers(2, size=envs.num_envs)
        results.append((*envs.step(actions), [dict(info) for info in envs.reset_infos]))
    return results


@pytest.mark.parametrize(
    "task",
    [
        surjective(),
        fully_observable(p=0.5),
        confounding(p=0.3, read_noise=9),
        replace(surjective(), extra_end_step=True, fail_reward=-0.5, goal_change=(1, 2)),
    ],
    ids=["deterministic", "waits", "noise", "switches"],
)
def test_the_adapter_equals_dummy_vec_env_step_for_step(task):
    ours, theirs = SB3VecEnv(4, task), DummyVecEnv([lambda: CTGraphGymEnv(task)] * 4)

    assert_equal(play(ours, 200, seed=3), play(theirs, 200, seed=3))
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)


def test_seeds_are_used_once():
    envs, task = SB3VecEnv(3, confounding()), confounding()

    envs.seed(5)
    first, second = (envs.reset() is not None and envs.step(np.zeros(3, int))[0] for _ in range(2))

    theirs = DummyVecEnv([lambda: CTGraphGymEnv(task)] * 3)
    theirs.seed(5)
    expected = [theirs.reset() is not None and theirs.step(np.zeros(3, int))[0] for _ in range(2)]
    assert np.array_equal([first, second], expected)
    assert not np.array_equal(first, second)


def test_a_monitor_records_episodes_of_the_adapter():
    envs = VecMonitor(SB3VecEnv(2, "CT-SU-B1"))
    envs.reset()

    infos = [envs.step(np.array([action, min(step, 1)]))[3] for step, action in enumerate((0, 0, 1, 0, 1, 0))]

    assert [infos[-1][0]["episode"][key] for key in ("r", "l")] == [1.0, 6]
    assert [infos[1][1]["episode"][key] for key in ("r", "l")] == [0.0, 2]


def test_attributes_and_methods_are_those_of_the_batch():
    pool = [paper.ct_su_b1(), paper.ct_su_b1((2, 2))]
    envs = VecMonitor(SB3VecEnv(2, task_pool=pool, task=pool[0], render_mode="rgb_array"))
    envs.env_method("set_tasks", pool)
    envs.reset()

    assert [info["task"] for info in envs.unwrapped.reset_infos] == [0, 1]
    assert envs.get_attr("num_envs") == [2, 2]
    assert envs.get_attr("num_envs", indices=[1]) == [2]
    assert envs.has_attr("task_pool") and not envs.has_attr("task_poll")
    assert envs.env_is_wrapped(gymnasium.Wrapper) == [False, False]
    assert envs.render().shape == (2 * 192, 384, 3)
    assert envs.unwrapped.metadata == envs.unwrapped.envs.metadata
    assert len(envs.env_method("render")) == 2
    with pytest.raises(ValueError, match=r"the rows are one batch: indices must be None, got \[0\]"):
        envs.env_method("set_tasks", pool, indices=[0])


def test_without_stable_baselines3_the_error_says_what_to_install(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "stable_baselines3"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "ctgraph_rl.sb3")

    with pytest.raises(ImportError, match=r"^ctgraph_rl\.sb3 needs Stable-Baselines3: pip install stable-baselines3$"):
        importlib.import_module("ctgraph_rl.sb3")


@pytest.mark.parametrize("name", IDS)
def test_their_check_env_finds_images_small_and_nothing_else(name):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(name))

    assert all("minimal resolution for an image is 36x36" in str(warning.message) for warning in caught)


def test_their_check_env_has_nothing_to_say_about_one_hot_observations():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(CTGraphGymEnv(one_hot=True))


@pytest.mark.slow
def test_dqn_learns_ct_fo_b1():
    schedule = {"learning_starts": 500, "exploration_fraction": 0.7, "target_update_interval": 200}
    model = DQN(
        "MlpPolicy", adapter("CT-FO-B1", 4), learning_rate=1e-3, gamma=0.9, buffer_size=20_000, seed=0, **schedule
    )

    model.learn(10_000)

    assert mean_return(model, "CT-FO-B1") >= 0.9


@pytest.mark.slow
def test_recurrent_ppo_learns_ct_su_b1():
    """Training ends when the graph is solved: with more frames one seed in twelve forgets it again."""
    sizes = {"n_steps": 32, "batch_size": 128, "policy_kwargs": {"lstm_hidden_size": 32, "net_arch": [32]}}
    steps = {"learning_rate": 1e-3, "n_epochs": 4, "ent_coef": 0.02, "gamma": 0.95}
    model = RecurrentPPO("MlpLstmPolicy", adapter("CT-SU-B1", 16), seed=0, **steps, **sizes)
    solved = StopTrainingOnRewardThreshold(0.9)

    model.learn(25_600, EvalCallback(adapter("CT-SU-B1", 1), solved, eval_freq=128, n_eval_episodes=20))

    assert mean_return(model, "CT-SU-B1") >= 0.9


@pytest.mark.slow
def test_ppo_without_memory_does_not_learn_ct_su_b1():
    model = PPO("MlpPolicy", adapter("CT-SU-B1", 16), n_steps=64, batch_size=256, learning_rate=1e-3, seed=0)

    model.learn(20_480)

    assert make_task("CT-SU-B1", goal=GOAL).memoryless_ceiling(deterministic=True) == 0
    assert mean_return(model, "CT-SU-B1") == 0


def test_the_benchmark_counts_the_first_episode_of_each_row_and_no_later_one(monkeypatch):
    first, later = np.arange(100) < 50, np.arange(100) >= 50
    ends = [(first, 3), (first | later, 2)]

    class Envs:
        def reset(self):
            return np.zeros(100)

        def step(self, action):
            done, outcome = ends.pop(0)
            return np.zeros(100), np.zeros(100), done, [{"outcome": outcome} if one else {} for one in done]

    class Model:
        def predict(self, observation, state, episode_start, deterministic):
            return np.zeros(100), None

    agent = object.__new__(stable.Stable)
    agent.task, agent.model = None, Model()
    monkeypatch.setattr(stable, "batch", lambda task, num_rows: Envs())

    assert agent.success() == 0.5


def test_task_ids_are_shown_as_one_hot_also_at_the_end_of_an_episode_and_after_a_change():
    curriculum = curricula.load("ct8")
    first, second = curriculum.tasks[:2]
    ids = {first: 2, second: 0}
    envs = SB3VecEnv(2, first, task_pool=(first, second), task_ids=ids, num_task_ids=4)

    begun = envs.reset()
    envs.env_method("set_tasks", [second, second])
    done = np.zeros(2, dtype=np.bool_)
    while not done.all():  # both rows play the same episode
        shown, _, done, infos = envs.step(np.array([1, 1]))

    assert begun["task_id"].tolist() == [[0, 0, 1, 0]] * 2
    assert envs.observation_space.contains({key: value[0] for key, value in begun.items()})
    assert envs.get_attr("observation_space")[0] == envs.observation_space
    assert shown["task_id"].tolist() == [[1, 0, 0, 0]] * 2
    assert [info["terminal_observation"]["task_id"].tolist() for info in infos] == [[0, 0, 1, 0]] * 2


def test_task_ids_that_leave_a_task_of_the_pool_out_are_refused():
    first, second = curricula.load("ct8").tasks[:2]

    with pytest.raises(ValueError, match="task_ids must name every task of the pool"):
        SB3VecEnv(2, first, task_pool=(first, second), task_ids={first: 0})


def test_regret_and_tasks_of_a_stream_reach_callbacks():
    envs = SB3VecEnv(8, stream=curricula.load("stream", num_tasks=3, num_frames=80, depth=1, seed=4))
    envs.reset()
    seen = []

    for step in range(40):
        _, rewards, done, infos = envs.step(np.random.default_rng(step).integers(0, 3, 8))
        for reward, over, info in zip(rewards, done, infos, strict=True):
            assert ("regret" in info) == over
            if over:
                assert info["regret"] == 1.0 - reward
        seen.append(max(info["task"] for info in infos))

    assert seen[:10] == [0] * 10
    assert seen[-1] == 2


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"num_tasks": 3}, "^a stream that is given has its settings, got num_tasks=3 beside it: leave them out"),
        ({"task": "CT-SU-B1"}, "^a stream has its tasks, got task='CT-SU-B1' beside it: leave one of both out"),
    ],
)
def test_a_stream_beside_a_task_or_settings_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        SB3VecEnv(8, stream=curricula.load("stream", num_tasks=2, num_frames=80), **given)


@pytest.mark.slow
def test_ppo_learns_a_stream():
    stream = curricula.load("stream", num_tasks=2, num_frames=64 * 512, depth=1, order="similar", seed=4)
    envs = VecMonitor(SB3VecEnv(64, stream=stream))
    agent = PPO("MlpPolicy", envs, n_steps=32, batch_size=512, learning_rate=3e-3, seed=0, device="cpu")

    agent.learn(stream.blocks.num_frames)

    assert np.mean([episode["r"] for episode in agent.ep_info_buffer]) > 0.9
