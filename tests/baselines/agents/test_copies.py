"""A copy of a learner is equal to it and independent of it, also in the middle of what it learns."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import pytest
import torch
from helpers.kill_runs import equal
from helpers.small_agents import CHOICES, learner_of, name_of, others_slow, saved_and_loaded

from ctgraph_rl.learn.collect import collect, make_env

COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": deepcopy,
    "pickle": lambda learner: pickle.loads(pickle.dumps(learner)),
}

METHODS = [("dqn", {"method": method}) for method in ("ewc", "mask_ri", "packnet", "scratch", "cka_rl")]


def collected(learner: Any, curriculum: Any, seed: int) -> list[Any]:
    """Two batches of a task."""
    torch.manual_seed(seed)
    env = make_env(curriculum, [curriculum.tasks[seed % 2]] * learner.num_envs, seed)
    frames = 2 * learner.num_envs * learner.num_steps
    return list(collect(env, learner.policy, frames, learner.num_steps, learner.initial_state))


def learned(learner: Any, task: int, batches: list[Any]) -> list[dict[str, float]]:
    """What is measured of a block."""
    torch.manual_seed(task)
    learner.start_task(task)
    measured = [learner.learn(batch.clone()) for batch in batches]
    learner.end_task()
    return measured


@pytest.mark.parametrize(
    ("choice", "how"),
    others_slow(
        [(choice, list(COPIES)[number % 2]) for number, choice in enumerate((*CHOICES, *METHODS))],
        (("dqn", {}), "deepcopy"),
        (("drqn", {}), "deepcopy"),
    ),
    ids=name_of,
)
def test_a_copy_of_a_learner_learns_the_same_and_leaves_the_learner_as_it_was(compose, choice, how):
    learner, curriculum = learner_of(compose, *choice)
    learned(learner, 0, collected(learner, curriculum, 0))
    batches = collected(learner, curriculum, 1)

    copied = COPIES[how](learner)
    before = saved_and_loaded(learner.state_dict())
    of_copy = learned(copied, 1, batches), collected(copied, curriculum, 2)

    assert equal(saved_and_loaded(learner.state_dict()), before)
    of_learner = learned(learner, 1, batches), collected(learner, curriculum, 2)
    assert equal(of_copy[0], of_learner[0])
    assert all(
        equal(*map(dict, (one.items(True, True), other.items(True, True))))
        for one, other in zip(of_copy[1], of_learner[1], strict=True)
    )
    assert equal(saved_and_loaded(learner.state_dict()), saved_and_loaded(copied.state_dict()))
