"""The authors' implementation: its image sets, and its recorded behaviour."""

import numpy as np
import pytest
import torch
from helpers.oracles import act
from helpers.reference_files import DATA, TRACES

from ctgraph_rl import (
    CTGraphEnv,
    PaperImages,
    ReferenceImages,
    ReferenceOneHot,
    Task,
)
from ctgraph_rl.core.rotation import rotate

RECORDED = np.load(DATA / "reference_images.npz")


# Image sets


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_the_image_sets_equal_the_recorded_ones_pixel_by_pixel(seed):
    recorded = RECORDED[f"seed{seed}"]

    images = ReferenceImages(40, seed).images

    assert images.dtype == torch.uint8
    assert np.array_equal(images, recorded)


def test_noise_on_read_lowers_the_levels_of_the_image_set_as_recorded():
    recorded = RECORDED["seed1_noise10"]

    images = ReferenceImages(40, 1, noise=10)

    assert np.array_equal(images.images, recorded)
    assert images.white == 244 == recorded.max()


def test_the_shipped_noise_takes_one_level_off_although_it_adds_nothing():
    images = ReferenceImages(40, 2, noise=0.05)

    plain = ReferenceImages(40, 2).images

    assert (images.white, int(images.images.max()), int(plain.max())) == (253.95, 253, 254)
    assert int((plain.long() - images.images).max()) == 1


def test_the_first_images_of_a_longer_set_are_those_of_the_shorter_one():
    longer = ReferenceImages(100, seed=3).images

    shorter = ReferenceImages(7, seed=3).images

    assert torch.equal(shorter, longer[:7])


def test_an_image_without_black_cells_keeps_to_its_levels_unless_a_pixel_is_fully_outside():
    sets = ReferenceImages(28, seed=5).images, ReferenceImages(539, seed=2).images

    darkest = [int(images[-1].min()) for images in sets]

    assert darkest == [127, 0]  # rotated by 350 and by 61 degrees; as scikit-image 0.26.0 does


def test_a_reference_set_has_one_image_per_id_and_a_bank_of_rotations():
    images = ReferenceImages(5)

    bank = images.bank(2)

    assert (images.num_images, images.num_variants, images.shape, images.size) == (5, 1, (1, 12, 12), 12)
    assert bank.shape == (15, 1, 12, 12)
    assert torch.equal(bank[::3, 0], images.images)


def test_reference_sets_are_equal_and_hashable_by_value():
    sets = {ReferenceImages(5), ReferenceImages(5, 1, 0), ReferenceImages(5, 1, 0.05), ReferenceImages(5, 2)}

    assert len(sets) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_images": 0}, "num_images must be an integer >= 1, got 0"),
        ({"seed": 2**32}, r"image seed must be in \[0, 2\*\*32\), got 4294967296"),
        ({"seed": -1}, r"image seed must be in \[0, 2\*\*32\), got -1"),
        ({"noise": 254.5}, r"noise must be a number in \[0, 254\], got 254.5"),
        ({"noise": -1}, r"noise must be a number in \[0, 254\], got -1"),
        ({"noise": "0"}, r"noise must be a number in \[0, 254\], got '0'"),
    ],
)
def test_values_out_of_range_of_a_reference_set_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ReferenceImages(**{"num_images": 5, **arguments})


def test_the_largest_seed_and_noise_are_accepted():
    images = ReferenceImages(2, seed=2**32 - 1, noise=254)

    assert images.white == 0
    assert int(images.images.max()) == 0


def test_reference_sets_keep_their_repeats_and_the_paper_sets_have_none():
    sets = ReferenceImages(5, noise=254), ReferenceImages(40), PaperImages(40)

    repeats = [len(images.images) - len(images.images.unique(dim=0)) for images in sets]

    assert repeats == [4, 0, 0]


def test_the_reference_one_hot_is_254_at_the_id_and_has_a_last_element_for_the_cue():
    images = ReferenceOneHot(3)

    bank = images.bank(5)

    assert bank.dtype == torch.uint8
    assert bank.tolist() == [[254, 0, 0, 0], [0, 254, 0, 0], [0, 0, 254, 0]]
    assert (images.shape, images.num_variants, images.cue_element, images.white) == ((4,), 1, True, 254)


def test_a_reference_one_hot_without_images_is_refused():
    with pytest.raises(ValueError, match="num_images must be an integer >= 1, got 0"):
        ReferenceOneHot(0)


# Recorded behaviour


@pytest.mark.parametrize("trace", TRACES, ids=[trace["name"] for trace in TRACES])
def test_a_recorded_trace_is_reproduced_exactly(trace):
    goal = tuple(entry + 1 for entry in trace["goal_path_0_based"])
    env = CTGraphEnv([Task.from_json(trace["config"], goal=goal)])

    for first, *steps in trace["episodes"]:
        data = env.reset()
        assert (env.state_type.item(), env.observation_id.item()) == (first["state"], first["id"])
        for number, step in enumerate(steps):
            data = act(env, [step["action"]], data)
            found = data["reward"].item(), data["done"].item(), env.state_type.item(), env.observation_id.item()
            assert found == (float(np.float32(step["reward"])), step["done"], step["state"], step["id"]), number


def test_images_are_rotated_on_read_as_they_were_made():
    images = ReferenceImages(40, seed=3)
    bank = images.bank(9).view(40, 10, 12, 12)

    assert torch.equal(bank[:, 0], images.images)
    for angle in (1, 5, 9):
        ours = rotate(images.images, angle)
        assert (bank[:, angle].int() - ours.int()).abs().max() <= 1  # truncated instead of rounded
        assert not torch.equal(bank[:, angle], ours)


def test_an_image_without_a_black_pixel_is_as_bright_as_its_darkest_level_outside():
    image = ReferenceImages(60, seed=5)

    turned = image.bank(5).view(60, 6, 12, 12)[27, 5]

    assert image.images[27].min() > 0
    assert turned.min() == image.images[27].min()
    assert rotate(image.images[27:28], 5).min() < turned.min()
