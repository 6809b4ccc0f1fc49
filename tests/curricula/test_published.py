"""The published sequences: tasks as the labs write them, ids, budgets, environments and evaluation."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
from helpers.lab_files import environment
from helpers.task_families import listing

import curricula
from ctgraph_rl import CTGraph, Observations, Task
from ctgraph_rl.tasks.configurations import ct_graph
from ctgraph_rl.tasks.images import ReferenceImages, ReferenceOneHot
from ctgraph_rl.tasks.protocol import Evaluation, Protocol
from ctgraph_rl.tasks.switch import Drift
from curricula.published import full_mdp, lab_task, labelled, one_wait_image, pool_ids, words

EVERY_5120 = Evaluation(num_episodes=10, greedy=True, every=5120)

LEGACY = {"reward_cue": True, "cue_wraps": True, "legacy_index": True, "noise_before_rotation": True}

CT28 = """1:01 2:11 3:00 4:10 1:010 2:110 3:001 4:100 1:0101 2:1101 3:0010 4:1001 1:01011 2:11010 3:00100 4:10011
    1:010110 2:110101 3:001001 4:100111 1:0101101 2:1101010 3:0010011 4:1001110 1:01011010 2:11010101 3:00100110
    4:10011100"""
CT28_IDS = """1 4095 8184 12278 6 4102 8189 12284 17 4117 8198 12297 39 4146 8216 12323 82 4205 8253 12375 169 4322 8327
    12478 342 4557 8474 12684"""
BLOCKED = """1:01 1:010 1:0101 1:01011 1:010110 1:0101101 1:01011010 2:11 2:110 2:1101 2:11010 2:110101 2:1101010
    2:11010101 3:00 3:001 3:0010 3:00100 3:001001 3:0010011 3:00100110 4:11 4:110 4:1101 4:110111 4:1101110 4:11011100
    4:110111001"""
BLOCKED_IDS = """1 6 17 39 82 169 342 4095 4102 4117 4146 4205 4322 4557 8184 8189 8198 8216 8253 8327 8474 12279 12286
    12301 12391 12510 12748 13225"""
RANDOM = """3:001001 3:0010011 2:11010101 3:00100 1:01011 1:010 3:001 2:1101010 1:01 4:110111 4:11 2:110101 4:110111001
    3:00 1:0101 2:110 4:1101 4:11011100 1:0101101 2:11 2:11010 3:00100110 2:1101 1:010110 4:110 3:0010 4:1101110
    1:01011010"""
RANDOM_IDS = """8253 8327 4557 8216 39 6 8189 4322 1 12391 12279 4205 13225 8184 17 4102 12301 12748 169 4095 4146 8474
    4117 82 12286 8198 12510 342"""
OLD_TURNS = """1:01 2:11 3:00 4:11 1:010 2:110 3:001 4:110 1:0101 2:1101 3:0010 4:1101 1:01011 2:11010 3:00100 4:110111
    1:010110 2:110101 3:001001 4:1101110 1:0101101 2:1101010 3:0010011 4:11011100 1:01011010 2:11010101 3:00100110
    4:110111001"""
OLD_TURNS_IDS = """1 4095 8184 12279 6 4102 8189 12286 17 4117 8198 12301 39 4146 8216 12391 82 4205 8253 12510 169 4322
    8327 12748 342 4557 8474 13225"""
CT14_MD = """1:01 2:11 1:010 2:110 1:0101 2:1101 1:01011 2:11010 1:010110 2:110101 1:0101101 2:1101010 1:01011010
    2:11010101"""
CT10 = "1:01 1:010 1:0101 1:01011 1:010110 1:0101101 1:01011010 1:010110100 1:0101101001 1:01011010010"
CT20 = CT10 + """ 2:11 2:110 2:1101 2:11010 2:110101 2:1101010 2:11010101 2:110101011 2:1101010110 2:11010101101"""
ONE_BRANCH = "9:01 9:010 9:0101 9:01011 9:010110 9:0101101 9:01011010"
CT8_MD = "1:00 1:01 1:000 1:001 1:0000 1:0001 1:00000 1:00001"
CT12 = "1:00 1:000 1:01 1:001 1:10 1:010 1:11 1:011 1:100 1:101 1:110 1:111"


@pytest.mark.parametrize(
    ("name", "goals", "ids", "num_ids", "num_frames"),
    [
        ("ct8", "1:000 1:001 1:010 1:011 1:100 1:101 1:110 1:111", "0 1 2 3 4 5 6 7", 8, 102_400),
        ("ct12", CT12, "0 1 2 3 4 5 6 7 8 9 10 11", 12, 102_400),
        ("ct8_md", CT8_MD, "0 1 4 5 12 13 28 29", 60, 102_400),
        ("ct2_interfering", "1:000 1:111", "0 7", 8, 51_200),
        ("ct28", CT28, CT28_IDS, 16_368, 51_200),
        ("ct28_interleaved_skips_d5", OLD_TURNS, OLD_TURNS_IDS, 16_368, 51_200),
        ("ct28_blocked_skips_d5", BLOCKED, BLOCKED_IDS, 16_368, 51_200),
        ("ct28_random_skips_d5", RANDOM, RANDOM_IDS, 16_368, 51_200),
        ("ct28_mosaic_skips_d5", BLOCKED, BLOCKED_IDS, 16_368, 102_400),
        ("ct28_one_branch", ONE_BRANCH, "1 6 17 39 82 169 342", 16_370, 51_200),
        ("ct10", CT10, "1 6 17 39 82 169 342 688 1381 2766", 16_368, 51_200),
        (
            "ct14_half_1",
            "1:01 1:010 1:0101 1:01011 1:010110 1:0101101 1:01011010",
            "1 6 17 39 82 169 342",
            16_368,
            51_200,
        ),
        (
            "ct14_half_2",
            "2:11 2:110 2:1101 2:11010 2:110101 2:1101010 2:11010101",
            "4095 4102 4117 4146 4205 4322 4557",
            16_368,
            51_200,
        ),
        (
            "ct14_md",
            CT14_MD,
            "1 4095 6 4102 17 4117 39 4146 82 4205 169 4322 342 4557",
            16_368,
            51_200,
        ),
        (
            "ct8_interleaved",
            "1:01 2:11 1:010 2:110 1:0101 2:1101 1:01011 2:11010",
            "1 4095 6 4102 17 4117 39 4146",
            16_368,
            51_200,
        ),
        (
            "ct20",
            CT20,
            "1 6 17 39 82 169 342 688 1381 2766 4095 4102 4117 4146 4205 4322 4557 5027 5966 7845",
            8184,
            102_400,
        ),
    ],
)
def test_a_sequence_has_the_published_tasks_ids_and_budget(name, goals, ids, num_ids, num_frames):
    curriculum = curricula.load(name)

    told = tuple(int(number) for number in ids.split())
    assert listing(curriculum) == goals.split()
    assert curriculum.protocol == Protocol("one_hot", "announced", num_task_ids=num_ids, task_ids=told)
    assert {block.num_frames for block in curriculum.blocks} == {num_frames}
    assert curriculum.version == 1


@pytest.mark.parametrize(
    ("names", "evaluation"),
    [
        (["ct8", "ct12", "ct8_md", "ct2_interfering", "ct28", "ct10", "ct14_md", "ct29_recovery"], EVERY_5120),
        (["ct16", "ct134", "l2d2c_4x4"], Evaluation(num_episodes=25)),
        (["ct28_mosaic_skips_d5"], Evaluation(num_episodes=50)),
        (["ct20", "swoks_2x4", "penn_a_swap"], Evaluation()),
    ],
)
def test_a_sequence_is_evaluated_as_published_as_far_as_that_is_known(names, evaluation):
    assert {curricula.load(name).evaluation for name in names} == {evaluation}


def test_one_task_of_ct8_is_evaluated_twenty_times_while_it_is_learned():
    ct8 = curricula.load("ct8")

    moments = [ct8.moment(frames) for frames in range(0, 102_401, 512)]

    assert (moments[0], moments.count("during"), moments.count("after")) == ("before", 19, 1)


def test_ct29_comes_back_to_its_deepest_task_with_the_same_id():
    ct29 = curricula.load("ct29_recovery")

    family_4 = ["4:10011100", "4:10", "4:100", "4:1001", "4:10011", "4:100111", "4:1001110", "4:10011100"]
    assert len(ct29.blocks) == 29
    assert listing(ct29)[:6] == ["1:01", "2:11", "3:00", "1:010", "2:110", "3:001"]
    assert listing(ct29)[21:] == family_4
    assert len(ct29.tasks) == len(set(ct29.protocol.task_ids)) == 28
    assert ct29.protocol.task_ids[21:] == (12684, 12278, 12284, 12297, 12323, 12375, 12478)
    assert ct29.blocks[21] == ct29.blocks[28]


@pytest.mark.parametrize(
    ("seed_set", "seeds", "num_ids"), [(1, "1234", 16_368), (2, "3456", 16_370), (3, "5678", 16_370)]
)
def test_a_set_of_image_seeds_changes_the_images_and_the_length_of_the_ids(seed_set, seeds, num_ids):
    other = curricula.load("ct28_blocked_skips_d5", seed_set=seed_set)

    expected = [f"{seeds[int(word[0]) - 1]}{word[1:]}" for word in BLOCKED.split()]
    assert listing(other) == expected
    assert other.protocol.num_task_ids == num_ids


def test_the_last_sets_of_image_seeds_have_two_digits():
    assert listing(curricula.load("ct28_mosaic_skips_d5", seed_set=4))[-1] == "10:110111001"
    assert listing(curricula.load("ct28_mosaic_skips_d5", seed_set=5))[0] == "9:01"


@pytest.mark.parametrize(("name", "agent", "word"), [("ct28_mosaic_skips_d5", 24, "4:110111"), ("ct20", 10, "2:11")])
def test_an_agent_alone_has_its_task_with_the_same_id(name, agent, word):
    alone, everything = curricula.load(name, agent=agent), curricula.load(name)

    assert listing(alone) == [word]
    assert alone.protocol.task_ids == (everything.protocol.task_ids[agent],)


def test_ct16_is_four_image_seeds_times_four_goals_in_an_order_for_each_agent():
    first, last = curricula.load("ct16"), curricula.load("ct16", agent=18)

    assert listing(first)[:6] == ["1:00", "1:01", "1:10", "1:11", "2:00", "2:01"]
    assert first.protocol == Protocol("one_hot", num_task_ids=16, task_ids=tuple(range(16)))
    assert first.num_frames == 16 * 51_200
    assert last.protocol.task_ids == (13, 4, 1, 10, 15, 2, 0, 8, 11, 7, 12, 5, 3, 14, 6, 9)
    assert listing(last)[:2] == ["4:01", "2:00"]


@pytest.mark.parametrize("agent", range(19))
def test_every_agent_of_ct16_learns_each_task_once(agent):
    assert sorted(curricula.load("ct16", agent=agent).protocol.task_ids) == list(range(16))


def test_ct134_leaves_out_the_last_two_of_136_tasks():
    ct134 = curricula.load("ct134")

    assert (listing(ct134)[0], listing(ct134)[-2:]) == ("1:00", ["34:00", "34:01"])
    assert ct134.protocol == Protocol("one_hot", num_task_ids=136, task_ids=tuple(range(134)))
    assert ct134.num_frames == 134 * 51_200


def test_swoks_visits_four_goals_in_reverse_twice_and_tells_nobody():
    swoks = curricula.load("swoks_2x4")

    assert listing(swoks) == ["1:11", "1:10", "1:01", "1:00", "1:11", "1:10", "1:01", "1:00"]
    assert swoks.protocol == Protocol(boundaries="hidden")
    assert swoks.num_frames == 8 * 384_000 == 3_072_000
    assert {task.fail_reward for task in swoks.tasks} == {-0.1}
    assert swoks.tasks[0].observations == full_mdp("11", 1).observations


@pytest.mark.parametrize(("depth", "num_frames"), [(2, 256 * 350), (3, 256 * 450)])
def test_penn_a_swaps_one_goal_for_another_unannounced(depth, num_frames):
    swap = curricula.load("penn_a_swap", depth=depth)

    first, second = swap.tasks
    assert first.goal != second.goal
    assert [block.num_frames for block in swap.blocks] == [num_frames, num_frames]
    assert swap.protocol == Protocol(boundaries="hidden")
    assert (first.fail_reward, first.graph, first.images) == (-0.4, CTGraph(2, depth), ReferenceImages(5, 1))
    assert first.observations == Observations((2, 2), (3, 3), (4, 4), **LEGACY)


def test_penn_a_draws_every_pair_of_goals():
    pairs = {tuple(task.goal for task in curricula.load("penn_a_swap", seed=seed).tasks) for seed in range(200)}

    assert len(pairs) == 12


def test_each_life_of_penn_a_has_two_goals_and_a_swap_after_35_to_65_of_100_episodes():
    lives = curricula.load("penn_a_swap", depth=3, num_rows=16, num_lives=100)

    halves = list(zip(lives.blocks[::2], lives.blocks[1::2], strict=True))
    goals = [[(a.goal, b.goal) for a, b in zip(one.tasks, two.tasks, strict=True)] for one, two in halves]
    moments = {one.num_frames / (16 * 9) for one, _ in halves}
    assert {one.num_frames + two.num_frames for one, two in halves} == {16 * 9 * 100}
    assert {min(moments), max(moments)} == {35, 65}
    assert all(len({first for first, _ in pairs}) == 8 for pairs in goals)
    assert all(first != second for pairs in goals for first, second in pairs)
    assert len({pair for pairs in goals for pair in pairs}) == 8 * 7
    assert lives.protocol == Protocol(boundaries="hidden")
    assert [lives.moment(count * 16 * 900) for count in (1, 9, 10)] == [None, None, "after"]
    assert {task.goal_change for task in lives.evaluation.held_out} == {(50, 50)}


@pytest.mark.parametrize(
    ("depth", "episodes", "test_episodes", "bound"),
    [(1, 40, 40, 2_004_000), (2, 40, 40, 2_805_600), (3, 50, 40, 18_018_000), (4, 120, 100, 39_626_400)],
)
def test_goals_of_the_meta_learning_tasks_are_redrawn_after_the_episodes_of_a_task(
    depth, episodes, test_episodes, bound
):
    uniform = curricula.load("nm_uniform_goals", depth=depth)

    (block,) = uniform.blocks
    assert [task.goal for task in block.tasks] == sorted(task.goal for task in block.tasks)
    assert len(block.tasks) == 2**depth
    assert {task.goal_change for task in block.tasks} == {(episodes, episodes)}
    assert {(task.fail_reward, task.images) for task in block.tasks} == {(-0.01, ReferenceOneHot(4 * 2**depth))}
    assert uniform.evaluation == Evaluation(test_episodes, greedy=False, episodes_per_row=test_episodes)
    assert bound <= block.num_frames < bound + 512
    assert block.num_frames % 512 == 0


def test_goals_are_redrawn_on_a_surjective_graph_where_only_the_states_look_alike():
    (full,) = curricula.load("nm_uniform_goals").blocks
    (alike,) = curricula.load("nm_uniform_goals", kind="surjective").blocks

    observations = ct_graph(2, 2, fully_observable=False).observations
    images = ReferenceOneHot(5)
    assert alike.tasks == tuple(replace(task, observations=observations, images=images) for task in full.tasks)


def test_one_wait_image_environments_are_what_the_files_say():
    task = one_wait_image("01", 3)

    ids = {"wait_ids": (2, 2), "decision_ids": (3, 5), "end_ids": (6, 9)}
    x = Observations(**ids, unique_decisions=True, **LEGACY)
    images, more = ReferenceImages(10, 3), {"reward_noise": "multiplicative", "extra_end_step": True}
    assert task == Task(CTGraph(2, 2), (1, 2), x, images, **more)


@pytest.mark.parametrize(
    ("depth", "decision_ids", "end_ids", "num_images"),
    [
        (3, (3, 9), (10, 17), 18),
        (4, (3, 17), (18, 33), 34),
        (5, (3, 33), (34, 65), 66),
        (11, (3, 2049), (2050, 4097), 4098),
    ],
)
def test_deeper_environments_have_the_published_ids(depth, decision_ids, end_ids, num_images):
    task = one_wait_image("0" * depth, 1)

    assert (task.observations.decision_ids, task.observations.end_ids) == (decision_ids, end_ids)
    assert task.images == ReferenceImages(num_images, 1)


@pytest.mark.parametrize(
    ("depth", "wait_ids", "decision_ids", "end_ids"),
    [(2, (2, 8), (9, 11), (12, 15)), (3, (2, 16), (17, 23), (24, 31)), (4, (2, 32), (33, 47), (48, 63))],
)
def test_fully_observable_environments_have_the_published_ids(depth, wait_ids, decision_ids, end_ids):
    task = full_mdp("0" * depth, 34)

    assert task.observations == Observations(
        wait_ids, decision_ids, end_ids, unique_waits=True, unique_decisions=True, **LEGACY
    )
    assert task.images == ReferenceImages(end_ids[1] + 1, 34)


def test_ids_count_the_goals_of_all_environments_before():
    pool = [(1, 2), (1, 3), (2, 2)]

    assert pool_ids(words("1:00 1:11 1:000 1:111 2:00 2:11"), pool) == [0, 3, 4, 11, 12, 15]


def test_two_ids_for_one_task_are_refused():
    task = one_wait_image("01", 1)

    with pytest.raises(ValueError, match=r"a task has one id in a curriculum, but goal1.2 would have 21 and 28"):
        labelled("twice", "here", (task, task), (21, 28), 29, 512)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("ct16", {"agent": 19}, r"agent must be in 0..18, got 19"),
        ("ct20", {"agent": -1}, r"agent must be in 0..19, got -1"),
        ("l2d2c_4x4", {"agent": 5}, r"agent must be in 0..4, got 5"),
        ("ct28_blocked_skips_d5", {"seed_set": 6}, r"seed_set must be one of 1, 2, 3, 4, 5, got 6"),
        ("penn_a_swap", {"depth": 4}, r"depth must be 2 or 3, as published, got 4"),
        ("nm_uniform_goals", {"depth": 5}, r"depth must be in 1..4, got 5"),
        ("nm_uniform_goals", {"kind": "none"}, r"kinds must be some of full, .*, got 'none'"),
        ("penn_a_swap", {"seed": -1}, r"seed must be an integer >= 0, got -1"),
        ("penn_a_swap", {"num_lives": 0}, r"num_lives must be in 1..10000, got 0"),
        ("penn_a_swap", {"num_lives": 2, "num_frames": 9}, r"num_frames is of one life: leave it out with num_lives"),
    ],
)
def test_what_was_not_published_is_refused_with_the_choices(name, arguments, message):
    with pytest.raises(ValueError, match=message):
        curricula.load(name, **arguments)


@pytest.mark.parametrize("name", [name for name in curricula.names() if "ct28" in name])
def test_an_inconsistent_fourth_family_is_said_in_name_and_summary(name):
    depths = sorted({len(task.goal) for task in curricula.load(name).tasks})

    skips = name.endswith("_skips_d5")
    assert depths == [2, 3, 4, 5, 6, 7, 8, 9][: 8 if skips else 7]
    assert ("skips depth 5" in curricula.summary(name)) == skips


def test_the_task_free_protocol_has_the_same_tasks_changed_abruptly_gradually_and_again():
    abrupt, gradual, recurring = (curricula.load(f"task_free_{name}") for name in ("abrupt", "gradual", "recurring"))

    assert abrupt.tasks == gradual.tasks == recurring.tasks == curricula.load("fo_b1_4tasks").tasks
    assert {each.protocol for each in (abrupt, gradual, recurring)} == {Protocol(boundaries="hidden")}
    assert abrupt.trained == ((0,), (1,), (2,), (3,))
    assert gradual.trained == ((0,), (0, 1), (1,), (1, 2), (2,), (2, 3), (3,))
    assert [block.switch for block in gradual.blocks] == [None, Drift(57)] * 3 + [None]  # 102,400 / (256 x 7)
    order = [task for block in recurring.trained for task in block]
    assert sorted(order) == sorted([0, 1, 2, 3] * 3) and all(a != b for a, b in pairwise(order))


def test_tasks_of_the_task_free_protocol_differ_in_goals_in_inputs_or_in_both():
    labels = {how: curricula.load("task_free_abrupt", differ=how).labels for how in ("goals", "inputs", "both")}

    assert labels["goals"] == ("goal1.1", "goal1.2", "goal2.1", "goal2.2")
    assert labels["inputs"] == tuple(f"goal1.1-img{seed}" for seed in (1, 2, 3, 4))
    assert labels["both"] == ("goal1.1-img1", "goal1.2-img2", "goal2.1-img3", "goal2.2-img4")
    with pytest.raises(ValueError, match="differ must be one of goals, inputs, both, got 'images'"):
        curricula.load("task_free_abrupt", differ="images")


@pytest.mark.parametrize("unique", [(True, True), (True, False), (False, False)])
@pytest.mark.parametrize("one_hot", [False, True])
def test_a_task_of_a_lab_is_that_of_its_file(unique, one_hot):
    ids = (2, 8), (9, 11), (12, 15)

    shown = Observations(*ids, unique_decisions=unique[0], unique_waits=unique[1])
    task = lab_task("01", shown, 3, -0.4, one_hot=one_hot)

    file = environment(2, *ids, image_seed=3, fail_reward=-0.4, unique=unique, one_hot=one_hot)
    assert task == Task.from_json(file, "1.2")
