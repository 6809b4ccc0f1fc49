"""Curricula of free axes: their blocks, goals, ids and switches, and what is refused."""

from __future__ import annotations

from itertools import product

import hydra
import pytest

import curricula
from ctgraph_rl import Block
from ctgraph_rl.tasks.configurations import ct_graph, ct_su_b1
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift
from curricula.axes import (
    all_goals,
)

A, B, C, D = all_goals(ct_su_b1())


def goals(tasks) -> list[str]:
    return ["".join(map(str, task.goal)) for task in tasks]


def test_free_axes_build_a_named_curriculum_s_blocks(compose):
    cfg = compose("curriculum=axes", "curriculum.configuration=fo_b2", "curriculum.num_frames=[1,2,3,4,5,6,7,8]")

    built = hydra.utils.instantiate(cfg.curriculum)

    assert built.tasks == curricula.load("fo_b2_8tasks").tasks
    assert [block.num_frames for block in built.blocks] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert built.name == "axes"


def test_axes_are_set_on_the_command_line(compose):
    cfg = compose(
        "curriculum=axes",
        "curriculum.configuration=fo_b1",
        "curriculum.image_seeds=[1,2]",
        "curriculum.goals=[[2,1],[1,2]]",
        "curriculum.order=interleave",
    )

    built = hydra.utils.instantiate(cfg.curriculum)

    assert built.labels == ("goal2.1-img1", "goal2.1-img2", "goal1.2-img1", "goal1.2-img2")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"depth": [1, 2], "goals": "nested"}, ["2", "22"]),
        ({"depth": [1, 2]}, ["1", "2", "11", "12", "21", "22"]),
        ({"depth": [1, 2], "order": "interleave"}, ["1", "11", "2", "12", "21", "22"]),
        ({"depth": [1, 2], "goals": [[2], [1, 2]]}, ["2", "12"]),
        ({"order": "reverse"}, ["22", "21", "12", "11"]),
        ({"order": "shuffle", "seed": 1}, ["22", "12", "21", "11"]),
        ({"goals": "random", "num_goals": 2, "repeats": 2}, ["22", "11", "22", "11"]),
        ({"branching_factor": 3, "depth": 1}, ["1", "2", "3"]),
        ({"random_graphs": 3, "depth": [1, 2], "branching_factor": [2, 3]}, ["23", "1", "33"]),
    ],
)
def test_free_axes_give_the_goals_in_order(arguments, expected):
    built = curricula.from_axes(**arguments)

    assert goals(block.tasks[0] for block in built.blocks) == expected


def test_free_axes_use_the_ids_of_the_deepest_graph():
    built = curricula.from_axes("fo_b1", depth=[2, 4], goals="nested", wait_prob=[0, 0.5])

    assert {task.observations for task in built.tasks} == {ct_graph(2, 4).observations}
    assert [(task.graph.wait_prob, task.graph.depth) for task in built.tasks] == [(0, 2), (0, 4), (0.5, 2), (0.5, 4)]


def test_free_axes_read_images_with_noise_and_rotation():
    built = curricula.from_axes("co_b1", read_noise=10, read_rotation=5)

    assert built.tasks == curricula.load("co_b1_instances").tasks


def test_random_graphs_of_free_axes_are_drawn_from_all_that_is_listed():
    built = curricula.from_axes("su_b1", depth=[2, 3], wait_prob=[0, 0.5], image_seeds=[1, 2], random_graphs=44)

    drawn = {(task.graph.depth, task.graph.wait_prob, task.image_seed) for task in built.tasks}
    assert drawn == set(product((2, 3), (0, 0.5), (1, 2)))
    assert (
        built.tasks
        == curricula.from_axes("su_b1", depth=[2, 3], wait_prob=[0, 0.5], image_seeds=[1, 2], random_graphs=44).tasks
    )


@pytest.mark.parametrize(
    ("switch", "expected"),
    [("by_episode", ByEpisode(50)), ("at_random", AtRandom(0.02)), ("drift", Drift(50))],
)
def test_a_switch_makes_one_block_of_all_tasks(switch, expected):
    built = curricula.from_axes("su_b1", switch=switch, switch_episodes=50, num_frames=512)

    assert built.blocks == (Block((A, B, C, D), 512, expected),)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"configuration": "su_b2"}, "unknown configuration 'su_b2': did you mean 'su_b1'"),
        ({"goals": "some"}, "goals must be one of all, random, nested, or a list of goals, got 'some'"),
        ({"goals": 3}, "goals must be a text or a list, got 3"),
        ({"goals": [[1, 1, 1]]}, r"goals must have as many decisions as the depths, \[2\], and some for each"),
        ({"goals": [[1, 1]], "depth": [2, 3]}, r"goals must have as many decisions as the depths, \[2, 3\]"),
        ({"goals": [[1, 3]]}, r"goal must be 2 decisions in 1..2"),
        ({"order": "random"}, "order must be one of product, interleave, shuffle, reverse, got 'random'"),
        ({"depth": 0}, "depth must be an integer >= 1 or a list of them, got 0"),
        ({"depth": []}, r"depth must be an integer >= 1 or a list of them, got \[\]"),
        ({"branching_factor": 1}, "branching_factor must be an integer >= 2, got 1"),
        ({"wait_prob": 1.0}, r"wait_prob must be in \[0, 1\), got 1.0"),
        ({"image_seeds": "a"}, "image_seeds must be an integer or a list, got 'a'"),
        ({"repeats": 0}, "repeats must be an integer >= 1, got 0"),
        ({"goals": "random", "num_goals": 5}, r"num_goals must be in 1..4"),
        ({"num_frames": 0}, "num_frames must be an integer >= 1, got 0"),
        ({"switch": "slow"}, "switch must be one of by_episode, at_random, drift, or null, got 'slow'"),
        ({"switch": "drift", "switch_episodes": 0}, "switch_episodes must be an integer >= 1, got 0"),
        ({"read_noise": 256}, r"read_noise must be an integer in 0..255, got 256"),
        ({"read_rotation": 2.5}, "read_rotation must be an integer, got 2.5"),
        ({"random_graphs": 0}, r"num_tasks must be in 1..4, as many as differ, got 0"),
        ({"random_graphs": 2, "goals": "random"}, "random_graphs draws goals and order: leave both out, got goals='ra"),
        ({"configuration": "fo_b1", "depth": 30, "goals": "nested"}, "num_images must be in 1..43046721"),
    ],
)
def test_free_axes_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        curricula.from_axes(**arguments)
