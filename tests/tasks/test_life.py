"""Streams: how their tasks are drawn, what they are equal to, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

import curricula
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.life import KEPT
from ctgraph_rl.tasks.similarity import shared_images


def stream(**changes):
    return curricula.load("stream", **{"num_tasks": 40, "num_frames": 64, **changes})


def test_the_first_blocks_do_not_depend_on_the_order_of_asking_or_on_how_many_follow():
    long = stream(num_tasks=100_000)

    last = long.tasks[KEPT * 2]

    assert [*long.tasks[:40]] == [*stream().tasks]
    assert long.tasks[KEPT * 2] == last
    assert long.blocks[3].tasks == (long.tasks[3],)
    made = long.tasks[:9]
    assert [long.tasks.index(task) for task in made] == [*range(9)]


def test_without_a_seed_each_run_draws_a_life_of_its_own_with_one_fingerprint():
    one = stream().for_seed(1)
    two = stream().for_seed(2)
    fixed = stream(seed=1)

    assert [*one.tasks] != [*two.tasks]
    assert one.fingerprint == two.fingerprint != fixed.fingerprint
    assert fixed.for_seed(2) is fixed
    assert [*fixed.tasks] == [*one.tasks]


@pytest.mark.parametrize(
    "change",
    [
        {"order": "returning"},
        {"num_tasks": 41},
        {"num_frames": 128},
        {"seed": 0},
        {"depth": 3},
        {"goals": ["1.1"]},
        {"image_seeds": [1, 2]},
        {"goal_reward": 2.0},
    ],
)
def test_the_fingerprint_is_of_all_that_decides_a_life(change):
    assert stream(**change).fingerprint != stream().fingerprint


@pytest.mark.parametrize(("order", "shared"), [("similar", 1.0), ("dissimilar", 0.0)])
def test_neighbours_share_all_images_if_similar_and_none_if_dissimilar(order, shared):
    tasks = stream(order=order).tasks

    for one, other in pairwise(tasks[:10]):
        assert one != other
        assert shared_images([one, other])[0, 1] == pytest.approx(shared, abs=0.05)


def test_a_share_of_tasks_returns_after_the_lag():
    life = stream(order="returning", share=0.5, lag=3, num_tasks=400)

    returned = [number for number in range(400) if life.trained[number] != (number,)]

    assert all(life.tasks[number] == life.tasks[number - 3] for number in returned)
    assert 150 < len(returned) < 250  # of 397 with probability 1/2: beyond 4.5 standard deviations once in 10**5


def test_drift_changes_one_decision_or_the_image_set():
    tasks = stream(order="drifting", depth=3).tasks

    for one, other in pairwise(tasks):
        decisions = sum(a != b for a, b in zip(one.goal, other.goal, strict=True))
        assert decisions + (one.images != other.images) == 1


def test_json_holds_how_tasks_are_drawn_and_not_the_tasks(tmp_path):
    life = stream(num_tasks=100_000).for_seed(5)

    life.to_json(tmp_path / "life.json")
    again = Curriculum.from_json(tmp_path / "life.json")

    assert (tmp_path / "life.json").stat().st_size < 10_000
    assert isinstance(again, Stream)
    assert again == life
    assert again.tasks[7] == life.tasks[7]


def test_the_first_tasks_are_a_plain_curriculum():
    life = stream()

    plain = life.first(3)

    assert type(plain) is Curriculum
    assert plain.tasks == life.tasks[:3]
    assert Curriculum.from_json(plain.to_json()) == plain


def test_the_present_task_is_evaluated_and_at_a_blocks_end_the_next_and_earlier_ones():
    life = stream(order="returning", share=1.0, lag=20, num_tasks=200)

    def numbers(frames):
        return [number for number, _ in life.evaluated(frames).values()]

    assert numbers(0) == [1]
    assert numbers(8) == [1]
    assert numbers(64) == [1, 2]
    assert numbers(64 * 12) == [12, 13, 11, 2]
    assert numbers(64 * 20) == [20, 1, 19, 10]
    dissimilar = stream(num_tasks=200)
    assert [number for number, _ in dissimilar.evaluated(64 * 150).values()] == [150, 151, 149, 140, 50]
    assert len(dissimilar.evaluated(64 * 200)) == 4  # no task is next
    always = replace(dissimilar, evaluation=replace(dissimilar.evaluation, tasks="all"))
    assert [number for number, _ in always.evaluated(64 * 149 + 8).values()] == [150, 149, 140, 50]
    assert [number for number, _ in always.evaluated(64 * 150).values()] == [150, 151, 149, 140, 50]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"share": 0.0}, r"share must be in \(0, 1\], got 0.0"),
        ({"share": 1.5}, r"share must be in \(0, 1\], got 1.5"),
        ({"num_tasks": 100_001}, "num_tasks must be in 1..100,000, got 100001"),
        (
            {"order": "random"},
            "order must be one of similar, dissimilar, .*, conflicting, got 'random'",
        ),
        ({"order": "returning", "lag": 40}, "lag=40 must be less than num_tasks=40"),
        ({"seed": -1}, r"seed must be an integer in \[0, 2\*\*63\) or null, got -1"),
        ({"image_seeds": 3}, "order=dissimilar needs several generated image sets"),
        ({"order": "similar", "goals": ["1.1"]}, "order=similar needs tasks that differ in more than their images"),
        ({"order": "drifting", "goals": ["1.1", "2.2"]}, "order=drifting needs goals that differ in one decision"),
        ({"goals": "random"}, "goals must be all or a list such as"),
        ({"num_frames": 0}, "num_frames must be an integer >= 1, got 0"),
    ],
)
def test_a_value_out_of_range_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        stream(**changes)


@pytest.mark.parametrize(
    ("evaluation", "message"),
    [
        ({"every": 7}, "evaluation.every=7 must divide num_frames=64"),
    ],
)
def test_an_evaluation_that_a_stream_cannot_have_is_refused(evaluation, message):
    life = stream()

    with pytest.raises(ValueError, match=message):
        replace(life, evaluation=replace(life.evaluation, **evaluation))


def test_ids_for_fewer_tasks_than_the_stream_has_are_refused():
    life = stream()

    with pytest.raises(ValueError, match="num_task_ids=5 is too few for task id 39: needs at least 40"):
        replace(life, protocol=replace(life.protocol, task_id="one_hot", num_task_ids=5))
