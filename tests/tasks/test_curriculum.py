"""Block, Evaluation and Curriculum."""

from __future__ import annotations

from dataclasses import replace

import pytest

import curricula
from ctgraph_rl import Block, Curriculum, Evaluation, PaperImages
from curricula.paper import ct_su_b1

A, B, C, D = (ct_su_b1(goal) for goal in ((1, 1), (1, 2), (2, 1), (2, 2)))


def curriculum(*blocks: Block) -> Curriculum:
    return Curriculum("mine", 1, "here", blocks or (Block(A, 64), Block(B, 64)))


def test_one_task_is_sugar_for_a_block_of_many():
    block = Block(A, 64)

    assert block == Block((A,), 64) == Block([A], 64)
    assert block.tasks == (A,)


@pytest.mark.parametrize(
    ("tasks", "num_frames", "message"),
    [
        ((), 64, r"a block needs at least one Task and nothing else, got \(\)"),
        (("A",), 64, r"a block needs at least one Task and nothing else, got \('A',\); a task is a Task, .* make_env"),
        (A, 0, "num_frames must be an integer >= 1, got 0"),
        (A, -64, "num_frames must be an integer >= 1, got -64"),
        (A, 64.5, "num_frames must be an integer >= 1, got 64.5"),
        (A, True, "num_frames must be an integer >= 1, got True"),
    ],
)
def test_a_block_without_tasks_or_frames_is_refused(tasks, num_frames, message):
    with pytest.raises(ValueError, match=message):
        Block(tasks, num_frames)


def test_a_block_names_every_broken_rule_at_once():
    with pytest.raises(ValueError, match=r"at least one Task.*; num_frames must be"):
        Block((), 0)


def test_tasks_of_a_block_share_the_rows_equally():
    block = Block((A, B, C), 60)

    rows = block.rows(6)

    assert rows == [A, B, C, A, B, C]
    with pytest.raises(ValueError, match="num_envs=8 must be a multiple of the block's 3 tasks"):
        block.rows(8)


@pytest.mark.parametrize(
    ("num_frames", "holds", "nearest"),
    [(128, True, "128 or 192"), (100, False, "64 or 128"), (130, False, "128 or 192"), (10, False, "64")],
)
def test_frames_must_be_whole_steps_of_all_rows_and_the_nearest_numbers_are_named(num_frames, holds, nearest):
    rule, message = Block(A, num_frames).frame_rule(64, "block 2")

    assert rule is holds
    assert message == f"num_frames={num_frames} of block 2 must be a multiple of num_envs=64; nearest: {nearest}"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": ""}, "a curriculum needs a name"),
        ({"version": 0}, "version must be an integer >= 1, got 0"),
        ({"blocks": ()}, "at least one Block and nothing else"),
        ({"blocks": (A,)}, "at least one Block and nothing else"),
    ],
)
def test_a_curriculum_without_name_version_or_blocks_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(curriculum(), **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_episodes": 0}, "num_episodes must be an integer >= 1, got 0"),
        ({"greedy": 1}, "greedy must be true or false, got 1"),
    ],
)
def test_an_evaluation_out_of_range_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Evaluation(**change)


def test_tasks_are_the_different_ones_in_order_of_first_appearance():
    repeated = curriculum(Block(B, 10), Block((A, B), 20), Block(C, 30), Block(A, 40))

    assert repeated.tasks == (B, A, C)
    assert repeated.num_frames == 100
    assert repeated.trained == ((0,), (1, 0), (2,), (1,))


def test_a_task_twice_in_one_block_is_trained_once():
    twice = curriculum(Block((A, A, B), 12))

    assert twice.tasks == (A, B)
    assert twice.trained == ((0, 1),)
    assert twice.blocks[0].rows(6) == [A, A, B, A, A, B]


def test_labels_show_the_goal_and_whatever_else_differs():
    other_images = replace(A, images=PaperImages(num_images=5, seed=2))
    waiting = replace(A, graph=replace(A.graph, wait_prob=0.5))

    assert curriculum(Block(A, 1), Block(D, 1)).labels == ("goal1.1", "goal2.2")
    assert curriculum(Block(A, 1), Block(other_images, 1)).labels == ("goal1.1-img1", "goal1.1-img2")
    assert curriculum(Block(A, 1), Block(waiting, 1)).labels == ("goal1.1-p0", "goal1.1-p0.5")


def test_labels_are_different_even_where_the_named_parts_are_equal():
    rewards = [replace(A, goal_reward=reward) for reward in (1.0, 2.0, 3.0)]

    labels = curriculum(*(Block(task, 1) for task in rewards)).labels

    assert labels == ("goal1.1", "goal1.1#2", "goal1.1#3")


def test_curricula_are_equal_and_hashable_by_value():
    first, second = curricula.su_b1_4tasks(), curricula.su_b1_4tasks()

    assert first is not second
    assert first == second
    assert len({first, second, curricula.su_b1_4tasks(num_frames=64)}) == 2


def test_a_fingerprint_ignores_name_and_source():
    base = curriculum()

    assert replace(base, name="other", source="elsewhere").fingerprint == base.fingerprint


@pytest.mark.parametrize(
    "change",
    [
        {"version": 2},
        {"blocks": (Block(A, 64), Block(B, 128))},
        {"blocks": (Block(A, 64), Block(C, 64))},
        {"blocks": (Block(B, 64), Block(A, 64))},
        {"blocks": (Block((A, B), 128),)},
        {"blocks": (Block(A, 64), Block(replace(B, images=PaperImages(num_images=5, seed=2)), 64))},
        {"blocks": (Block(A, 64), Block(replace(B, goal_reward=2), 64))},
        {"blocks": (Block(A, 64), Block(replace(B, graph=replace(B.graph, wait_prob=0.5)), 64))},
        {"blocks": (Block(A, 64), Block(replace(B, observations=replace(B.observations, read_noise=1)), 64))},
        {"evaluation": Evaluation(num_episodes=10)},
        {"evaluation": Evaluation(greedy=False)},
    ],
)
def test_a_fingerprint_changes_with_everything_that_changes_results(change):
    base = curriculum()

    assert replace(base, **change).fingerprint != base.fingerprint


class Half:
    """A reward that is no dataclass."""

    def __call__(self, leaf, goal_leaf, graph):
        return 0.5 * (leaf == goal_leaf)


def test_a_fingerprint_of_a_part_that_is_no_dataclass_is_refused_with_what_to_write():
    own = curriculum(Block(replace(A, reward_fn=Half()), 64))

    with pytest.raises(ValueError, match=r"must be dataclasses or plain values, got .*Half.*: put @dataclass\(frozen="):
        _ = own.fingerprint


def test_a_value_written_out_that_is_the_default_leaves_the_fingerprint():
    base = curriculum()

    same = replace(base, evaluation=Evaluation(num_episodes=100, greedy=True))

    assert same.fingerprint == base.fingerprint


def test_a_curriculum_is_shown_in_one_line():
    shown = replace(curriculum(Block((A, B), 20), Block(C, 3000)), name="a\n<b>", source="<i>")

    assert repr(shown) == r"<Curriculum 'a\n<b>', version 1, tasks: 3, blocks: 2, frames: 3,020>"
