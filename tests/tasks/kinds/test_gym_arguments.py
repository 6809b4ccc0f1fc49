"""Arguments of environments and wrappers arrive as they were written, through JSON too."""

from dataclasses import replace
from enum import StrEnum
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import FrameStackObservation, TimeLimit

from ctgraph_rl import Block, Curriculum, GymTask
from ctgraph_rl.batch.gym_env import GymEnv
from ctgraph_rl.tasks.kinds.gym_task import time_limit


class Keeps(gymnasium.Env):
    """Keeps its arguments."""

    observation_space = gymnasium.spaces.Box(0, 1, (2,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, **kwargs):
        self.kwargs = kwargs

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, dtype=np.float32), {}

    def step(self, action):
        return np.zeros(2, dtype=np.float32), 0.0, False, False, {}

    class Outer(gymnasium.Wrapper):
        """A wrapper within a class."""


class Wraps(gymnasium.Wrapper):
    """Keeps its arguments."""

    def __init__(self, env, *, pair, nested=None):
        super().__init__(env)
        self.given = (pair, nested)


gymnasium.register("arguments/Keeps-v0", Keeps, max_episode_steps=9)
gymnasium.register("arguments/Endless-v0", Keeps)

WRITTEN = {
    "agent_start_pos": (7, 7),
    "frameskip": (2, 5),
    "rows": ["SF", "FG"],
    "nested": [[1, (2, [3.0])], {"a": (1,), 2: {"b": []}}],
    "empty": [(), [], {}],
    "flag": True,
    "one": 1,
    "real": 1.0,
    "nothing": None,
    "type": {"type": "TupleArgument", "items": [1]},
}


def strict(value):
    """Return a value with the types of all its parts."""
    if isinstance(value, dict):
        return [(strict(key), strict(item)) for key, item in value.items()]
    return type(value), [strict(item) for item in value] if isinstance(value, (list, tuple)) else value


def of(*tasks):
    return Curriculum("arguments", 1, "-", tuple(Block(task, 64) for task in tasks))


def kept(task):
    env = task.make()
    try:
        return env.unwrapped.kwargs
    finally:
        env.close()


def test_arguments_arrive_with_their_types_directly_replaced_and_through_json():
    task = GymTask("arguments/Keeps-v0", WRITTEN)
    read = Curriculum.from_json(of(task).to_json()).tasks[0]

    for each in (task, replace(task, label="other"), read):
        arrived = kept(each)
        assert {name: strict(value) for name, value in arrived.items()} == {
            name: strict(value) for name, value in WRITTEN.items()
        }
    assert read == task
    assert list(kept(task)["nested"][1]) == ["a", 2]


def test_an_environment_cannot_change_the_arguments_of_its_task():
    task = GymTask("arguments/Keeps-v0", {"rows": [1], "cells": {"a": 1}})

    kept(task)["rows"].append(2)
    kept(task)["cells"]["b"] = 2

    assert kept(task) == {"rows": [1], "cells": {"a": 1}}


DIFFERENT = [True, 1, 1.0, "1", [1], (1,), [[1]], [(1,)], [True], {"a": 1}, {"a": True}, {1: 1}, {True: 1}, None]


def test_arguments_of_different_types_make_different_tasks():
    tasks = [GymTask("arguments/Keeps-v0", {"x": value}) for value in DIFFERENT]
    wrapped = [GymTask("arguments/Keeps-v0", wrappers=[(Wraps, {"pair": value})]) for value in DIFFERENT]
    everything = [*tasks, *wrapped]

    assert len(set(everything)) == len(everything)
    assert len({of(task).fingerprint for task in everything}) == len(everything)
    assert [Curriculum.from_json(of(task).to_json()).tasks[0] for task in everything] == everything
    assert tasks[1] == GymTask("arguments/Keeps-v0", {"x": np.int64(1)})
    assert tasks[11] == GymTask("arguments/Keeps-v0", {"x": {np.int64(1): np.int64(1)}})
    assert hash(tasks[1]) == hash(GymTask("arguments/Keeps-v0", {"x": 1}))


def test_a_text_of_an_enumeration_arrives_as_its_text():
    class Size(StrEnum):
        SMALL = "small"

    task = GymTask("arguments/Keeps-v0", {"size": Size.SMALL})

    assert type(kept(task)["size"]) is str
    assert Curriculum.from_json(of(task).to_json()).tasks[0] == task


def test_wrappers_take_arguments_in_each_form():
    name = f"{__name__}:Wraps"
    forms = [
        (Wraps, {"pair": (1, 2), "nested": {"a": [1]}}),
        [name, {"nested": {"a": [1]}, "pair": (1, 2)}],
        partial(Wraps, pair=(1, 2), nested={"a": [1]}),
    ]
    tasks = [GymTask("arguments/Keeps-v0", wrappers=[Keeps.Outer, form]) for form in forms]

    assert len(set(tasks)) == 1
    assert tasks[0].make().given == ((1, 2), {"a": [1]})
    assert tasks[0].make().env.class_name() == "Outer"
    assert tasks[0].modules == (Keeps.__module__,)
    assert Curriculum.from_json(of(*tasks[:1]).to_json()).tasks == (tasks[0],)


def test_frames_are_stacked_by_a_wrapper_with_an_argument():
    wrappers = [(FrameStackObservation, {"stack_size": 4}), "gymnasium.wrappers:FlattenObservation"]

    assert GymTask("arguments/Keeps-v0", wrappers=wrappers).observation_shape == (8,)


def test_a_time_limit_among_wrappers_is_one_and_the_shortest_counts():
    wrapped = GymTask("arguments/Endless-v0", wrappers=[(TimeLimit, {"max_episode_steps": 3})])
    both = GymTask("arguments/Keeps-v0", wrappers=[(TimeLimit, {"max_episode_steps": 20})])

    truncated = GymEnv([wrapped]).rollout(4, break_when_any_done=False)["next", "truncated"]

    assert truncated.flatten().tolist() == [False, False, True, False]
    assert time_limit(both.make()) == 9


def no_environment(env):
    """Return no environment."""


def test_a_function_that_returns_no_environment_is_refused():
    with pytest.raises(ValueError, match=r"no_environment must return a gymnasium.Env, got None"):
        GymTask("arguments/Keeps-v0", wrappers=[no_environment]).make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: GymTask("A-v0", wrappers=[lambda env: env]),
            "has no name by which another process finds it.*at the top",
        ),
        (
            lambda: GymTask("A-v0", wrappers=[strict.__class__, type("In", (), {"__qualname__": "f.<locals>.In"})]),
            "no name",
        ),
        (lambda: GymTask("A-v0", wrappers=[partial(Wraps, 1)]), "needs its arguments by name"),
        (lambda: GymTask("A-v0", wrappers=[(Wraps, {"pair": object()})]), "Wraps must be plain values by name.*object"),
        (lambda: GymTask("A-v0", wrappers=[("m:A", "m:B")]), "arguments of the wrapper m:A must be plain values"),
        (lambda: GymTask("A-v0", wrappers="m:A"), "wrappers must be a list of classes, functions or their names"),
        (lambda: GymTask("A-v0", {"x": {1, 2}}), r"kwargs must be plain values by name.*\{1, 2\} is no number, text"),
        (lambda: GymTask("A-v0", {"x": [len]}), "built-in function len> is no number, text"),
        (lambda: GymTask("A-v0", {"x": {(1, 2): 3}}), r"the key \(1, 2\) of a dict is no number or text"),
        (lambda: GymTask("A-v0", {"max_episode_steps": 3}), r"give it as GymTask\(max_episode_steps=...\)"),
        (lambda: GymTask("A-v0", {"disable_env_checker": True}), "the checker is always off"),
    ],
)
def test_arguments_without_a_plain_form_are_refused_with_the_reason(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"type": "Other", "items": []}, "type must be TupleArgument or DictArgument, got 'Other'"),
        ({"type": "TupleArgument"}, "an argument must be an object with type and items"),
        ({"type": "DictArgument", "items": [[1]]}, "items of a DictArgument must be pairs"),
        ({"type": "DictArgument", "items": [[[1], 2]]}, "the key .* of a dict is no number or text"),
    ],
)
def test_json_of_an_argument_that_is_none_is_refused(argument, message):
    content = of(GymTask("arguments/Keeps-v0", {"x": 1})).to_json()
    content["tasks"][0]["kwargs"] = [["x", argument]]

    with pytest.raises(ValueError, match=message):
        Curriculum.from_json(content)
