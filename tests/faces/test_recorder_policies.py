"""What a recorder takes as a policy: functions of arrays, modules, models of other libraries, reference policies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.oracles import surjective
from helpers.scripted import DECISION_ID, ONE, TWO, curriculum
from stable_baselines3 import PPO

import curricula
from ctgraph_rl import Block, Curriculum, Evaluation, Protocol
from ctgraph_rl.policies import NavigationPolicy
from ctgraph_rl.runs.recorder import Recorder
from ctgraph_rl.sb3 import SB3VecEnv

TASKS = curriculum(Block(ONE, 12), Block(TWO, 24))


def table(decision: int):
    """A lookup table: waits, and takes one decision."""
    return lambda observation: observation[:, DECISION_ID].astype(np.int64) * decision


def test_a_policy_with_memory_is_given_its_state_and_the_starts_of_episodes():
    starts = []

    def remember(observation, state, start):
        steps = np.where(start, 0, 0 if state is None else state + 1)
        starts.append(start.copy())
        return np.where(steps == 2, 1, 0), steps  # home, wait, decision

    found = Recorder(TASKS).evaluate(remember, 0)

    assert found == {"goal1": 1.0, "goal2": 0.0}
    assert starts[0].all() and not any(start.any() for start in starts[1:])


def test_task_ids_are_shown_with_the_observations():
    told = Curriculum("told", 1, "here", TASKS.blocks, Evaluation(5), Protocol("one_hot", num_task_ids=4))

    def by_task(observation):
        assert observation["task_id"].shape == (10, 4)
        decision = 1 + observation["task_id"].argmax(1)
        return observation["observation"][:, DECISION_ID].astype(np.int64) * decision

    assert Recorder(told).evaluate(by_task, 0) == {"goal1": 1.0, "goal2": 1.0}


def test_a_policy_for_each_task_id_plays_its_own_task():
    given = Curriculum("given", 1, "here", TASKS.blocks, Evaluation(5), Protocol("at_boundaries", task_ids=(2, 1)))

    found = Recorder(given).evaluate(policy_for=table)  # decision 2 for the first task, 1 for the second

    assert found == {"goal1": 0.0, "goal2": 0.0}
    assert Recorder(given).evaluate(policy_for=lambda number: table(3 - number)) == {"goal1": 1.0, "goal2": 1.0}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": table(1), "frames": 37}, "frames must be an integer in 0..36, the curriculum's, got 37"),
        ({"policy": table(1), "frames": 1.5}, "frames must be an integer"),
        ({"policy": None}, "give either policy or policy_for"),
        ({"policy": 3}, "policy must be a function, or an object with predict, got int"),
        ({"policy": lambda a, b: a}, "not 2 arguments"),
        ({"policy": lambda observation: observation[:, 0] * 0.5}, "must return 10 integer actions.*float64"),
        ({"policy": lambda observation: 0}, "must return 10 integer actions"),
        ({"policy": lambda observation: np.full(10, 7)}, "values in 0..2, got"),
    ],
)
def test_what_is_no_policy_or_out_of_range_is_refused(arguments, message):
    recorder = Recorder(TASKS)

    with pytest.raises(ValueError, match=message):
        recorder.evaluate(**arguments)


def test_a_policy_for_each_task_id_needs_a_protocol_that_gives_it_and_tasks_that_have_one():
    held_out = Curriculum("held", 1, "here", (Block(ONE, 12),), Evaluation(held_out=(TWO,)), Protocol("at_boundaries"))

    for told, message in (
        (TASKS, "task ids, which are hidden in this protocol"),
        (held_out, "held-out tasks, which have no task id"),
    ):
        with pytest.raises(ValueError, match=message):
            Recorder(told).evaluate(policy_for=table)


def test_arguments_with_a_default_are_left_to_the_policy():
    def act(observation, decision=2, scale=1):
        return table(decision * scale)(observation)

    assert Recorder(TASKS).evaluate(act, 0) == {"goal1": 0.0, "goal2": 1.0}


@pytest.mark.parametrize("greedy", [True, False])
def test_a_model_is_greedy_where_the_protocol_says_so(greedy):
    asked = []

    class Model:
        def predict(self, observation, state, episode_start, deterministic):
            asked.append(deterministic)
            return table(1)(observation), state

    Recorder(replace(TASKS, evaluation=Evaluation(5, greedy=greedy))).evaluate(Model(), 0)

    assert set(asked) == {greedy}


def test_a_reference_policy_is_given_as_its_class():
    one = Curriculum("one", 1, "here", (Block(surjective(), 8),), Evaluation(50))

    found = Recorder(one).evaluate(NavigationPolicy, 0)

    assert 0.0 < next(iter(found.values())) < 1.0


def test_a_model_without_a_place_for_task_ids_is_refused_with_the_fix():
    told = Curriculum("told", 1, "here", TASKS.blocks, Evaluation(5), Protocol("one_hot"))
    model = PPO("MlpPolicy", SB3VecEnv(2, ONE), n_steps=8, batch_size=16)

    with pytest.raises(ValueError, match=r"shows a task_id that PPO has no place for: .*protocol=Protocol\(\)"):
        Recorder(told).evaluate(model, 0)


def test_stable_baselines3_is_measured_by_the_protocol(tmp_path):
    published = curricula.su_b1_4tasks(num_frames=512)
    envs = SB3VecEnv(32, published.tasks[0], task_pool=published.tasks)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=64, n_epochs=1, seed=0)

    with Recorder(published, tmp_path / "sb3", about={"learner": "PPO of Stable-Baselines3"}) as recorder:
        recorder.evaluate(model, 0)
        for block, frames in zip(published.blocks, published.ends, strict=True):
            envs.env_method("set_tasks", block.rows(32))
            model.learn(block.num_frames)
            recorder.evaluate(model, frames)

    assert recorder.log.performance().shape == (5, 4)
    assert recorder.metrics["average_performance"].value == 0.0  # without memory, a little training: at most luck
