"""Evaluations as a part of a curriculum: what is refused, and what makes a fingerprint."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.oracles import surjective
from helpers.scripted import ONE, TWO, Scripted, sequence

import curricula
from ctgraph_rl import Block, Evaluation, RunLog, learn_curriculum
from ctgraph_rl.tasks.curriculum import Protocol
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift

THREE = replace(ONE, goal_reward=3.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes_per_row": 0}, "episodes_per_row must be an integer >= 1, got 0"),
        ({"num_episodes": 10, "episodes_per_row": 4}, "num_episodes=10 must be a multiple of episodes_per_row=4"),
        ({"before": 1}, "before must be true or false, got 1"),
        ({"at_block_ends": None}, "at_block_ends must be true or false, got None"),
        ({"every": -1}, "every must be an integer >= 0, got -1"),
        ({"every": True}, "every must be an integer >= 0, got True"),
        ({"every": 8.5}, "every must be an integer >= 0, got 8.5"),
        ({"tasks": "held_out"}, "tasks must be one of all, seen, got 'held_out'"),
        ({"held_out": "ONE"}, "held_out must be tasks, got 'ONE'"),
        ({"held_out": (ONE, 1)}, "held_out must be tasks, got .*, 1"),
        ({"held_out": (ONE, ONE)}, "held_out tasks must differ"),
        ({"num_episodes": 0, "every": "no"}, "num_episodes must be .*got 0; every must be an integer >= 0, got 'no'"),
    ],
)
def test_an_evaluation_that_cannot_be_done_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Evaluation(**arguments)


@pytest.mark.parametrize(
    "arguments", [{"before": False}, {"before": False, "every": 49}, {"tasks": "seen"}, {"tasks": "seen", "every": 64}]
)
def test_a_curriculum_that_never_evaluates_is_refused(arguments):
    with pytest.raises(ValueError, match="nothing would be evaluated: set before, every or at_block_ends"):
        sequence(Block(ONE, 24), Block(TWO, 24), evaluation=Evaluation(at_block_ends=False, **arguments))


def test_one_held_out_task_is_sugar_for_several():
    assert Evaluation(held_out=ONE) == Evaluation(held_out=(ONE,)) == Evaluation(held_out=[ONE])


def test_held_out_tasks_are_never_trained():
    with pytest.raises(ValueError, match=r"held_out tasks must not be trained, got \[<Task .*goal 2,"):
        sequence(evaluation=Evaluation(held_out=(THREE, TWO)))


def test_held_out_tasks_must_show_observations_of_the_same_shape():
    with pytest.raises(ValueError, match="all tasks of a curriculum must show observations of one shape"):
        sequence(evaluation=Evaluation(held_out=surjective()))


BLOCKS = (Block(ONE, 20), Block(TWO, 28), Block(ONE, 12))


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ({}, {0: "before", 20: "after", 48: "after", 60: "after"}),
        ({"before": False}, {20: "after", 48: "after", 60: "after"}),
        ({"at_block_ends": False}, {0: "before"}),
        (
            {"every": 12},
            {0: "before", 12: "during", 20: "after", 24: "during", 36: "during", 48: "after", 60: "after"},
        ),
        (
            {"every": 12, "before": False, "at_block_ends": False},
            {12: "during", 24: "during", 36: "during", 48: "after", 60: "after"},
        ),
    ],
)
def test_the_moments_of_evaluations(how, expected):
    curriculum = sequence(*BLOCKS, evaluation=Evaluation(**how))

    found = {frames: curriculum.moment(frames) for frames in range(61)}

    assert {frames: moment for frames, moment in found.items() if moment} == expected


def test_frames_are_of_the_block_that_the_last_of_them_was_learned_in():
    curriculum = sequence(*BLOCKS)

    assert curriculum.ends == (20, 48, 60)
    assert [curriculum.block_at(frames) for frames in (0, 1, 20, 21, 48, 49, 60)] == [0, 1, 1, 2, 2, 3, 3]


@pytest.mark.parametrize(("every", "near"), [(6, 4), (10, 8), (3, 4), (1, 4)])
def test_evaluations_between_steps_are_refused_before_any_work(every, near):
    agent, log = Scripted(policy=lambda data: pytest.fail("acted")), RunLog()
    message = f"evaluation.every={every} must be a multiple of num_envs=4, such as {near}"

    with pytest.raises(ValueError, match=message):
        learn_curriculum(sequence(evaluation=Evaluation(every=every)), agent, log=log)

    assert (log.measurements, agent.events) == ([], [])


SWITCHED = (Block(ONE, 8), Block((ONE, TWO), 8, Drift(3)))


@pytest.mark.parametrize(
    "change",
    [
        {"protocol": Protocol("one_hot")},
        {"protocol": Protocol(boundaries="hidden")},
        {"protocol": Protocol("one_hot", num_task_ids=3)},
        {"protocol": Protocol("one_hot", task_ids=(1, 0))},
        {"blocks": (Block(ONE, 8), Block((ONE, TWO), 8))},
        {"blocks": (Block(ONE, 8), Block((ONE, TWO), 8, Drift(4)))},
        {"blocks": (Block(ONE, 8), Block((ONE, TWO), 8, Drift(3, together=True)))},
        {"blocks": (Block(ONE, 8), Block((ONE, TWO), 8, ByEpisode(3)))},
        {"blocks": (Block(ONE, 8), Block((TWO, ONE), 8, Drift(3)))},
        {"blocks": (Block(ONE, 8), Block((ONE, TWO), 8, AtRandom(0.5)))},
        {"evaluation": Evaluation(episodes_per_row=5)},
        {"evaluation": Evaluation(before=False)},
        {"evaluation": Evaluation(every=8)},
        {"evaluation": Evaluation(at_block_ends=False)},
        {"evaluation": Evaluation(tasks="seen")},
        {"evaluation": Evaluation(held_out=THREE)},
    ],
)
def test_a_fingerprint_changes_with_protocol_switch_and_evaluation(change):
    base = sequence(*SWITCHED)

    assert replace(base, **change).fingerprint != base.fingerprint


def test_every_way_of_telling_has_a_fingerprint_of_its_own():
    told = [Protocol(), Protocol("one_hot"), Protocol("at_boundaries"), Protocol("one_hot", "hidden")]

    assert len({sequence(protocol=protocol).fingerprint for protocol in told}) == 4


def test_new_fields_at_their_defaults_are_not_in_a_fingerprint():
    published = curricula.load("su_b1_4tasks")
    written_out = replace(
        published,
        blocks=tuple(Block(block.tasks, block.num_frames, None) for block in published.blocks),
        protocol=Protocol("hidden", "announced", None, None),
        evaluation=Evaluation(100, True, 1, True, 0, True, "all", ()),
    )

    assert published.fingerprint == written_out.fingerprint == "a78b6121f1224f71"
    assert sequence(*SWITCHED).fingerprint != sequence(Block(ONE, 8), Block((ONE, TWO), 8)).fingerprint


def test_equal_curricula_have_equal_fingerprints():
    whole, real = (sequence(Block((ONE, TWO), 8, AtRandom(prob))) for prob in (1, 1.0))

    assert whole == real
    assert whole.fingerprint == real.fingerprint


def test_switches_are_equal_by_value():
    assert AtRandom(1) == AtRandom(1.0)
    assert type(AtRandom(1).prob) is float
    assert len({ByEpisode(), ByEpisode(1, False), ByEpisode(1, True), Drift(1), Drift(1)}) == 3
