"""What is shown: the ids of states, and the image sets that they stand for."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from helpers.oracles import (
    ALPHA,
    DECISION,
    END,
    FAIL,
    HOME,
    WAIT,
    act,
    binomial_p_value,
    confounding,
    fully_observable,
    is_uniform,
    node_numbers,
    optimal,
    surjective,
)

from ctgraph_rl import CTGraph, CTGraphEnv, Observations, OneHot, PaperImages, StateType, Task
from ctgraph_rl.core.rotation import rotate

RANGES = {"wait_ids": (2, 2), "decision_ids": (3, 3), "end_ids": (4, 4)}


def ids_on_the_way(env):
    """Observation ids of every row, from home to an end state, and the states' kinds and nodes."""
    env.reset()
    ids, kinds, nodes = [env.observation_id.clone()], [env.state_type.clone()], [env.node.clone()]
    for _ in range(2 * (env.tasks[0].graph.depth + 1)):
        act(env, optimal(env))
        ids.append(env.observation_id.clone())
        kinds.append(env.state_type.clone())
        nodes.append(env.node.clone())
    return torch.stack(ids), torch.stack(kinds), torch.stack(nodes)


def all_goals(build, b, d):
    return [build(b, d, goal=path) for path in node_numbers(b, d) if len(path) == d]


def test_surjective_observations_show_one_id_per_kind_of_state():
    env = CTGraphEnv(all_goals(surjective, 2, 2))

    ids, kinds, _ = ids_on_the_way(env)

    assert ids[:, 0].tolist() == [0, 2, 3, 2, 3, 2, 4]
    assert torch.equal(ids, torch.tensor([0, 2, 3, 4, 1])[kinds])


def test_fully_observable_ids_count_the_nodes_of_their_kind():
    env = CTGraphEnv([fully_observable(2, 2, goal=(2, 1))])

    ids, kinds, _ = ids_on_the_way(env)

    assert kinds.flatten().tolist() == [HOME, WAIT, DECISION, WAIT, DECISION, WAIT, END]
    assert ids.flatten().tolist() == [0, 2, 9, 4, 11, 7, 14]


@pytest.mark.parametrize(("b", "d"), [(2, 1), (2, 2), (3, 2), (2, 3), (4, 2), (3, 3)])
def test_fully_observable_states_have_an_id_of_their_own(b, d):
    graph = CTGraph(b, d)
    env = CTGraphEnv(all_goals(fully_observable, b, d))

    ids, kinds, nodes = ids_on_the_way(env)

    shown = torch.stack([ids, kinds, nodes], -1).view(-1, 3).unique(dim=0)
    assert shown[:, 0].tolist() == [0, *range(2, graph.num_states)]
    assert (shown[:, 1] == WAIT).sum() == graph.num_wait_states
    assert (shown[:, 1] == DECISION).sum() == graph.num_decision_states
    assert (shown[:, 1] == END).sum() == graph.num_end_states


def test_end_states_are_unique_as_soon_as_waits_or_decisions_are():
    flags = [(False, False), (True, False), (False, True), (True, True)]

    unique_ends = [
        Observations((2, 99), (100, 199), (200, 299), unique_waits=waits, unique_decisions=decisions).unique_ends
        for waits, decisions in flags
    ]

    assert unique_ends == [False, True, True, True]


def test_unique_ends_can_be_chosen_on_their_own():
    x = Observations((2, 2), (3, 3), (4, 7), unique_ends=True)
    env = CTGraphEnv([Task(CTGraph(2, 2), goal, x, OneHot(8)) for goal in ((1, 1), (1, 2), (2, 1), (2, 2))])

    ids, _, _ = ids_on_the_way(env)

    assert ids[-1].tolist() == [4, 5, 6, 7]


@pytest.mark.parametrize(("kind", "step", "first", "last"), [(WAIT, 1, 2, 9), (DECISION, 2, 10, 11), (END, 6, 12, 15)])
def test_confounding_ids_are_uniform_over_their_range_with_both_ends(kind, step, first, last):
    env = CTGraphEnv([confounding()] * 8_000, seed=1)

    ids, kinds, _ = ids_on_the_way(env)

    counts = torch.bincount(ids[step], minlength=16).tolist()
    assert (kinds[step] == kind).all()
    assert sum(counts[first : last + 1]) == 8_000
    assert is_uniform(counts[first : last + 1])


def test_a_confounding_wait_state_draws_an_id_at_every_observation():
    env = CTGraphEnv([confounding(p=0.99)] * 8_000, seed=1)
    env.reset()
    act(env, [0] * 8_000)

    before = env.observation_id.clone()
    act(env, [0] * 8_000)

    stayed = env.state_type == WAIT
    changed = (env.observation_id != before)[stayed].sum().item()
    assert binomial_p_value(stayed.sum().item(), 8_000, 0.99) >= ALPHA
    assert binomial_p_value(changed, stayed.sum().item(), 7 / 8) >= ALPHA


def test_home_and_fail_show_ids_zero_and_one_by_default():
    env = CTGraphEnv([surjective()])

    env.reset()
    home_id = env.observation_id.item()
    act(env, [0])
    act(env, [1])

    assert (home_id, env.observation_id.item(), env.state_type.item()) == (0, 1, FAIL)


def test_home_and_fail_may_have_several_ids():
    x = Observations((6, 6), (7, 7), (8, 8), home_ids=(0, 2), fail_ids=(3, 5))
    env = CTGraphEnv([Task(CTGraph(2, 2), (1, 1), x, OneHot(9))] * 10_000)

    env.reset()
    home_ids = torch.bincount(env.observation_id, minlength=9).tolist()
    act(env, [0] * 10_000)
    act(env, [1] * 10_000)
    fail_ids = torch.bincount(env.observation_id, minlength=9).tolist()

    assert home_ids[3:] == [0] * 6 and is_uniform(home_ids[:3])
    assert fail_ids[:3] == [0] * 3 and is_uniform(fail_ids[3:6])


@pytest.mark.parametrize("value", [(3, 2), (-1, 2), (2,), (2, 3, 4), (2.0, 3), (True, 3), 3, "23", None])
def test_a_range_that_is_not_first_to_last_is_refused(value):
    with pytest.raises(ValueError, match=r"wait_ids must be \(first, last\) with 0 <= first <= last, got "):
        Observations(**(RANGES | {"wait_ids": value}))


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"wait_ids": (2, 3)}, r"decision_ids=\(3, 3\) overlaps wait_ids=\(2, 3\); let it start at 4 or later"),
        ({"end_ids": (3, 3)}, r"end_ids=\(3, 3\) overlaps decision_ids=\(3, 3\); let it start at 4 or later"),
        ({"wait_ids": (0, 0)}, r"_ids=\(0, 0\) overlaps .*_ids=\(0, 0\); let it start at 1 or later"),
        ({"wait_ids": (1, 1)}, r"_ids=\(1, 1\) overlaps .*_ids=\(1, 1\); let it start at 2 or later"),
        ({"fail_ids": (1, 4)}, r"wait_ids=\(2, 2\) overlaps fail_ids=\(1, 4\); let it start at 5 or later"),
        (
            {"wait_ids": (2, 5), "decision_ids": (4, 9), "end_ids": (10, 10)},
            r"decision_ids=\(4, 9\) overlaps wait_ids=\(2, 5\); let it start at 6 or later",
        ),
    ],
)
def test_ranges_that_overlap_are_refused_with_a_place_to_start(ranges, message):
    with pytest.raises(ValueError, match=message):
        Observations(**(RANGES | ranges))


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        ("read_noise", -1, r"read_noise must be an integer in 0\.\.255, got -1"),
        ("read_noise", 256, r"read_noise must be an integer in 0\.\.255, got 256"),
        ("read_noise", 0.05, r"read_noise must be an integer in 0\.\.255, got 0\.05"),
        ("read_rotation", -1, r"read_rotation must be whole degrees in 0\.\.359, got -1"),
        ("read_rotation", 360, r"read_rotation must be whole degrees in 0\.\.359, got 360"),
        ("unique_waits", 1, "unique_waits must be true or false, got 1"),
        ("unique_decisions", "yes", "unique_decisions must be true or false, got 'yes'"),
        ("unique_ends", 0, "unique_ends must be true or false, got 0"),
    ],
)
def test_a_value_out_of_range_is_refused(name, value, rule):
    with pytest.raises(ValueError, match=rule):
        Observations(**RANGES, **{name: value})


@pytest.mark.parametrize(
    ("name", "flag", "message"),
    [
        ("wait_ids", "unique_waits", r"unique_waits needs 7 wait_ids, got 6 in \(10, 15\); use \(10, 16\)"),
        (
            "decision_ids",
            "unique_decisions",
            r"unique_decisions needs 3 decision_ids, got 2 in \(10, 11\); use \(10, 12\)",
        ),
        ("end_ids", "unique_ends", r"unique_ends needs 4 end_ids, got 3 in \(10, 12\); use \(10, 13\)"),
    ],
)
def test_too_few_ids_for_unique_states_are_refused_with_the_range_that_would_do(name, flag, message):
    last = {"wait_ids": 15, "decision_ids": 11, "end_ids": 12}[name]
    x = Observations(**(RANGES | {name: (10, last)}), **{"unique_ends": False} | {flag: True})

    with pytest.raises(ValueError, match=message):
        Task(CTGraph(2, 2), (1, 1), x, PaperImages(40))


def test_more_ids_than_unique_states_need_are_left_over():
    x = Observations((2, 40), (41, 80), (81, 120), unique_waits=True, unique_decisions=True)
    env = CTGraphEnv([Task(CTGraph(2, 2), (2, 2), x, OneHot(121))])

    ids, _, _ = ids_on_the_way(env)

    assert ids.flatten().tolist() == [0, 2, 41, 4, 43, 8, 84]


def test_last_id_is_the_highest_of_all_ranges():
    x = Observations(wait_ids=(20, 29), decision_ids=(2, 3), end_ids=(4, 5))

    assert x.last_id == 29
    assert [x.ids(kind) for kind in StateType] == [(0, 0), (20, 29), (2, 3), (4, 5), (1, 1)]


@pytest.mark.parametrize("size", [4, 12, 16, 84])
def test_paper_images_have_their_size(size):
    images = PaperImages(10, size=size)

    assert images.shape == (1, size, size)
    assert images.images.shape == (10, size, size)
    assert images.images.dtype == torch.uint8


@pytest.mark.parametrize("size", [0, -4, 6, 13, 12.5, True])
def test_a_size_that_is_not_a_multiple_of_four_is_refused(size):
    with pytest.raises(ValueError, match=f"size must be a positive multiple of 4, got {size!r}"):
        PaperImages(5, size=size)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_images": 0}, r"num_images must be in 1\.\.43046721 \(3\*\*16\), got 0"),
        ({"num_images": 3**16 + 1}, r"num_images must be in 1\.\.43046721 \(3\*\*16\), got 43046722"),
        ({"num_images": 5, "seed": -1}, r"image seed must be in \[0, 2\*\*63\), got -1"),
        ({"num_images": 5, "seed": 2**63}, r"image seed must be in \[0, 2\*\*63\), got 9223372036854775808"),
        ({"num_images": 5, "seed": 1.5}, r"image seed must be in \[0, 2\*\*63\), got 1\.5"),
    ],
)
def test_image_sets_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        PaperImages(**arguments)


@pytest.mark.parametrize(("size", "num_images"), [(4, 60_000), (12, 2000)])
def test_no_image_is_there_twice(size, num_images):
    images = PaperImages(num_images, seed=3, size=size).images

    assert len(images.flatten(1).unique(dim=0)) == num_images


def test_a_longer_image_set_begins_with_the_shorter_one():
    short, long = PaperImages(7, seed=5).images, PaperImages(1000, seed=5).images

    assert torch.equal(long[:7], short)


def test_image_seeds_give_different_images():
    sets = [PaperImages(5, seed).images for seed in (0, 1, 2, 2**32, 2**63 - 1)]

    assert len(torch.cat(sets).flatten(1).unique(dim=0)) == 25


def test_a_third_of_the_images_are_blueprints_of_the_levels_0_127_and_254():
    blueprints = PaperImages(3000, seed=1).images.view(-1, 4, 3, 4, 3)

    cells = blueprints[:, :, :1, :, :1]
    plain = (blueprints == cells).flatten(1).all(1)
    levels = torch.bincount(cells[plain].flatten().long(), minlength=256)
    assert is_uniform([plain.sum().item(), (~plain).sum().item() // 2, (~plain).sum().item() // 2])
    assert levels.nonzero().flatten().tolist() == [0, 127, 254]
    assert is_uniform(levels[[0, 127, 254]].tolist())


def test_every_image_is_a_blueprint_turned_by_0_30_or_60_degrees():
    images = PaperImages(30, seed=2, size=84).images

    is_blueprint = torch.stack([_has_flat_cells(rotate(images, -angle)) for angle in (0, 30, 60)])

    assert is_blueprint.any(0).all()
    assert is_blueprint.any(1).all()


def _has_flat_cells(images):
    """Whether the middles of the four central cells show a level each, as an unrotated blueprint does."""
    cells = images.view(-1, 4, 21, 4, 21)[:, 1:3, 3:18, 1:3, 3:18]
    near = torch.stack([(cells.int() - level).abs() <= 2 for level in (0, 127, 254)]).any(0)
    constant = cells.amax((2, 4)).int() - cells.amin((2, 4)).int() <= 2
    return near.flatten(1).all(1) & constant.flatten(1).all(1)


def test_changing_a_returned_image_leaves_the_image_set_as_it_was():
    images = PaperImages(3, seed=4)
    before = images.images.clone()

    CTGraphEnv([dataclasses.replace(surjective(), images=PaperImages(5, seed=4))]).reset()["observation"].fill_(7)

    assert torch.equal(images.images, before)


def test_one_hot_images_are_the_identity():
    assert OneHot(4).bank(0).tolist() == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert OneHot(4).bank(0).dtype == torch.uint8
    with pytest.raises(ValueError, match="num_images must be an integer >= 1, got 0"):
        OneHot(0)
