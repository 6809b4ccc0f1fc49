"""Gymnasium's face: the ids, the single environment, the vector environment and Gymnasium's own wrappers."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation, RecordEpisodeStatistics, RecordVideo, TimeLimit
from gymnasium.wrappers.vector import RecordEpisodeStatistics as VectorStatistics
from oracles import confounding, fully_observable, one_hot, record, scripts, surjective

from ctgraph_rl import CTGraphEnv, Gradient, ReferenceOneHot, Task, paper
from ctgraph_rl.gym import CONFIGURATIONS, CTGraphGymEnv, CTGraphVectorEnv, make_task
from ctgraph_rl.paper import ct_su_b1

MODES = tuple(AutoresetMode)
IDS = ["ctgraph/CTGraph-v0", *(f"ctgraph/{name}-v0" for name in CONFIGURATIONS)]

VARIED = {
    "deterministic": surjective(),
    "waits and unique ids": fully_observable(p=0.5, goal=(2, 1)),
    "drawn ids": confounding(p=0.3),
    "noise and rotation": surjective(p=0.2, read_noise=20, read_rotation=5),
    "noise before rotation": surjective(read_noise=9, read_rotation=3, noise_before_rotation=True),
    "reward noise": replace(surjective(p=0.5), reward_std=0.1, fail_reward=-0.5, step_reward=-0.01),
    "reward cue": replace(surjective(reward_cue=True), reward_fn=Gradient()),
    "changing goals": replace(surjective(p=0.1), goal_change=(1, 3)),
    "extra end step": replace(surjective(p=0.1), extra_end_step=True, legacy_goal_change=True, goal_change=(2, 3)),
    "three branches": surjective(b=3, d=3),
    "one-hot": one_hot(p=0.5),
}

every_mode = pytest.mark.parametrize("mode", MODES, ids=[mode.value for mode in MODES])
every_kind = pytest.mark.parametrize("kind", VARIED)


def act(rng, num_envs, num_actions=3):
    """Random actions, half of them waits so that episodes get somewhere."""
    return rng.integers(num_actions, size=num_envs) * rng.integers(2, size=num_envs)


def assert_equal(ours, theirs, where=""):
    """Equality of nested results, with equal types of arrays."""
    assert type(ours) is type(theirs), where
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys(), where
        for key in theirs:
            assert_equal(ours[key], theirs[key], f"{where}/{key}")
    elif isinstance(theirs, (tuple, list)):
        assert len(ours) == len(theirs), where
        for i, pair in enumerate(zip(ours, theirs, strict=True)):
            assert_equal(*pair, f"{where}/{i}")
    elif isinstance(theirs, np.ndarray):
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape), where
        same = np.array_equal if theirs.dtype != object else all_equal
        assert same(ours, theirs), where
    else:
        assert ours == theirs, where


def all_equal(ours, theirs):
    pairs = zip(ours, theirs, strict=True)
    return all(np.array_equal(a, b) if b is not None else a is None for a, b in pairs)


def both(tasks, mode, **kwargs):
    """The vector environment, and as many single ones in a `SyncVectorEnv`."""
    pool = list(dict.fromkeys(tasks))
    ours = CTGraphVectorEnv(len(tasks), tasks, task_pool=pool, autoreset_mode=mode, **kwargs)
    singles = [lambda task=task: CTGraphGymEnv(task, task_pool=pool, **kwargs) for task in tasks]
    return ours, SyncVectorEnv(singles, autoreset_mode=mode)


def play(envs, seed, num_steps):
    """All that an environment returns for random actions; without autoreset, done rows are reset by a mask."""
    rng, results = np.random.default_rng(7), [envs.reset(seed=seed)]
    num_actions = envs.single_action_space.n
    for _ in range(num_steps):
        results.append(envs.step(act(rng, envs.num_envs, num_actions)))
        done = results[-1][2]
        if envs.metadata["autoreset_mode"] == AutoresetMode.DISABLED and done.any():
            results.append(envs.reset(options={"reset_mask": done.copy()}))
    return results


@every_mode
@every_kind
def test_the_vector_environment_equals_sync_vector_env_step_for_step(kind, mode):
    ours, theirs = both([VARIED[kind]] * 4, mode)

    played = [play(envs, 11, 150) for envs in (ours, theirs)]

    assert_equal(*played)
    assert any(result[2].sum() > 1 for result in played[0] if len(result) == 5)


@every_mode
def test_rows_of_different_tasks_equal_sync_vector_env(mode):
    tasks = [task for name, task in VARIED.items() if name not in ("three branches", "one-hot")]

    played = [play(envs, list(range(50, 50 + len(tasks))), 400) for envs in both(tasks, mode)]

    assert_equal(*played)


@every_mode
def test_what_was_returned_is_not_overwritten_and_may_be_written_into(mode):
    envs, twin = (CTGraphVectorEnv(4, confounding(p=0.5), autoreset_mode=mode) for _ in range(2))
    expected = play(twin, 3, 100)

    results = play(envs, 3, 100)
    kept = copy.deepcopy(results)
    play(envs, 4, 100)
    spoiled = play(Spoiler(envs), 3, 100)

    assert_equal(results, kept)
    assert_equal(results, expected)
    assert_equal(spoiled, expected)


class Spoiler:
    """Writes into all arrays that an environment returns, after copying them."""

    def __init__(self, envs):
        self.envs, self.num_envs, self.metadata = envs, envs.num_envs, envs.metadata
        self.single_action_space = envs.single_action_space

    def reset(self, **kwargs):
        return self.spoiled(self.envs.reset(**kwargs))

    def step(self, actions):
        result = self.spoiled(self.envs.step(actions))
        actions[:] = 77
        return result

    def spoiled(self, results):
        kept = copy.deepcopy(results)
        for array in results:
            for each in array.values() if isinstance(array, dict) else [array]:
                if isinstance(each, np.ndarray) and each.dtype != object:
                    each[...] = 1
        return kept


def test_row_i_has_the_stream_of_its_own_seed_and_row_zero():
    task, seeds = fully_observable(p=0.5), [5, 123456789012345678, 0]
    actions = scripts(60, 3)
    envs = CTGraphVectorEnv(3, task, autoreset_mode="SameStep")

    shown = [envs.reset(seed=seeds)[0], *(envs.step(action.numpy())[0] for action in actions)]

    for row, seed in enumerate(seeds):
        data = record(CTGraphEnv([task], seed=seed), actions[:, row : row + 1])
        expected = data["observation"][0].numpy()
        assert np.array_equal(np.stack(shown)[:-1, row], expected)


def test_the_first_reset_without_a_seed_draws_one_and_later_resets_go_on():
    env, envs = CTGraphGymEnv(confounding()), CTGraphVectorEnv(8, confounding())
    env.np_random, envs.np_random = np.random.default_rng(1), np.random.default_rng(1)
    first, twin = env.reset()[0], CTGraphGymEnv(confounding())
    twin.np_random = np.random.default_rng(1)

    shown = [env.reset()[0] for _ in range(20)]
    wait_images = [env.step(0)[0].tobytes() for _ in range(20) if env.reset()]

    assert np.array_equal(first, twin.reset()[0])
    assert all(np.array_equal(first, other) for other in shown)
    assert len(set(wait_images)) > 5
    envs.reset()
    assert len({image.tobytes() for image in envs.step(np.zeros(8, int))[0]}) > 3


@every_mode
def test_a_mask_resets_and_seeds_its_rows_and_leaves_the_others(mode):
    ours, theirs = both([confounding(p=0.5, read_noise=5)] * 4, mode)
    mask = np.array([True, False, False, True])

    def script(envs):
        results = [envs.reset(seed=[1, 2, 3, 4]), envs.step(np.zeros(4, int))]
        results.append(envs.reset(seed=[9, 9, None, None], options={"reset_mask": mask.copy()}))
        results += [envs.step(np.zeros(4, int)) for _ in range(2)]
        results.append(envs.reset(seed=70, options={"reset_mask": ~mask}))
        results += [envs.step(np.zeros(4, int)) for _ in range(1)]
        return [*results, envs.reset(seed=[None, 6, None, 8]), envs.step(np.zeros(4, int)), envs.reset()]

    assert_equal(script(ours), script(theirs))


@every_mode
def test_tasks_change_at_the_next_reset_of_a_row(mode):
    pool = [surjective(p=0.3), fully_observable(p=0.6, goal=(2, 2)), replace(confounding(), goal_change=(1, 2))]
    ours, theirs = both([pool[0], pool[1], pool[2], pool[0]], mode)
    wanted = [pool[1], pool[2], pool[0], pool[0]]

    def script(envs):
        results = play(envs, 1, 50)
        if envs is ours:
            envs.set_tasks(wanted)
        else:
            for env, task in zip(envs.envs, wanted, strict=True):
                env.set_task(task)
        rng = np.random.default_rng(8)
        for _ in range(100):
            results.append(envs.step(act(rng, 4)))
            if mode == AutoresetMode.DISABLED and results[-1][2].any():
                results.append(envs.reset(options={"reset_mask": results[-1][2].copy()}))
        return results

    played = [script(envs) for envs in (ours, theirs)]

    assert_equal(*played)
    assert played[0][0][1]["task"].tolist() == [0, 1, 2, 0]
    assert played[0][-1][-1]["task"].tolist() == [1, 2, 0, 0]


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
    env = gymnasium.make(f"ctgraph/{name}-v0").unwrapped

    assert env.task_pool == (CONFIGURATIONS[name](),)


def test_an_id_after_its_module_needs_no_import_and_no_torchrl(checkout, tmp_path):
    code = (
        "import gymnasium, sys; print(gymnasium.make('ctgraph_rl.gym:ctgraph/CT-SU-B1-v0').action_space); "
        "print([name for name in ('torchrl', 'tensordict', 'hydra', 'stable_baselines3') if name in sys.modules])"
    )
    env = {**os.environ, "PYTHONPATH": str(checkout)}

    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True)

    assert (result.stderr, result.stdout) == ("", "Discrete(3)\n[]\n")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({}, paper.ct_fo_b1()),
        ({"goal": (2, 1), "image_seed": 5}, paper.ct_fo_b1((2, 1), 5)),
        ({"depth": 3, "wait_prob": 0.5}, paper.ct_fo_b2()),
        ({"fully_observable": False}, paper.ct_su_b1()),
        (
            {"branching_factor": 3, "depth": 1, "one_hot": True, "goal": [3]},
            paper.ct_graph(3, 1, goal=(3,), one_hot=True),
        ),
        ({"task": "CT-SU-B1", "goal": (2, 2), "image_seed": 3}, paper.ct_su_b1((2, 2), 3)),
        ({"task": "CT-SU-B1", "wait_prob": 0.5, "reward_std": 0.1}, paper.ct_posr_b1()),
        ({"task": paper.ct_co_b1(), "fail_reward": -1}, replace(paper.ct_co_b1(), fail_reward=-1)),
        ({"task": surjective(), "read_noise": 9}, surjective(read_noise=9)),
    ],
)
def test_keyword_arguments_say_what_task_is_meant(arguments, expected):
    env = gymnasium.make("ctgraph/CTGraph-v0", **arguments).unwrapped

    assert env.task_pool == (expected,)


def test_a_configuration_file_of_the_authors_makes_an_environment(tmp_path):
    content = json.loads((Path(__file__).parent / "data" / "reference_traces.json").read_text())[0]["config"]
    (tmp_path / "graph.json").write_text(json.dumps(content))

    made = [make_task(config=config, goal=(2, 1)) for config in (tmp_path / "graph.json", content)]

    assert made == [Task.from_json(content, goal=(2, 1))] * 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goal": (1, 1, 1)}, "goal must be 2 decisions in 1..2"),
        ({"gaol": (1, 1)}, "no field of a task, its graph or its observations: gaol"),
        ({"task": "CT-FO-B3"}, "task must be one of CT-FO-B1, .*, got 'CT-FO-B3'"),
        ({"task": 3}, "task must be a Task or the name of a configuration, got 3"),
        ({"task": "CT-FO-B1", "config": {}}, "give a task or a config, not both"),
        ({"one_hot": True, "task": "CT-FO-B1"}, "no field of .*: one_hot"),
        ({"task": one_hot(), "image_seed": 1}, "image_seed needs generated images, got OneHot"),
        ({"render_mode": "human"}, "render_mode must be None or one of"),
        ({"task_pool": [surjective()]}, "tasks must be in task_pool"),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    for kind in (CTGraphGymEnv, CTGraphVectorEnv):
        with pytest.raises(ValueError, match=message):
            kind(**arguments)


@pytest.mark.parametrize("action", [-1, 3, 1.0, "1", None, np.array([1]), np.array([0, 1])])
def test_the_single_environment_refuses_wrong_actions(action):
    env = CTGraphGymEnv(surjective())
    env.reset(seed=0)

    with pytest.raises(ValueError, match=r"action must be an integer in 0\.\.2, got"):
        env.step(action)


@pytest.mark.parametrize("action", [0, np.int64(0), np.uint8(0), np.array(0), torch.tensor(0)])
def test_every_kind_of_integer_is_an_action(action):
    env = CTGraphGymEnv(surjective())
    env.reset(seed=0)

    assert env.step(action)[2] is False


@pytest.mark.parametrize(
    "actions", [[0, 0, 3], [0, -1, 0], [0, 0], np.zeros(3), [[0, 0, 0]], [True] * 3, [2**63] * 3], ids=str
)
def test_the_vector_environment_refuses_wrong_actions(actions):
    envs = CTGraphVectorEnv(3, surjective())
    envs.reset(seed=0)

    with pytest.raises(ValueError, match=r"actions must be integers of shape \(3,\) in 0\.\.2, got"):
        envs.step(np.array(actions))


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int32, np.uint64])
def test_actions_may_be_integers_of_any_size(dtype):
    envs, twin = (CTGraphVectorEnv(3, surjective()) for _ in range(2))
    envs.reset(seed=0), twin.reset(seed=0)

    assert_equal(envs.step(np.array([0, 1, 2], dtype)), twin.step(np.array([0, 1, 2])))


def test_steps_without_a_running_episode_are_refused():
    env = CTGraphGymEnv(surjective())
    envs = {mode: CTGraphVectorEnv(2, surjective(), autoreset_mode=mode) for mode in MODES}

    for each in envs.values():
        with pytest.raises(ValueError, match=r"no episode is running in the rows \[0, 1\]: reset them first"):
            each.step(np.zeros(2, int))
    with pytest.raises(ValueError, match="no episode is running: reset first"):
        env.step(0)
    env.reset()
    env.step(0), env.step(1)
    with pytest.raises(ValueError, match="no episode is running: reset first"):
        env.step(0)
    disabled = envs[AutoresetMode.DISABLED]
    disabled.reset()
    disabled.step(np.zeros(2, int)), disabled.step(np.array([1, 0]))
    with pytest.raises(ValueError, match=r"no episode is running in the rows \[0\]: reset them first"):
        disabled.step(np.zeros(2, int))


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, "0", [1, 2], [1, 2, -1], [1, 2, 2**63]], ids=str)
def test_wrong_seeds_are_refused(seed):
    env, envs = CTGraphGymEnv(surjective()), CTGraphVectorEnv(3, surjective())

    with pytest.raises(ValueError, match="seed must"):
        envs.reset(seed=seed)
    with pytest.raises(ValueError, match="seed must"):
        env.reset(seed=seed)


@pytest.mark.parametrize("mask", [[True, False], np.zeros(2, bool), np.ones(3, bool), np.ones(2), None], ids=str)
def test_wrong_masks_are_refused(mask):
    envs = CTGraphVectorEnv(2, surjective())
    envs.reset()

    with pytest.raises(ValueError, match=r"reset_mask must be a bool array of shape \[2\]"):
        envs.reset(options={"reset_mask": mask})


def test_the_first_reset_must_be_of_all_rows():
    envs = CTGraphVectorEnv(2, surjective())

    with pytest.raises(ValueError, match="the first reset must be of all rows"):
        envs.reset(options={"reset_mask": np.array([True, False])})


def test_tasks_outside_of_the_pool_and_of_another_number_are_refused():
    env, envs = CTGraphGymEnv(surjective()), CTGraphVectorEnv(2, surjective())

    with pytest.raises(ValueError, match="tasks must be in task_pool"):
        env.set_task(surjective(goal=(2, 2)))
    with pytest.raises(ValueError, match="tasks must be in task_pool"):
        envs.set_tasks([surjective(), surjective(goal=(2, 2))])
    with pytest.raises(ValueError, match="set_tasks needs 2 tasks, got 1"):
        envs.set_tasks([surjective()])
    with pytest.raises(ValueError, match="task must be one, or one per row of 2, got 3"):
        CTGraphVectorEnv(2, [surjective()] * 3)
    with pytest.raises(ValueError, match="num_envs must be an integer >= 1, got 0"):
        CTGraphVectorEnv(0)


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
        "home state, step 0, goal 1 2\n██        ",
        "wait state, step 1, goal 1 2\n    ██    ",
        "decision state, step 2, goal 1 2\n      ██  ",
        "wait state after 2, step 3, goal 1 2\n    ██    ",
        "fail state after 2, step 4, goal 1 2\n  ██      ",
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


@every_mode
def test_episode_statistics_of_the_vector_environment_are_those_of_its_episodes(mode):
    plans = {0: (0, 0, 1, 0, 1, 0), 1: (0, 1), 2: (0, 0, 1, 0, 2, 0)}
    envs = VectorStatistics(CTGraphVectorEnv(3, surjective(), autoreset_mode=mode))
    envs.reset(seed=0)
    step, recorded = np.zeros(3, int), {row: set() for row in plans}

    for _ in range(30):
        _, _, done, _, infos = envs.step(np.array([(*plans[row], 0)[step[row]] for row in plans]))
        resets = done if mode != AutoresetMode.NEXT_STEP else step == [len(plan) for plan in plans.values()]
        step = np.where(resets, 0, step + 1)
        for row in done.nonzero()[0]:
            recorded[row].add((infos["episode"]["r"][row], infos["episode"]["l"][row]))
        if mode == AutoresetMode.DISABLED and done.any():
            envs.reset(options={"reset_mask": done})

    assert recorded == {0: {(1.0, 6)}, 1: {(0.0, 2)}, 2: {(0.0, 6)}}


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


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_row_whose_task_stays_goes_on_with_its_goals_while_others_change(mode):
    stays = replace(ct_su_b1(), goal_change=(1, 2))
    other = replace(stays, goal=(2, 2))
    envs = CTGraphVectorEnv(3, stays, task_pool=[stays, other], autoreset_mode=mode)
    twins = [CTGraphGymEnv(stays, task_pool=[stays, other]) for _ in range(3)]
    sync = SyncVectorEnv([lambda twin=twin: twin for twin in twins], autoreset_mode=AutoresetMode(mode))
    envs.reset(seed=5), sync.reset(seed=5)
    envs.set_tasks([stays, other, stays])
    twins[1].set_task(other)
    rng = np.random.default_rng(0)

    for number in range(60):
        mask = np.array([True, number % 3 == 2, number % 2 == 0])
        if mode == "Disabled":
            envs.reset(options={"reset_mask": mask})
            sync.reset(options={"reset_mask": mask.copy()})
        else:
            actions = rng.integers(0, 3, 3)
            envs.step(actions), sync.step(actions)
        assert envs.rows.goal_leaf.tolist() == [twin.rows.goal_leaf.item() for twin in twins]


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


def test_environments_in_processes_of_their_own_run_with_any_number_of_threads():
    code = """
import gymnasium, numpy, ctgraph_rl.gym
envs = gymnasium.make_vec("ctgraph/CT-CO-B1-v0", num_envs=2, vectorization_mode="async", read_noise=5)
envs.reset(seed=0)
print(envs.step(numpy.array([0, 1]))[0].shape)
envs.close()
"""
    threads = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}

    found = subprocess.run([sys.executable, "-c", code], env=threads, capture_output=True, text=True, timeout=120)

    assert found.stdout.strip() == "(2, 1, 12, 12)", found.stderr


def test_a_wrong_keyword_is_answered_with_the_nearest_one():
    with pytest.raises(ValueError, match="wait_probability; did you mean 'wait_prob'"):
        make_task("CT-SU-B1", wait_probability=0.5)
    with pytest.raises(ValueError, match=r"autoreset_mode must be one of \['NextStep', 'SameStep', 'Disabled'\]"):
        CTGraphVectorEnv(2, autoreset_mode="same_step")


def test_a_path_that_counts_from_zero_is_answered_with_the_goal():
    with pytest.raises(ValueError, match=r"counts from 0: use \(1, 2\)"):
        ct_su_b1(goal=(0, 1))
