"""Numbers of NumPy, torch and other libraries mean what Python's own mean, wherever a number is taken."""

from __future__ import annotations

import json
import math
from dataclasses import fields, is_dataclass, replace
from decimal import Decimal
from fractions import Fraction
from inspect import signature
from typing import Any

import numpy as np
import pytest
import torch

import curricula
from baselines.parts.catalogue import catalogue
from ctgraph_rl import (
    Block,
    CTGraph,
    CTGraphEnv,
    Curriculum,
    Evaluation,
    GroupedImages,
    OneHot,
    PaperImages,
    Protocol,
    Recorder,
    ReferenceImages,
    evaluate,
    make_agent,
)
from ctgraph_rl.checks import TakesNumbers, plain
from ctgraph_rl.gym import CTGraphGymEnv, CTGraphVectorEnv
from ctgraph_rl.policies import OptimalPolicy
from ctgraph_rl.runs.train import new_agent
from ctgraph_rl.tasks.configurations import ct_su_b1
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift

TASK = replace(ct_su_b1((1, 2)), reward_std=0.25, goal_change=(1, 2), swapped_branches=((1,), (1, 2)))
PARTS = {
    "graph": CTGraph(2, 2, 0.5),
    "observations": TASK.observations,
    "task": TASK,
    "block": Block((ct_su_b1((1, 2)), ct_su_b1((2, 1))), 64, Drift(3)),
    "evaluation": Evaluation(4, episodes_per_row=2, every=32),
    "protocol": Protocol("one_hot", num_task_ids=4, task_ids=(3, 1), guide_frames=8),
    "by_episode": ByEpisode(2),
    "at_random": AtRandom(0.5),
    "drift": Drift(3, True),
    "paper_images": PaperImages(5, 2, 12),
    "grouped_images": GroupedImages((1, 4), 0.3125, 0.328125, cells=6),
    "reference_images": ReferenceImages(5, noise=0.5),
    "one_hot": OneHot(5),
    "curriculum": Curriculum("two", 1, "a test", (Block(ct_su_b1(), 32),)),
}
"""An object of every dataclass with numbers; those are exact in float32."""


class Whole:
    """An integer of a library that nobody here knows."""

    def __init__(self, value: int) -> None:
        self.value = value

    def __index__(self) -> int:
        return self.value


def of_numpy(value: Any) -> Any:
    """A plain value as NumPy has it: scalars of small types, and arrays."""
    if isinstance(value, bool):
        return np.bool_(value)
    if isinstance(value, int):
        return np.uint8(value)
    if isinstance(value, float):
        return np.float32(value)
    numbers = isinstance(value, tuple) and bool(value) and all(type(item) in (int, float) for item in value)
    return np.array(value) if numbers else tuple(map(of_numpy, value)) if isinstance(value, tuple) else value


def of_torch(value: Any) -> Any:
    """A plain value as torch has it."""
    if isinstance(value, tuple) and not all(type(item) in (int, float) for item in value):
        return tuple(map(of_torch, value))
    return torch.tensor(value) if type(value) in (bool, int, float, tuple) else value


def types_in(value: Any) -> set[type]:
    """The types of all values within a value."""
    if is_dataclass(value):
        return set().union(*(types_in(getattr(value, field.name)) for field in fields(value)))
    return set().union(*map(types_in, value)) | {tuple} if isinstance(value, tuple) else {type(value)}


PLAIN = {bool, int, float, str, tuple, type(None)}


@pytest.mark.parametrize("convert", [of_numpy, of_torch])
@pytest.mark.parametrize("name", PARTS)
def test_a_part_made_of_scalars_and_arrays_is_the_part_made_of_plain_values(name, convert):
    part = PARTS[name]
    given = {field.name: convert(getattr(part, field.name)) for field in fields(part) if field.init}

    made = type(part)(**given)

    assert made == part
    assert types_in(made) <= PLAIN


def test_fingerprint_and_json_of_a_curriculum_do_not_depend_on_whose_numbers_it_is_made_of():
    ours, theirs = (
        curricula.load("ct8", num_frames=256),
        curricula.load("ct8", num_frames=np.uint16(256)),
    )

    assert theirs.fingerprint == ours.fingerprint
    assert json.dumps(theirs.to_json()) == json.dumps(ours.to_json())


FEW = ("ct8", "penn_a_swap", "su_b1_4tasks", "single_task")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FEW else pytest.mark.slow) for name in curricula.names()]
)
def test_every_named_curriculum_takes_numpy_s_numbers(name):
    function = getattr(curricula, name)
    numbers = {key: p.default for key, p in signature(function).parameters.items() if type(p.default) in (int, float)}
    given = {key: np.int64(value) if type(value) is int else np.float64(value) for key, value in numbers.items()}

    assert function(**given) == function()


WHOLE = (np.int64(3), np.uint8(3), torch.tensor(3), np.array(3), Whole(3), 3.0, np.float32(3))


@pytest.mark.parametrize("whole", WHOLE)
def test_what_is_a_whole_number_is_an_integer(whole):
    block = Block(ct_su_b1(), whole)

    assert (block.num_frames, type(block.num_frames)) == (3, int)


@pytest.mark.parametrize("half", [np.float16(0.5), torch.tensor(0.5), Fraction(1, 2), Decimal("0.5"), np.array(0.5)])
def test_what_is_a_real_number_is_a_float(half):
    graph = CTGraph(2, 2, half)

    assert (graph.wait_prob, type(graph.wait_prob)) == (0.5, float)


@pytest.mark.parametrize(
    "value",
    [True, np.True_, torch.tensor(True), 1.5, np.float32(1.5), "3", 1e30, math.nan, math.inf, 3 + 0j, np.array([3])],
    ids=repr,
)
def test_what_is_no_whole_number_is_refused_as_an_integer(value):
    with pytest.raises(ValueError, match="num_frames must be an integer >= 1, got "):
        Block(ct_su_b1(), value)


def test_a_list_that_contains_itself_is_left_to_the_rules():
    endless: list[Any] = []
    endless.append(endless)

    assert plain(endless) is endless


@pytest.mark.parametrize("number", [np.int64, torch.tensor, float])
def test_environments_take_them(number):
    vector = CTGraphVectorEnv(number(2), depth=number(1), goal=np.array([1]))
    single = CTGraphGymEnv(depth=number(1), goal=torch.tensor([1]), wait_prob=np.float32(0.5))
    ids = {ct_su_b1(): np.int64(1)}
    env = CTGraphEnv([ct_su_b1()], number(3), number(1), task_ids=ids, num_task_ids=number(3))

    assert (env.rows.seed.tolist(), env.rows.row.tolist()) == ([3], [1])
    assert vector.reset(seed=number(4))[0].shape == (2, 1, 12, 12)
    assert single.reset(seed=number(4))[1]["task"] == 0
    assert env.reset()["task_id"].tolist() == [[0, 1, 0]]
    assert env.set_seed(number(3)) == env.set_seed(3)


@pytest.mark.parametrize("goals", [np.array([[1, 2], [2, 1]]), torch.tensor([[1, 2], [2, 1]])], ids=["numpy", "torch"])
def test_goals_of_rows_may_be_an_array(goals):
    env = CTGraphEnv([ct_su_b1()] * 2)

    env.set_goals(goals)

    assert env.goal_leaf.tolist() == [1, 2]


def test_evaluations_and_recorders_take_them():
    curriculum = curricula.load("su_b1_4tasks", num_frames=np.int64(256))
    played = evaluate(OptimalPolicy, [ct_su_b1()], np.int64(2), seed=torch.tensor(3), episodes_per_row=np.int64(1))

    with Recorder(curriculum, seed=np.int64(3), about={"rate": np.float32(0.5), "sizes": np.array([1, 2])}) as recorder:
        recorder.evaluate(lambda observation: np.zeros(len(observation), dtype=np.int64), np.int64(0))
        recorder.training(np.int64(64), loss=torch.tensor(0.5))

    assert played["episode_reward"].mean() == 1
    assert recorder.log.measurements[0]["config"] == {"seed": 3, "rate": 0.5, "sizes": [1, 2]}
    assert json.dumps(recorder.log.measurements)


def test_values_of_tasks_take_them():
    assert ct_su_b1().optimal_value(np.float32(0.5)) == ct_su_b1().optimal_value(0.5)
    assert CTGraph(2, 60).first_node(np.int64(60)) == 2**60 - 1
    assert CTGraph(2, 2, 0.5).episode_length_prob(torch.tensor(9)) == CTGraph(2, 2, 0.5).episode_length_prob(9)


def test_make_agent_takes_them():
    curriculum = curricula.load("su_b1_4tasks")
    settings = {"num_envs": np.int64(16), "num_steps": 1e2, "learning_rate": np.float32(0.5), "gamma": Fraction(1, 2)}

    agent = make_agent("ppo", curriculum, np.int64(3), method="ewc", method_settings={"coeff": np.int64(3)}, **settings)

    alone = agent.agent if hasattr(agent, "agent") else agent
    assert (alone.num_envs, alone.num_steps, alone.settings.gamma) == (16, 100, 0.5)


@pytest.mark.parametrize("group", ["agent", "method", "detector", "exchange", "cell"])
def test_every_class_of_the_baselines_takes_them(group):
    def takes(kind: type) -> bool:
        """Whether its constructor makes numbers plain, or the dataclass of its settings."""
        if issubclass(kind, TakesNumbers):
            return True
        return hasattr(kind, "Settings") and "make_fields_plain" in kind.Settings.__post_init__.__code__.co_names

    assert [entry.name for entry in catalogue(group) if not takes(entry.kind)] == []


def test_a_user_s_own_learner_takes_them():
    ppo = next(entry for entry in catalogue("agent") if entry.name == "ppo")

    class Mine(ppo.kind):
        def __init__(self, *specs: Any, width: int, **others: Any) -> None:
            self.given = width, type(width)
            super().__init__(*specs, hidden_size=width, **others)

    settings = {key: value for key, value in ppo.settings.items() if key != "hidden_size"}
    agent = new_agent(curricula.load("su_b1_4tasks"), lambda *specs: Mine(*specs, width=np.uint8(8), **settings), 0)

    assert agent.given == (8, int)
