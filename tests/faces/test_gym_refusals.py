"""What the Gymnasium environments take, and what they refuse."""

from __future__ import annotations

import json
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from helpers.gym_steps import MODES, assert_equal
from helpers.oracles import one_hot, surjective
from helpers.paths import DATA

from ctgraph_rl import Task
from ctgraph_rl.gym import CTGraphGymEnv, CTGraphVectorEnv, make_task
from ctgraph_rl.tasks import configurations as paper


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
        ({"task": "CT-SU-B1", "wait_prob": 0.5}, paper.ct_posr_b1()),
        ({"task": paper.ct_co_b1(), "fail_reward": -1}, replace(paper.ct_co_b1(), fail_reward=-1)),
        ({"task": surjective(), "read_noise": 9}, surjective(read_noise=9)),
    ],
)
def test_keyword_arguments_say_what_task_is_meant(arguments, expected):
    env = gymnasium.make("ctgraph/CTGraph-v0", **arguments).unwrapped

    assert env.task_pool == (expected,)


def test_a_configuration_file_of_the_authors_makes_an_environment(tmp_path):
    content = json.loads((DATA / "reference_traces.json").read_text())[0]["config"]
    (tmp_path / "graph.json").write_text(json.dumps(content))

    made = [make_task(config=config, goal=(2, 1)) for config in (tmp_path / "graph.json", content)]

    assert made == [Task.from_json(content, goal=(2, 1))] * 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goal": (1, 1, 1)}, "goal must be 2 decisions in 1..2"),
        ({"gaol": (1, 1)}, "no field of a task, its graph or its observations: gaol"),
        ({"task": "CT-FO-B3"}, r"unknown configuration 'CT-FO-B3': did you mean 'CT-FO-B\d'\?"),
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
    with pytest.raises(ValueError, match=r"num_envs must be an integer in 1\.\.16777216, got 0"):
        CTGraphVectorEnv(0)
    with pytest.raises(ValueError, match=r"num_envs must be an integer in 1\.\.16777216, got 1000"):
        CTGraphVectorEnv(10**200)


def test_a_batch_truncates_no_episode_and_says_which_mode_does():
    with pytest.raises(ValueError, match='truncates no episode, got max_episode_steps=5; vectorization_mode="sync"'):
        gymnasium.make_vec("ctgraph/CTGraph-v0", num_envs=2, max_episode_steps=5)

    env = gymnasium.make_vec("ctgraph/CTGraph-v0", num_envs=2, vectorization_mode="sync", max_episode_steps=2)
    env.reset(seed=0)
    env.step(np.array([0, 0]))
    assert env.step(np.array([0, 0]))[3].any()
