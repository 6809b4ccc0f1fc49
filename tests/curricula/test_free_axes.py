"""Curricula of free axes: their blocks, goals, ids and switches, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product

import hydra
import pytest

import curricula
from ctgraph_rl import Block, Evaluation, Task
from ctgraph_rl.tasks.configurations import ct_graph, ct_su_b1
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift
from curricula import axes

A, B, C, D = axes.all_goals(ct_su_b1())


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
    ("arguments", "every"),
    [
        ({}, 25_600),
        ({"num_frames": 2048}, 256),
        ({"num_frames": 1000}, 0),
        ({"num_frames": [2048, 4096, 2048, 2048]}, 0),
        ({"branching_factor": 4, "configuration": "fo_b1"}, 25_600),
        ({"branching_factor": 5, "configuration": "fo_b1"}, 0),
    ],
)
def test_free_axes_evaluate_eight_times_in_a_block_where_these_fit_rows_and_tasks_are_at_most_20(arguments, every):
    assert curricula.from_axes(**arguments).evaluation == Evaluation(every=every)


@pytest.mark.parametrize(("goal_change", "lasts"), [(8, (8, 8)), ([4, 6], (4, 6))])
def test_goals_that_change_begin_in_one_block_and_are_evaluated_for_all_the_episodes_that_they_last(goal_change, lasts):
    built = curricula.from_axes("fo_b1", goal_change=goal_change)

    [block] = built.blocks
    assert [(task.goal, task.goal_change) for task in block.tasks] == [(task.goal, lasts) for task in (A, B, C, D)]
    measured = Evaluation(50 * lasts[0], greedy=False, episodes_per_row=lasts[0], every=25_600)
    assert built.evaluation == measured
    built.evaluation.check(built.tasks)


GRAPH = {"graph_shape": {"d": 3, "b": 2, "p": 0.5}, "reward": {"fail_r": -0.1}, "image_set": {"seed": 3}}


def test_a_json_file_of_a_graph_is_a_curriculum_of_its_goals_on_the_command_line(compose, tmp_path):
    file = tmp_path / "graph.json"
    file.write_text(json.dumps(GRAPH))
    cfg = compose("curriculum=graph", f"curriculum.config={file}", "curriculum.goals=[[1,1,2],[2,1,1]]")

    built = hydra.utils.instantiate(cfg.curriculum)

    assert built.tasks == (Task.from_json(GRAPH, (1, 1, 2)), Task.from_json(GRAPH, (2, 1, 1)))
    assert built == curricula.from_graph(GRAPH, goals=[(1, 1, 2), (2, 1, 1)])


def test_settings_of_a_graph_change_goals_and_waits_and_nothing_else():
    nested = curricula.from_graph(GRAPH, wait_prob=[0, 0.5], goals="nested", seed=2)
    alike = [replace(task, graph=replace(task.graph, wait_prob=0.5)) for task in nested.tasks]
    changing = curricula.from_graph(GRAPH, goal_change=8)

    assert [task.graph.wait_prob for task in nested.tasks] == [0, 0.5]
    assert set(alike) == {Task.from_json(GRAPH, nested.tasks[0].goal)}
    assert len(changing.blocks[0].tasks) == 8
    assert curricula.from_graph(GRAPH, goals="random", num_goals=3).tasks == axes.random_goals(
        Task.from_json(GRAPH, (1, 1, 1)), 3, 0
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "config must be a JSON file of a graph's parameters, such as graph.json, got None"),
        ({"config": 3}, "config must be a JSON file of a graph's parameters, such as graph.json, got 3"),
        ({"config": "none.json"}, "none.json cannot be opened: no such file or directory; check the path"),
        ({"config": {"graph_shape": {"d": 2, "b": 2, "q": 1}}}, "Table 3 has no graph_shape.q"),
        ({"config": GRAPH, "goals": [[1, 2]]}, r"goals must have as many decisions as the depths, \[3\]"),
        ({"config": GRAPH, "order": "random"}, "order must be one of product, interleave, shuffle, reverse, got"),
        ({"config": GRAPH, "wait_prob": 1}, r"wait_prob must be in \[0, 1\), got 1"),
        ({"config": GRAPH, "goal_change": 0}, "goal_change must be a number of episodes >= 1, or the fewest and the"),
        ({"config": GRAPH, "goal_change": [3, 2]}, r"and the most, got \[3, 2\]"),
        ({"config": GRAPH, "goal_change": "x"}, "goal_change must be an integer or a list or null, got 'x'"),
    ],
)
def test_a_graph_that_makes_no_curriculum_is_refused_with_the_rule(arguments, message):
    with pytest.raises(ValueError, match=message):
        curricula.from_graph(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"configuration": "su_b2"}, "unknown configuration 'su_b2': did you mean 'su_b1'"),
        (
            {"goals": "some"},
            r"goals must be one of all, random, nested, or a list such as .1.2,2.1., got 'some'",
        ),
        (
            {"goals": 3},
            r"goals must have as many decisions as the depths, \[2\], and some for each; got 3; write them as",
        ),
        ({"goals": [12], "depth": [2, 3]}, r"got \[12\]; write them as \[1.1,1.1.1\]"),
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
