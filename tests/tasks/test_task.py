import dataclasses
import math
from itertools import product

import pytest
from helpers.oracles import confounding, fully_observable, one_hot, surjective

from ctgraph_rl import CTGraph, Observations, OneHot, PaperImages, Task

X = Observations(wait_ids=(2, 2), decision_ids=(3, 3), end_ids=(4, 4))


def test_the_goal_leaf_has_the_decisions_as_digits_with_the_first_one_leading():
    task = surjective(b=3, d=3, goal=(3, 1, 2))

    assert task.goal_leaf == 2 * 9 + 0 * 3 + 1


@pytest.mark.parametrize(("b", "d"), [(2, 3), (3, 2), (4, 1)])
def test_goals_in_lexicographic_order_are_the_leaves_in_order(b, d):
    goals = product(range(1, b + 1), repeat=d)

    leaves = [surjective(b, d, goal=goal).goal_leaf for goal in goals]

    assert leaves == list(range(b**d))


def test_the_last_leaf_of_the_deepest_tree_is_exact():
    task = surjective(b=2, d=60, goal=(2,) * 60)

    assert task.goal_leaf == 2**60 - 1


@pytest.mark.parametrize("goal", [(), (1,), (1, 1, 1), (0, 1), (1, 3), (-1, 1), (1, 1.0), (True, 1), "11", 11, None])
def test_a_goal_that_is_not_d_decisions_in_one_to_b_is_refused(goal):
    with pytest.raises(ValueError, match=r"goal must be 2 decisions in 1\.\.2, such as 1\.1, got"):
        Task(CTGraph(2, 2), goal, X, PaperImages(5))


def test_a_list_from_yaml_is_as_good_as_a_tuple():
    x = Observations(wait_ids=[2, 2], decision_ids=[3, 3], end_ids=[4, 4])

    task = Task(CTGraph(2, 2), [2, 1], x, PaperImages(5))

    assert task == Task(CTGraph(2, 2), (2, 1), X, PaperImages(5))
    assert task.goal == (2, 1)


@pytest.mark.parametrize("build", [surjective, fully_observable, confounding, one_hot])
def test_tasks_are_equal_and_hashable_by_value(build):
    tasks = {build(goal=(1, 2)), build(goal=(1, 2)), build(goal=(2, 1)), build(goal=(1, 2), p=0.5)}

    assert len(tasks) == 3
    assert build() == build() and build() is not build()


@pytest.mark.parametrize(
    "change",
    [
        {"goal": (2, 1)},
        {"graph": CTGraph(2, 2, 0.5)},
        {"images": PaperImages(5, seed=2)},
        {"images": PaperImages(6)},
        {"observations": dataclasses.replace(X, read_noise=1)},
        {"goal_reward": 2.0},
        {"fail_reward": -0.1},
    ],
)
def test_tasks_that_differ_in_one_field_are_different(change):
    task = surjective()

    changed = dataclasses.replace(task, **change)

    assert changed != task
    assert dataclasses.replace(changed, **{name: getattr(task, name) for name in change}) == task


def test_a_replaced_field_is_validated():
    with pytest.raises(ValueError, match=r"goal must be 2 decisions in 1\.\.2"):
        dataclasses.replace(surjective(), goal=(1, 2, 1))


def test_a_task_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        surjective().goal = (2, 2)


@pytest.mark.parametrize("name", ["goal_reward", "fail_reward"])
@pytest.mark.parametrize("reward", [math.nan, math.inf, -math.inf, "1", None, True])
def test_a_reward_that_is_not_finite_is_refused(name, reward):
    with pytest.raises(ValueError, match=f"{name} must be a finite number, got {reward!r}"):
        dataclasses.replace(surjective(), **{name: reward})


@pytest.mark.parametrize("name", ["goal_reward", "fail_reward"])
def test_a_reward_that_is_infinite_as_float32_is_refused(name):
    with pytest.raises(ValueError, match=name):
        dataclasses.replace(surjective(), **{name: 1e300})


def test_an_integer_reward_equals_the_float():
    assert dataclasses.replace(surjective(), goal_reward=1, fail_reward=0) == surjective()


@pytest.mark.parametrize("variation", [{"read_noise": 1}, {"read_rotation": 1}])
def test_one_hot_observations_with_variation_on_read_are_refused(variation):
    x = dataclasses.replace(X, **variation)

    with pytest.raises(ValueError, match="read_noise, read_rotation and reward_cue need images"):
        Task(CTGraph(2, 2), (1, 1), x, OneHot(5))


@pytest.mark.parametrize("images", [PaperImages(4), OneHot(4)])
def test_an_image_set_too_small_for_the_ids_is_refused(images):
    message = "num_images=4 is too few for id 4 in observations: needs at least 5"

    with pytest.raises(ValueError, match=message):
        Task(CTGraph(2, 2), (1, 1), X, images)


def test_an_image_set_that_is_just_large_enough_is_accepted():
    task = Task(CTGraph(2, 2), (1, 1), X, OneHot(5))

    assert task.images.num_images == task.observations.last_id + 1 == 5


def test_every_broken_field_of_a_task_is_named_in_one_message():
    with pytest.raises(ValueError, match=r"goal must .*num_images=3 is too few .*goal_reward must .*fail_reward must "):
        Task(CTGraph(2, 2), (1,), X, PaperImages(3), goal_reward=math.nan, fail_reward=math.inf)


def test_the_image_seed_is_that_of_the_image_set_and_none_for_one_hot():
    seeds = [surjective(image_seed=7).image_seed, one_hot().image_seed]

    assert seeds == [7, None]


def test_a_task_is_shown_in_one_short_line():
    task = Task(CTGraph(2, 2, 0.5), (1, 2), surjective().observations, PaperImages(5))

    assert repr(task) == "<Task b=2, d=2, p=0.5, goal 1.2, PaperImages(num_images=5, seed=1, size=12)>"
