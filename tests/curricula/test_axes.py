"""The axes along which tasks differ, their order, and the curriculum whose axes are plain arguments."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

import curricula
from ctgraph_rl import Block, CTGraph, OneHot, PaperImages, ReferenceImages
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_fo_b2, ct_graph, ct_su_b1
from ctgraph_rl.tasks.protocol import Protocol
from ctgraph_rl.tasks.switch import Drift
from curricula import axes
from curricula.axes import (
    all_goals,
    concatenate,
    cycle,
    given_goals,
    goals_sharing,
    growing_depth,
    image_seeds,
    interleave,
    new_images,
    random_goals,
    random_tasks,
    reshaped,
    reverse,
    sequence,
    shuffle,
    wait_probs,
)

FO, SU, CO, FO2 = ct_fo_b1(), ct_su_b1(), ct_co_b1(), ct_fo_b2()
A, B, C, D = all_goals(SU)


def goals(tasks) -> list[str]:
    return ["".join(map(str, task.goal)) for task in tasks]


def test_all_goals_are_in_lexicographic_order_and_change_nothing_else():
    tasks = all_goals(FO2)

    assert goals(tasks) == ["111", "112", "121", "122", "211", "212", "221", "222"]
    assert {replace(task, goal=FO2.goal) for task in tasks} == {FO2}


def test_given_goals_keep_their_order():
    assert goals(given_goals(SU, [[2, 1], [1, 1], [2, 1]])) == ["21", "11", "21"]


@pytest.mark.parametrize(
    ("num_decisions", "expected"),
    [
        (0, ["111", "112", "121", "122", "211", "212", "221", "222"]),
        (1, ["211", "212", "221", "222"]),
        (2, ["211", "212"]),
        (3, ["212"]),
    ],
)
def test_goals_sharing_begin_as_the_goal_of_the_task(num_decisions, expected):
    assert goals(goals_sharing(replace(FO2, goal=(2, 1, 2)), num_decisions)) == expected


def test_random_goals_differ_and_depend_on_the_seed_alone():
    drawn = random_goals(FO2, 5, seed=3)

    assert goals(drawn) == ["121", "221", "212", "122", "222"]
    assert random_goals(FO2, 5, seed=3) == drawn != random_goals(FO2, 5, seed=4)
    assert sorted(goals(random_goals(FO2, 8, seed=0))) == goals(all_goals(FO2))


def test_random_goals_are_the_same_for_all_images():
    first, second = image_seeds(FO2, (1, 2))

    assert goals(random_goals((first, second), 3, 0)) == goals(random_goals(first, 3, 0)) * 2


def test_no_axis_reads_or_moves_the_global_generator():
    random.seed(5)
    expected = random.random()
    random.seed(5)

    random_goals(FO2, 3, 0), shuffle((A, B), 0), random_tasks(3, 0)

    assert random.random() == expected


def test_image_seeds_change_the_seed_of_any_generated_set():
    paper = image_seeds(SU, range(1, 4))
    reference = image_seeds(replace(SU, images=ReferenceImages(5, 7)), [1, 2])

    assert [task.images for task in paper] == [PaperImages(5, 1), PaperImages(5, 2), PaperImages(5, 3)]
    assert [task.images for task in reference] == [ReferenceImages(5, 1), ReferenceImages(5, 2)]
    with pytest.raises(ValueError, match=r"image seeds need generated images, got OneHot\(num_images=5\)"):
        image_seeds(replace(SU, images=OneHot(5)), [1])


def test_an_image_set_of_fixed_length_is_not_grown():
    (grouped, *_) = curricula.load("stochastic_grouped").tasks

    with pytest.raises(ValueError, match="num_images=50 is too few for id 59 in observations: needs at least 60"):
        new_images(grouped, 2, ["end"])


def test_new_decision_images_leave_wait_images_as_they_are():
    tasks = new_images(FO, 3, ["decision"])

    assert [task.observations.decision_ids for task in tasks] == [(9, 11), (16, 18), (19, 21)]
    assert {(task.observations.wait_ids, task.observations.end_ids) for task in tasks} == {((2, 8), (12, 15))}
    assert {task.images for task in tasks} == {PaperImages(22)}


def test_new_images_of_several_kinds_move_together():
    tasks = new_images(CO, 2, ["wait", "end"])

    x = tasks[1].observations
    assert (x.decision_ids, x.wait_ids, x.end_ids) == ((2, 2), (104, 203), (204, 204))


def test_new_images_of_an_unknown_kind_are_refused():
    with pytest.raises(ValueError, match="kinds must be some of home, fail, wait, decision, end, got ends"):
        new_images(FO, 2, ["ends"])
    with pytest.raises(ValueError, match="num_sets must be an integer >= 1, got 0"):
        new_images(FO, 0)


def test_growing_depth_nests_goals_and_keeps_the_deepest_graph_s_ids():
    deepest = ct_graph(2, 4, goal=(1, 2, 2, 1))

    tasks = growing_depth(deepest, (1, 2, 3, 4))

    assert goals(tasks) == ["1", "12", "122", "1221"]
    assert [task.graph.depth for task in tasks] == [1, 2, 3, 4]
    assert {(task.observations, task.images) for task in tasks} == {(deepest.observations, deepest.images)}
    assert tasks[3] == deepest


@pytest.mark.parametrize("depths", [[0], [5], [2.0]])
def test_a_depth_beyond_the_task_is_refused(depths):
    with pytest.raises(ValueError, match=r"depths must be (in 1..4|a list with at least one int)"):
        growing_depth(ct_graph(2, 4), depths)


def test_wait_probs_change_nothing_else():
    assert [task.graph for task in wait_probs(SU, (0, 0.5))] == [CTGraph(2, 2, 0.0), CTGraph(2, 2, 0.5)]
    with pytest.raises(ValueError, match=r"wait_prob must be in \[0, 1\), got 1"):
        wait_probs(SU, [1])


def test_reshaped_tasks_are_the_paper_s_configurations():
    for kind, expected in (("full", FO), ("surjective", SU), ("confounding", CO)):
        assert reshaped(SU, SU.graph, kind, "1.1") == reshaped(CO, SU.graph, kind, "1.1") == expected
    wide = ct_graph(3, 3)
    assert reshaped(wide, wide.graph, "surjective", wide.goal) == ct_graph(3, 3, fully_observable=False)


def test_unique_decisions_only_leaves_one_wait_image():
    task = reshaped(FO2, FO2.graph, "decisions", FO2.goal)

    x = task.observations
    assert (x.wait_ids, x.decision_ids, x.end_ids) == ((2, 2), (3, 9), (10, 17))
    assert (x.unique_waits, x.unique_decisions, x.unique_ends) == (False, True, True)
    assert task.images == PaperImages(18)


def test_confounding_draws_from_as_many_wait_images_as_asked():
    task = reshaped(SU, SU.graph, "confounding", SU.goal, num_wait_images=7)

    assert (task.observations.wait_ids, task.images) == ((3, 9), PaperImages(11))


def test_an_unknown_observability_is_refused_with_the_choices():
    with pytest.raises(ValueError, match="kinds must be some of full, decisions, surjective, confounding, got 'none'"):
        reshaped(SU, SU.graph, "none", SU.goal)
    with pytest.raises(ValueError, match="num_wait_images must be an integer >= 1, got 0"):
        reshaped(SU, SU.graph, "confounding", SU.goal, 0)


def test_random_tasks_differ_and_depend_on_the_seed_alone():
    drawn = random_tasks(40, seed=1)

    assert len(set(drawn)) == 40
    assert drawn == random_tasks(40, seed=1) != random_tasks(40, seed=2)
    assert {task.graph.branching_factor for task in drawn} == {2, 3}
    assert {task.graph.depth for task in drawn} == {2, 3, 4}
    assert {task.graph.wait_prob for task in drawn} == {0.0, 0.5}


def test_the_first_random_task_is_the_same_on_every_machine():
    (task,) = random_tasks(1, seed=0)

    assert (task.graph, task.goal, task.image_seed) == (CTGraph(3, 4, 0.0), (2, 3, 1, 2), 52)


def test_random_tasks_exhaust_small_choices_and_no_more():
    small = {"branching_factors": [2, 2], "depths": [2], "wait_probs": [0.0], "image_seeds": [1, 2]}

    assert len(set(random_tasks(8, 0, **small))) == 8
    with pytest.raises(ValueError, match=r"num_tasks must be in 1..8, as many as differ, got 9"):
        random_tasks(9, 0, **small)
    with pytest.raises(ValueError, match="need at least one choice each"):
        random_tasks(1, 0, depths=())


def test_sequences_are_put_in_order():
    assert concatenate((A, B), C, [D]) == (A, B, C, D)
    assert interleave((A, B, C), D) == (A, D, B, C)
    assert interleave((A, B), (C, D)) == (A, C, B, D)
    assert cycle((A, B), 2) == (A, B, A, B)
    assert reverse((A, B, C)) == (C, B, A)


def test_a_shuffle_is_a_permutation_that_the_seed_decides():
    everything = all_goals(FO2)

    assert goals(shuffle(everything, 0)) == ["111", "122", "211", "222", "112", "121", "212", "221"]
    assert set(shuffle(everything, 1)) == set(everything)
    orders = {tuple(goals(shuffle((A, B, C), seed))) for seed in range(60)}
    assert len(orders) == 6


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: all_goals("su_b1"), "tasks must be a list with at least one Task, got str"),
        (lambda: all_goals(()), "tasks must be a list with at least one Task, got none"),
        (
            lambda: all_goals(ct_graph(2, 17)),
            "^a curriculum has at most 10,000 tasks, here are more: curriculum.goals=",
        ),
        (lambda: given_goals(SU, [(1, 1, 1)]), r"goal must be 2 decisions in 1..2, such as 1\.1, got \(1, 1, 1\)"),
        (lambda: given_goals(SU, "all"), r"goals must be a list of goals such as \[1\.2, 2\.1\], got 'all'"),
        (lambda: given_goals(SU, []), r"goals must be a list of goals such as .*, got \[\]"),
        (lambda: goals_sharing(SU, 3), r"num_decisions must be in 0..2, the depth, got 3"),
        (lambda: random_goals(SU, 5, 0), r"num_goals must be in 1..4, as many as differ, got 5"),
        (lambda: random_goals(SU, 2, None), "seed must be an integer >= 0, got None"),
        (lambda: shuffle((A, B), -1), "seed must be an integer >= 0, got -1"),
        (lambda: cycle((A, B), 0), "times must be an integer >= 1, got 0"),
        (lambda: image_seeds(SU, []), "seeds must be a list with at least one int, got none"),
        (lambda: sequence("mine", (A, B), (1, 2, 3)), "num_frames must be one for each of 2 blocks, got 3"),
        (lambda: sequence("mine", (A, B), 0), "num_frames must be an integer >= 1, got 0"),
    ],
)
def test_what_makes_no_sense_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_sequence_has_a_block_for_each_item():
    told = Protocol("one_hot")

    mine = sequence("mine", [A, (B, C)], [64, 128], version=2, source="here", protocol=told, switch=None)

    assert mine.blocks == (Block(A, 64), Block((B, C), 128))
    assert (mine.name, mine.version, mine.source, mine.protocol) == ("mine", 2, "here", told)
    assert sequence("mine", A, 64).blocks == (Block(A, 64),)
    assert sequence("mine", [(A, B)], 64, switch=Drift(5)).blocks == (Block((A, B), 64, Drift(5)),)


def test_curricula_sequence_is_the_one_of_axes():
    assert curricula.sequence is axes.sequence
