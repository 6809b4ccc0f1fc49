"""Each number of each public signature may be of NumPy, torch or Decimal, and is no bool."""

from dataclasses import replace
from decimal import Decimal
from inspect import isclass, signature
from typing import Any

import numpy as np
import pytest
import torch

import ctgraph_rl
import curricula
from ctgraph_rl import (
    Block,
    CTGraphEnv,
    Curriculum,
    Evaluation,
    GymTask,
    Task,
    evaluate,
    exact_value,
    learn_curriculum,
    make_agent,
)
from ctgraph_rl.batch.gym_env import GymEnv
from ctgraph_rl.gym import CTGraphGymEnv, CTGraphVectorEnv
from ctgraph_rl.learn.collect import make_env
from ctgraph_rl.policies import OptimalPolicy
from ctgraph_rl.tasks.configurations import ct_su_b1

TASK = ct_su_b1()
LAKE = GymTask("FrozenLake-v1", max_episode_steps=3)
SMALL = Curriculum("small", 1, "-", (Block(TASK, 64),), Evaluation(num_episodes=1))
LAKES = Curriculum("lakes", 1, "-", (Block(LAKE, 64),), Evaluation(num_episodes=1))


def first(observation: torch.Tensor) -> torch.Tensor:
    """Return the probabilities of actions: always the first."""
    return torch.tensor([[1.0, 0.0, 0.0]]).expand(len(observation), 3)


def learn(**numbers: Any) -> None:
    learn_curriculum(SMALL, make_agent("a2c", SMALL, num_envs=8, num_steps=8, hidden_size=4), **numbers)


CALLS: dict[str, tuple[Any, dict[str, float]]] = {
    "Block": (lambda **n: Block(TASK, **n), {"num_frames": 64}),
    "CTGraph": (ctgraph_rl.CTGraph, {"branching_factor": 2, "depth": 2, "wait_prob": 0.5}),
    "CTGraphEnv": (
        lambda **n: CTGraphEnv([TASK], task_ids={TASK: 0}, **n),
        {"seed": 3, "first_row": 1, "noise_bank": 2, "num_task_ids": 2},
    ),
    "Curriculum": (lambda **n: Curriculum(**{"name": "c", "source": "-", "blocks": SMALL.blocks} | n), {"version": 2}),
    "Evaluation": (Evaluation, {"num_episodes": 4, "episodes_per_row": 2, "every": 64, "adapt_episodes": 1}),
    "GroupedImages": (
        lambda **n: ctgraph_rl.GroupedImages((1, 1, 2), **{"within": 0.125, "between": 0.25} | n),
        {"within": 0.125, "between": 0.25, "seed": 3, "size": 12, "cells": 4},
    ),
    "GymTask": (lambda **n: GymTask("FrozenLake-v1", **n), {"max_episode_steps": 3}),
    "Observations": (lambda **n: replace(TASK.observations, **n), {"read_noise": 2, "read_rotation": 3}),
    "OneHot": (ctgraph_rl.OneHot, {"num_images": 9}),
    "PaperImages": (ctgraph_rl.PaperImages, {"num_images": 20, "seed": 3, "size": 12}),
    "Protocol": (lambda **n: ctgraph_rl.Protocol("one_hot", **n), {"num_task_ids": 3, "guide_frames": 64}),
    "Recorder": (lambda **n: ctgraph_rl.Recorder(SMALL, **n), {"seed": 3, "checkpoint_seconds": 9.5}),
    "ReferenceImages": (ctgraph_rl.ReferenceImages, {"num_images": 9, "seed": 3, "noise": 2}),
    "ReferenceOneHot": (ctgraph_rl.ReferenceOneHot, {"num_images": 9}),
    "Rows": (lambda **n: ctgraph_rl.Rows([TASK], **n), {"seed": 3, "first_row": 1, "noise_bank": 2}),
    "Task": (
        lambda **n: Task(TASK.graph, images=TASK.images, observations=TASK.observations, goal=TASK.goal, **n),
        {"goal_reward": 2.0, "fail_reward": -0.5, "step_reward": -0.25, "reward_std": 0.5},
    ),
    "evaluate": (
        lambda **n: evaluate(OptimalPolicy, [TASK], **n),
        {"num_episodes": 2, "seed": 3, "episodes_per_row": 1},
    ),
    "exact_value": (lambda **n: exact_value(first, TASK, **n), {"gamma": 0.5}),
    "learn_curriculum": (learn, {"seed": 3}),
    "make_agent": (lambda **n: make_agent("a2c", SMALL, num_envs=8, **n), {"seed": 3}),
}
"""How to call each public function and class, with numbers that it takes."""

FACES: dict[str, tuple[Any, dict[str, float]]] = {
    "GymEnv": (lambda **n: GymEnv([LAKE], task_ids={LAKE: 0}, **n).close(), {"seed": 3, "num_task_ids": 2}),
    "GymEnv.set_seed": (lambda **n: GymEnv([LAKE]).set_seed(**n), {"seed": 3}),
    "GymTask.make_env": (
        lambda **n: GymTask.make_env([LAKE], task_ids={LAKE: 0}, **n).reset(),
        {"seed": 3, "num_task_ids": 2},
    ),
    "Task.make_env": (lambda **n: Task.make_env([TASK], task_ids={TASK: 0}, **n), {"seed": 3, "num_task_ids": 2}),
    "CTGraphEnv.set_seed": (lambda **n: CTGraphEnv([TASK]).set_seed(**n), {"seed": 3}),
    "make_env": (lambda **n: make_env(LAKES, [LAKE], **n), {"seed": 3}),
    "evaluate a lake": (
        lambda **n: evaluate(lambda data: data.set("action", torch.zeros(len(data), dtype=torch.int64)), [LAKE], **n),
        {"num_episodes": 2, "seed": 3},
    ),
    "CTGraphGymEnv": (lambda **n: CTGraphGymEnv(TASK, task_ids={TASK: 0}, **n), {"num_task_ids": 2}),
    "CTGraphGymEnv.reset": (lambda **n: CTGraphGymEnv(TASK).reset(**n), {"seed": 3}),
    "CTGraphVectorEnv": (
        lambda **n: CTGraphVectorEnv(**{"num_envs": 1} | n, task=TASK, task_ids={TASK: 0}),
        {"num_envs": 2, "num_task_ids": 2},
    ),
    "CTGraphVectorEnv.reset": (lambda **n: CTGraphVectorEnv(1, TASK).reset(**n), {"seed": 3}),
    "curricula.load": (lambda **n: curricula.load("ct2_interfering", **n), {"num_frames": 64}),
}
"""The same for environments and what makes them."""

NOT_MADE_BY_USERS = {"ImageFile", "Trained"}
"""Read from files."""


def is_number(annotation: object) -> bool:
    """Return whether an annotation is that of one number."""
    return str(annotation).split(" | ")[0] in ("int", "float")


def test_each_number_of_each_public_signature_is_tried():
    tried = {(name, number) for name, (_, numbers) in CALLS.items() for number in numbers}
    public = set()
    for name in ctgraph_rl.__all__:
        value = getattr(ctgraph_rl, name)
        shaped = value.__init__ if isclass(value) else value
        if not callable(shaped) or name in NOT_MADE_BY_USERS:
            continue
        public |= {(name, each.name) for each in signature(shaped).parameters.values() if is_number(each.annotation)}

    assert public - tried == set()
    assert len(public) > 40


EACH = [(name, number) for name, (_, numbers) in (CALLS | FACES).items() for number in numbers]


@pytest.mark.parametrize(("name", "number"), EACH)
def test_a_number_may_be_of_numpy_torch_or_decimal_and_is_no_bool(name, number):
    call, numbers = (CALLS | FACES)[name]
    value = numbers[number]
    of_numpy = np.int64(value) if isinstance(value, int) else np.float64(value)

    for other in (of_numpy, np.longdouble(value), np.array(value), torch.tensor(value), Decimal(value)):
        call(**numbers | {number: other})
    for other in (True, np.True_, torch.tensor(True)):
        with pytest.raises(ValueError, match=number):
            call(**numbers | {number: other})
