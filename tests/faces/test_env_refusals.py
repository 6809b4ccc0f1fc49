"""What the batched environment refuses, and what it does unchecked."""

import dataclasses

import pytest
import torch
from helpers.oracles import (
    END,
    FAIL,
    FORKS,
    STATE,
    act,
    confounding,
    one_hot,
    record,
    scripts,
    surjective,
)

from ctgraph_rl import CTGraphEnv, PaperImages
from ctgraph_rl.core.dynamics import OUTCOME_FAIL, OUTCOME_GOAL


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        ([FORKS[0], surjective(2, 3)], "tasks must be in task_pool, got .*name them at construction"),
        ([FORKS[0]], "set_tasks needs one task per row, 2 in all, got 1"),
        ([FORKS[0]] * 3, "set_tasks needs one task per row, 2 in all, got 3"),
        ([], "tasks must be a list with at least one Task, got none"),
    ],
)
def test_set_tasks_refuses_what_does_not_fit(tasks, message):
    env = CTGraphEnv(FORKS[:2], task_pool=FORKS)

    with pytest.raises(ValueError, match=message):
        env.set_tasks(tasks)


def test_a_refused_set_tasks_leaves_the_environment_as_it_was():
    env = CTGraphEnv(FORKS[:2])
    env.reset()

    with pytest.raises(ValueError, match="must be in task_pool"):
        env.set_tasks(FORKS[2:])

    assert env.tasks == tuple(FORKS[:2])
    assert act(env, [0, 0])["step_count"].flatten().tolist() == [1, 1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tasks": []}, "tasks must be a list with at least one Task, got none"),
        ({"task_pool": []}, "task_pool"),
        ({"task_pool": FORKS[1:]}, "tasks must be in task_pool"),
        ({"seed": -1}, r"seed must be an integer in \[0, 2\*\*63\), got -1"),
        ({"seed": 2**63}, r"seed must be an integer in \[0, 2\*\*63\), got 9223372036854775808"),
        ({"seed": 0.5}, r"seed must be an integer in \[0, 2\*\*63\), got 0\.5"),
        ({"first_row": -1}, r"rows must be numbered in \[0, 2\*\*32\), got first_row=-1"),
        ({"first_row": 2**32}, r"rows must be numbered in \[0, 2\*\*32\), got first_row=4294967296"),
    ],
)
def test_constructor_arguments_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        CTGraphEnv(**({"tasks": FORKS[:1]} | arguments))


def test_the_last_row_number_and_the_largest_seed_are_accepted():
    env = CTGraphEnv([confounding(read_noise=5)] * 2, seed=2**63 - 1, first_row=2**32 - 2)

    data = record(env, scripts(20, 2))

    assert not (data[0] == data[1]).all()


@pytest.mark.parametrize(
    "other",
    [dataclasses.replace(surjective(), images=PaperImages(5, size=16)), one_hot()],
    ids=["image sizes", "images and one-hot"],
)
def test_observations_of_different_shapes_are_refused_in_one_batch(other):
    message = "all tasks of a batch must show observations of one shape, got"

    with pytest.raises(ValueError, match=message):
        CTGraphEnv([surjective(), other])
    with pytest.raises(ValueError, match=message):
        CTGraphEnv([surjective()], task_pool=[surjective(), other])


def test_a_step_before_the_first_reset_is_refused():
    env = CTGraphEnv([surjective()] * 2)

    with pytest.raises(ValueError, match=r"rows \[0, 1\] are done: reset them first"):
        act(env, [0, 0])


def test_a_step_of_a_finished_row_is_refused():
    env = CTGraphEnv([surjective()] * 2)
    env.reset()
    act(env, [0, 0])
    act(env, [0, 1])

    with pytest.raises(ValueError, match=r"rows \[1\] are done: reset them first"):
        act(env, [1, 0])


@pytest.mark.parametrize(
    ("action", "got"),
    [
        (torch.tensor([0, 3]), r"got \[3\]"),
        (torch.tensor([-1, 0]), r"got \[-1\]"),
        (torch.tensor([[0], [0]]), r"got shape \[2, 1\]"),
        (torch.tensor([[1, 0, 0], [1, 0, 0]]), r"got shape \[2, 3\]"),
        (torch.tensor([0.0, 1.0]), "got dtype torch.float32"),
        (torch.tensor([0.0, float("nan")]), "got dtype torch.float32"),
        (torch.tensor([0, 1], dtype=torch.int32), "got dtype torch.int32"),
        (torch.tensor([False, True]), "got dtype torch.bool"),
    ],
)
def test_an_action_of_a_wrong_range_shape_or_type_is_refused_and_changes_nothing(action, got):
    env = CTGraphEnv([surjective()] * 2)
    env.reset()
    state = {name: getattr(env.rows, name).clone() for name in STATE}

    with pytest.raises(ValueError, match=r"action must be int64 of shape \[2\] with values in 0\.\.2, " + got):
        act(env, action)

    assert all(torch.equal(getattr(env.rows, name), value) for name, value in state.items())


def test_a_missing_action_is_refused():
    env = CTGraphEnv([surjective()] * 2)
    data = env.reset()

    with pytest.raises(ValueError, match="action"):
        env.step(data)


def test_unchecked_actions_are_trusted_and_fail_as_wrong_actions_do():
    env = CTGraphEnv([surjective()] * 2, check_actions=False)
    env.reset()
    act(env, [0, 0])
    act(env, [0, 0])

    last = act(env, [7, 3])

    assert env.state_type.tolist() == [FAIL, FAIL]
    assert last["outcome"].flatten().tolist() == [OUTCOME_FAIL, OUTCOME_FAIL]


def test_end_and_fail_states_are_absorbing_without_checks():
    env = CTGraphEnv([surjective(2, 1)] * 2, check_actions=False)
    env.reset()
    for action in ([0, 0], [0, 1], [1, 0], [0, 0]):
        act(env, action)

    later = [act(env, [action] * 2) for action in (0, 1, 2)]

    assert env.state_type.tolist() == [END, FAIL]
    assert all(step["done"].all() and not step["reward"].any() for step in later)
    assert [step["outcome"].flatten().tolist() for step in later] == [[OUTCOME_GOAL, OUTCOME_FAIL]] * 3
