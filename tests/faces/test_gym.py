"""Gymnasium's face: the ids, the single environment, pictures, and Gymnasium's own wrappers."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.wrappers import FlattenObservation, RecordEpisodeStatistics, RecordVideo, TimeLimit
from helpers.gym_steps import IDS, assert_equal, play
from helpers.oracles import confounding, one_hot, surjective

from ctgraph_rl import ReferenceOneHot
from ctgraph_rl.gym import CONFIGURATIONS, CTGraphGymEnv, CTGraphVectorEnv, make_task
from ctgraph_rl.tasks.configurations import ct_su_b1


def test_a_running_episode_ends_with_its_own_task():
    first, second = surjective(goal=(1, 1)), surjective(goal=(2, 2))
    env = CTGraphGymEnv(first, task_pool=[first, second])
    env.reset(seed=0)
    env.set_task(second)

    *_, (_, reward, terminated, truncated, info) = [env.step(action) for action in (0, 0, 1, 0, 1, 0)]

    assert (reward, terminated, truncated, info) == (1.0, True, False, {"task": 0, "outcome": 3, "leaf": 0})
    assert env.reset()[1] == {"task": 1, "outcome": 0, "leaf": -1}
    assert [env.step(action)[1] for action in (0, 0, 2, 0, 2, 0)][-1] == 1.0


def test_info_tells_outcome_and_leaf():
    env = CTGraphGymEnv(surjective(goal=(1, 2)))
    endings = {}

    for name, actions in {"fail": (0, 1), "other": (0, 0, 2, 0, 1, 0), "goal": (0, 0, 1, 0, 2, 0)}.items():
        env.reset()
        endings[name] = [env.step(action) for action in actions][-1]

    assert {name: tuple(end[4].values()) for name, end in endings.items()} == {
        "fail": (0, 1, -1),
        "other": (0, 2, 2),
        "goal": (0, 3, 1),
    }
    assert {name: end[1:4] for name, end in endings.items()} == {
        "fail": (0.0, True, False),
        "other": (0.0, True, False),
        "goal": (1.0, True, False),
    }


def test_an_extra_end_step_belongs_to_the_episode():
    env = CTGraphGymEnv("CT-SU-B1", extra_end_step=True)
    env.reset(seed=0)

    results = [env.step(action) for action in (0, 0, 1, 0, 1, 0, 2)]

    assert [result[1] for result in results] == [0, 0, 0, 0, 0, 1, 0]
    assert [result[2] for result in results] == [False] * 6 + [True]
    assert results[-1][4]["outcome"] == 3


@pytest.mark.parametrize("name", IDS)
def test_check_env_has_nothing_to_say(name):
    env = gymnasium.make(name, disable_env_checker=True)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


@pytest.mark.parametrize("name", IDS)
def test_every_id_makes_a_single_and_a_vector_environment_without_a_warning(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env, envs = gymnasium.make(name), gymnasium.make_vec(name, num_envs=3)
        env.reset(seed=1)
        observations, infos = envs.reset(seed=1)

    assert isinstance(env.unwrapped, CTGraphGymEnv) and isinstance(envs, CTGraphVectorEnv)
    assert env.observation_space.shape == (1, 12, 12) and env.observation_space.dtype == np.uint8
    assert (env.action_space.n, envs.action_space.nvec.tolist()) == (3, [3, 3, 3])
    assert observations in envs.observation_space
    assert infos["outcome"].tolist() == [0, 0, 0]
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_an_id_names_the_configuration_of_the_paper(name):
    env = gymnasium.make(f"ctgraph/{name}-v{1 if name == 'CT-POSR-B1' else 0}").unwrapped

    assert env.task_pool == (CONFIGURATIONS[name](),)


def test_an_id_of_an_earlier_version_is_refused():
    with pytest.raises(gymnasium.error.DeprecatedEnv, match=r"v0 .*deprecated.*v1"):
        gymnasium.make("ctgraph/CT-POSR-B1-v0")


@pytest.mark.slow
def test_an_id_after_its_module_needs_no_import_and_no_torchrl(checkout, tmp_path):
    code = (
        "import gymnasium, sys; print(gymnasium.make('ctgraph_rl.gym:ctgraph/CT-SU-B1-v0').action_space); "
        "print([name for name in ('torchrl', 'tensordict', 'hydra', 'stable_baselines3') if name in sys.modules])"
    )
    env = {**os.environ, "PYTHONPATH": str(checkout)}

    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True)

    assert (result.stderr, result.stdout) == ("", "Discrete(3)\n[]\n")


def test_one_hot_spaces_end_at_the_brightest_level():
    reference = one_hot(images=ReferenceOneHot(5))

    spaces = [CTGraphGymEnv(task).observation_space for task in (one_hot(), reference)]

    assert [(space.shape, int(space.high.max())) for space in spaces] == [
        (task.images.shape, int(task.images.bank(0).max())) for task in (one_hot(), reference)
    ]


def test_a_branching_factor_of_the_pool_decides_the_number_of_actions():
    pool = [surjective(), surjective(b=4)]

    env = CTGraphGymEnv(pool[0], task_pool=pool)

    assert env.action_space.n == 5
    env.reset(seed=0)
    assert [env.step(action)[4]["outcome"] for action in (0, 0, 3)] == [0, 0, 1]


def test_rgb_array_is_a_picture_of_the_present_state():
    env = gymnasium.make("ctgraph/CT-SU-B1-v0", render_mode="rgb_array")
    envs = gymnasium.make_vec("ctgraph/CT-SU-B1-v0", num_envs=2, render_mode="rgb_array")
    env.reset(seed=0), envs.reset(seed=0)
    home = env.render()
    env.step(0), envs.step(np.array([0, 0]))

    picture, pictures = env.render(), envs.render()

    assert (picture.shape, picture.dtype) == ((192, 384, 3), np.uint8)
    assert not np.array_equal(home, picture)
    assert len(pictures) == 2 and all(np.array_equal(picture, other) for other in pictures)


def test_ansi_says_where_the_row_is_and_shows_its_image():
    env = CTGraphGymEnv(one_hot(goal=(1, 2)), render_mode="ansi")
    env.reset(seed=0)
    texts = [env.render()]

    for action in (0, 0, 2, 1):
        env.step(action)
        texts.append(env.render())

    assert texts == [
        "home state, step 0, goal 1.2\n██        ",
        "wait state, step 1, goal 1.2\n    ██    ",
        "decision state, step 2, goal 1.2\n      ██  ",
        "wait state after 2, step 3, goal 1.2\n    ██    ",
        "fail state after 2, step 4, goal 1.2\n  ██      ",
    ]


def test_ansi_shows_an_image_in_twelve_lines_of_five_greys():
    env = CTGraphGymEnv("CT-FO-B1", render_mode="ansi")
    observation, _ = env.reset(seed=0)

    _, *lines = env.render().splitlines()

    assert [len(line) for line in lines] == [24] * 12
    assert {line[2 * i] for i in range(12) for line in lines} <= set(" ░▒▓█")
    assert [[line[2 * i] == "█" for i in range(12)] for line in lines] == (observation[0] >= 254).tolist()


@pytest.mark.parametrize("kind", [CTGraphGymEnv, CTGraphVectorEnv])
def test_render_without_a_mode_warns(kind):
    env = kind()
    env.reset(seed=0)

    with pytest.warns(UserWarning, match="needs a render_mode"):
        assert env.render() is None


def test_episode_statistics_and_time_limits_of_the_single_environment():
    env = RecordEpisodeStatistics(TimeLimit(gymnasium.make("ctgraph/CT-SU-B1-v0"), 4))
    env.reset(seed=0)

    *_, last = [env.step(action) for action in (0, 0, 1, 0)]

    assert last[2:4] == (False, True)
    assert (last[4]["episode"]["r"], last[4]["episode"]["l"]) == (0.0, 4)
    env.reset()
    assert env.step(0)[2:4] == (False, False)


def test_make_takes_a_time_limit():
    env = gymnasium.make("ctgraph/CT-SU-B1-v0", max_episode_steps=2)
    env.reset(seed=0)

    assert [env.step(0)[3] for _ in range(2)] == [False, True]


def test_record_video_writes_an_episode(tmp_path):
    env = gymnasium.make("ctgraph/CT-SU-B1-v0", render_mode="rgb_array")
    env = RecordVideo(env, str(tmp_path / "video"), episode_trigger=lambda episode: episode == 0)
    env.reset(seed=0)

    for action in (0, 0, 1, 0, 1, 0):
        env.step(action)
    env.close()

    (video,) = (tmp_path / "video").glob("*.mp4")
    assert video.stat().st_size > 1000


def test_observations_can_be_flattened():
    env = FlattenObservation(gymnasium.make("ctgraph/CT-SU-B1-v0"))

    assert env.reset(seed=0)[0].shape == (144,)


@pytest.mark.slow
def test_async_vector_env_runs_the_single_environment():
    envs = AsyncVectorEnv([lambda: CTGraphGymEnv("CT-FO-B2")] * 2)
    twin = CTGraphVectorEnv(2, "CT-FO-B2")

    results = [play(each, 3, 20) for each in (envs, twin)]
    envs.close()

    assert_equal(results[1], results[0])


def test_a_copy_of_an_environment_goes_on_as_the_original():
    env = CTGraphGymEnv(confounding(p=0.5))
    env.reset(seed=0)
    env.step(0)

    twin = copy.deepcopy(env)

    assert_equal([env.step(0) for _ in range(1)], [twin.step(0) for _ in range(1)])
    assert_equal(env.reset(), twin.reset())


def test_seeds_may_be_integers_of_numpy():
    envs, single = CTGraphVectorEnv(2, "CT-CO-B1"), CTGraphGymEnv("CT-CO-B1")

    assert_equal(envs.reset(seed=np.int64(3)), envs.reset(seed=np.array([3, 4])))
    assert_equal(single.reset(seed=np.int64(3)), single.reset(seed=3))


def test_the_rows_of_an_environment_can_be_loaded_after_a_reset():
    env = CTGraphGymEnv("CT-POSR-B1")
    env.reset(seed=1)
    saved = {name: value.clone() for name, value in env.rows.state_dict().items()}
    first = [env.step(0)[0] for _ in range(2)]

    env.rows.load_state_dict(saved)

    assert_equal([env.step(0)[0] for _ in range(2)], first)


@pytest.mark.slow
def test_environments_in_processes_of_their_own_run_with_any_number_of_threads():
    code = """
import gymnasium, numpy, ctgraph_rl.gym
envs = gymnasium.make_vec("ctgraph/CT-CO-B1-v0", num_envs=2, vectorization_mode="async", read_noise=5)
envs.reset(seed=0)
print(envs.step(numpy.array([0, 1]))[0].shape)
envs.close()
"""
    threads = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}

    found = subprocess.run([sys.executable, "-c", code], env=threads, capture_output=True, text=True, timeout=600)

    assert found.stdout.strip() == "(2, 1, 12, 12)", found.stderr


def test_a_wrong_keyword_is_answered_with_the_nearest_one():
    with pytest.raises(ValueError, match="wait_probability; did you mean 'wait_prob'"):
        make_task("CT-SU-B1", wait_probability=0.5)
    with pytest.raises(ValueError, match=r"autoreset_mode must be one of \['NextStep', 'SameStep', 'Disabled'\]"):
        CTGraphVectorEnv(2, autoreset_mode="same_step")


def test_a_path_that_counts_from_zero_is_answered_with_the_goal():
    with pytest.raises(ValueError, match=r"counts from 0: use 1\.2"):
        ct_su_b1(goal=(0, 1))
