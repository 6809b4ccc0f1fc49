"""Image sets: the paper's, generated ones with a chosen similarity, and a user's own files."""

import hashlib
import math
import os
import re
import shutil

import numpy as np
import pytest
import torch
from helpers.distances import distances

from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.core.rotation import rotate
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import GroupedImages, ImageFile, OneHot, PaperImages
from ctgraph_rl.tasks.images.generated import UNRELATED
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.protocol import Block
from ctgraph_rl.tasks.task import Task

FIVE_IDS = Observations(decision_ids=(2, 2), wait_ids=(3, 3), end_ids=(4, 4))
SQUARE_PER_CELL = (255 + 1) / (6 * (255 - 1))  # E[((x - y) / 254)^2] of two levels uniform over 0..254


def digest(tensor):
    return hashlib.sha256(tensor.contiguous().numpy().tobytes()).hexdigest()[:16]


def fingerprint(images):
    task = Task(CTGraph(2, 2, 0.0), (1, 1), FIVE_IDS, images)
    return Curriculum("name", 1, "source", (Block((task,), 100),)).fingerprint


def save(path, array):
    np.save(path, array)
    return str(path)


def digits(classes=5, instances=3, side=4):
    """Pixel values that tell class, instance and pixel apart."""
    return np.arange(classes * instances * side**2, dtype=np.uint8).reshape(classes, instances, side, side)


def test_the_paper_images_of_a_seed_are_the_same_in_every_version():
    images, rotated = PaperImages(5), PaperImages(7, seed=3, size=20)

    found = digest(images.images), digest(rotated.bank(40))

    assert found == ("18ef4dcc838676cf", "4c3fa8e78a877b41")


@pytest.mark.parametrize("images", [PaperImages(20), GroupedImages((4, 16), 0.1, 0.3)])
def test_no_generated_image_occurs_twice(images):
    flat = images.images.flatten(1)

    different = flat.unique(dim=0)

    assert len(different) == images.num_images == 20


def test_one_hot_and_generated_sets_have_one_image_per_id():
    sets = OneHot(5), PaperImages(5), GroupedImages((2, 3), 0.1, 0.2)

    banks = [images.bank(0) for images in sets]

    assert [images.num_variants for images in sets] == [1, 1, 1]
    assert [list(bank.shape) for bank in banks] == [[5, 5], [5, 1, 12, 12], [5, 1, 12, 12]]


def test_the_rotations_of_an_id_lie_in_a_row_in_the_bank():
    images = PaperImages(300)

    bank = images.bank(2)

    assert bank.shape == (900, 1, 12, 12)
    for angle in range(3):
        assert torch.equal(bank[angle::3, 0], rotate(images.images, angle))


# Files


def test_an_image_file_has_an_id_per_class_and_a_variant_per_instance(tmp_path):
    path = save(tmp_path / "digits.npy", digits())

    images = ImageFile.of(path)

    assert (images.num_images, images.num_variants, images.shape, images.size) == (5, 3, (1, 4, 4), 4)


def test_the_bank_of_a_file_has_instances_and_within_them_rotations_in_a_row(tmp_path):
    array = digits()
    images = ImageFile.of(save(tmp_path / "digits.npy", array))

    bank = images.bank(9)

    assert bank.shape == (5 * 3 * 10, 1, 4, 4)
    instance = torch.from_numpy(array[4, 2])
    assert torch.equal(bank[(4 * 3 + 2) * 10, 0], instance)
    assert torch.equal(bank[(4 * 3 + 2) * 10 + 9, 0], rotate(instance.unsqueeze(0), 9)[0])


def test_an_array_in_column_order_gives_the_same_images(tmp_path):
    rows = ImageFile.of(save(tmp_path / "rows.npy", digits()))
    columns = ImageFile.of(save(tmp_path / "columns.npy", np.asfortranarray(digits())))

    banks = rows.bank(0), columns.bank(0)

    assert torch.equal(*banks)


def test_a_larger_size_repeats_pixels_and_a_smaller_one_averages_blocks_rounding_half_up(tmp_path):
    path = save(tmp_path / "one.npy", np.array([[[[1, 2], [3, 4]]]], dtype=np.uint8))

    larger, smaller = ImageFile.of(path, size=4), ImageFile.of(path, size=1)

    assert larger.images.tolist() == [[[1, 1, 2, 2], [1, 1, 2, 2], [3, 3, 4, 4], [3, 3, 4, 4]]]
    assert smaller.images.tolist() == [[[3]]]  # 2.5
    assert larger.bank(0).shape[1:] == larger.shape == (1, 4, 4)


def test_the_same_content_at_another_path_is_the_same_image_set(tmp_path):
    path = save(tmp_path / "digits.npy", digits())
    copy = shutil.copy(path, tmp_path / "copy.npy")

    first, second = ImageFile.of(path), ImageFile.of(copy, size=4)

    assert first == second
    assert hash(first) == hash(second)
    assert fingerprint(first) == fingerprint(second)


@pytest.mark.parametrize("change", ["content", "size"])
def test_other_content_or_another_size_is_another_image_set(tmp_path, change):
    images = ImageFile.of(save(tmp_path / "digits.npy", digits()))

    other = ImageFile.of(save(tmp_path / "other.npy", digits() + 1)) if change == "content" else None
    other = other or ImageFile.of(images.path, size=8)

    assert other != images
    assert fingerprint(other) != fingerprint(images)


def test_a_wrong_hash_is_refused_with_the_right_one_and_how_to_get_it(tmp_path):
    path = save(tmp_path / "digits.npy", digits())
    right = ImageFile.of(path).sha256

    with pytest.raises(ValueError, match="sha256") as error:
        ImageFile(path, "0" * 64)

    assert right in str(error.value)
    assert f"ImageFile.of({path!r})" in str(error.value)


def test_a_file_that_changed_after_construction_is_not_shown(tmp_path):
    path = save(tmp_path / "digits.npy", digits())
    images = ImageFile.of(path)
    os.utime(save(path, digits() + 1), ns=(0, 0))

    with pytest.raises(ValueError, match=f"must be '{images.sha256}', but the file has"):
        images.bank(0)


@pytest.mark.parametrize(
    ("array", "found"),
    [
        (digits().astype(np.float32), "got float32 [5, 3, 4, 4]"),
        (digits()[0], "got uint8 [3, 4, 4]"),
        (digits()[:, :, 1:], "got uint8 [5, 3, 3, 4]"),
    ],
    ids=["dtype", "ndim", "not square"],
)
def test_an_array_of_another_kind_is_refused(tmp_path, array, found):
    path = save(tmp_path / "wrong.npy", array)

    with pytest.raises(ValueError, match=re.escape(f"must hold a uint8 array [classes, instances, r, r], {found}")):
        ImageFile.of(path)


@pytest.mark.parametrize("content", [b"", b"text", b"\x93NUMPY\x01\x00"], ids=["empty", "text", "cut off"])
def test_a_file_that_is_no_array_is_refused(tmp_path, content):
    path = tmp_path / "wrong.npy"
    path.write_bytes(content)

    with pytest.raises(ValueError, match=r"must be a \.npy file of a uint8 array"):
        ImageFile.of(path)


def test_pickled_objects_and_archives_and_empty_arrays_are_refused(tmp_path):
    objects, archive = save(tmp_path / "objects.npy", np.array([{}], dtype=object)), tmp_path / "several.npy"
    with open(archive, "wb") as file:
        np.savez(file, a=digits())
    none = save(tmp_path / "none.npy", digits()[:, :0])

    for path in (objects, archive, none):
        with pytest.raises(ValueError, match="uint8 array"):
            ImageFile.of(path)


def test_a_missing_file_is_refused(tmp_path):
    path = tmp_path / "none.npy"

    with pytest.raises(ValueError, match=r"path must be an existing \.npy file, got '.*none\.npy'"):
        ImageFile(str(path), "0" * 64)


@pytest.mark.parametrize("size", [0, 3, 6, 2.5])
def test_a_size_that_is_no_multiple_or_divisor_of_the_files_is_refused(tmp_path, size):
    path = save(tmp_path / "digits.npy", digits())

    with pytest.raises(ValueError, match=f"size must be a multiple or a divisor of the file's 4 pixels, got {size}"):
        ImageFile.of(path, size=size)


# Distances


def test_distances_are_means_over_pairs_of_different_images_as_a_share_of_254():
    levels = torch.tensor([0, 254, 127, 254, 0], dtype=torch.uint8)
    images = levels.view(5, 1, 1).expand(5, 2, 2)

    found = distances(images, [0, 0, 1, 1, 1])

    assert found.matrix.tolist() == [[1, 0.5], [0.5, 2 / 3]]
    assert found.within == (1 + 1 / 2 + 1 / 2 + 1) / 4
    assert found.between == 0.5


def test_distances_agree_with_the_definition_on_random_images():
    images = torch.randint(0, 256, (12, 5, 5), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    groups = torch.arange(12) % 3

    found = distances(images, groups.tolist())

    pixels = images.flatten(1).double()
    pair = (pixels.unsqueeze(0) - pixels.unsqueeze(1)).abs().mean(-1) / 254
    other = ~torch.eye(12, dtype=torch.bool)
    same = groups.unsqueeze(0) == groups.unsqueeze(1)
    assert found.within == pytest.approx(pair[same & other].mean().item(), abs=1e-12)
    assert found.between == pytest.approx(pair[~same].mean().item(), abs=1e-12)
    block = pair[groups == 0][:, groups == 2].mean().item()
    assert found.matrix[0, 2].item() == found.matrix[2, 0].item() == pytest.approx(block, abs=1e-12)


def test_a_group_of_one_image_has_no_distance_within():
    images = torch.tensor([0, 127, 127], dtype=torch.uint8).view(3, 1, 1)

    found = distances(images, [0, 1, 1])

    assert math.isnan(found.matrix[0, 0])
    assert found.within == 0
    assert found.between == 0.5


# Generated sets with a chosen similarity


def group_of(images: GroupedImages) -> list[int]:
    """The group of each id."""
    return [group for group, size in enumerate(images.groups) for _ in range(size)]


def test_the_grouped_images_of_a_seed_are_the_same_in_every_version():
    images = GroupedImages((1, 1, 4, 8), within=0.1, between=0.25)

    found = digest(images.images)

    assert found == "75cf7af809b82837"


@pytest.mark.parametrize(("within", "between"), [(0.01, 0.05), (0.05, 0.3), (0.2, 0.2), (UNRELATED, UNRELATED)])
def test_distances_come_out_within_three_standard_errors_of_their_targets(within, between):
    cells = 48
    images = GroupedImages((6, 8, 10), within, between, size=cells, cells=cells)

    found = distances(images.images, group_of(images))

    # A cell's mean over pairs varies no more than one pair's, whose second moment is its share of unlike cells times
    # SQUARE_PER_CELL; cells are independent but for the rounding of shares, which makes their mean vary less.
    for target, value in [(within, found.within), (between, found.between)]:
        standard_error = math.sqrt(target / UNRELATED * SQUARE_PER_CELL - target**2) / cells
        assert abs(value - target) < 3 * standard_error


def test_sixteen_cells_have_the_target_distances_on_average_over_seeds():
    within, between, cells, seeds = 0.041, 0.2, 4, 100

    found = [
        distances(images.images, group_of(images))
        for images in (GroupedImages((3, 3), within, between, seed=seed, size=cells) for seed in range(seeds))
    ]

    for target, values in [(within, [each.within for each in found]), (between, [each.between for each in found])]:
        standard_error = math.sqrt((target / UNRELATED * SQUARE_PER_CELL - target**2) / (seeds * cells**2))
        assert abs(np.mean(values) - target) < 3 * standard_error


def test_a_larger_target_gives_a_larger_distance():
    targets = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)

    within = [distances(GroupedImages((9, 9), t, 0.3, cells=12).images, [0] * 9 + [1] * 9).within for t in targets]
    between = [distances(GroupedImages((9, 9), 0.05, t, cells=12).images, [0] * 9 + [1] * 9).between for t in targets]

    assert within == sorted(within)
    assert between == sorted(between)


def test_ids_follow_the_groups_and_images_of_one_group_are_closer():
    images = GroupedImages((1, 2, 3, 4), within=0.05, between=0.3, cells=12)

    matrix = distances(images.images, group_of(images)).matrix

    others = matrix[~torch.eye(4, dtype=torch.bool)]
    assert matrix.diagonal()[1:].max() < 0.1 < 0.2 < others.min()


def test_longer_groups_begin_with_the_images_of_shorter_ones():
    short, long = GroupedImages((2, 3), 0.05, 0.1), GroupedImages((40, 70), 0.05, 0.1)

    images = long.images

    assert torch.equal(images[[0, 1, 40, 41, 42]], short.images)


def test_as_many_images_as_are_allowed_are_all_different():
    least = UNRELATED * (1 - (1 - 1 / 16) ** 2)

    images = GroupedImages((1016, 1016), least, least).images

    assert len(images.flatten(1).unique(dim=0)) == 2032


def test_each_seed_gives_other_images():
    sets = [GroupedImages((2, 2), 0.1, 0.2, seed=seed).images for seed in (0, 1, 2**32, 2**63 - 1)]

    different = torch.stack(sets).flatten(1).unique(dim=0)

    assert len(different) == 4


def test_lists_and_whole_numbers_are_equal_to_tuples_and_floats():
    given = GroupedImages([2, 3], within=0.1, between=0.2), GroupedImages((2, 3), within=0.1, between=0.2)

    hashes = {hash(images) for images in given}

    assert given[0] == given[1]
    assert len(hashes) == 1
    assert fingerprint(given[0]) == fingerprint(given[1])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"within": 0.01}, r"within must be in [0.04053, 0.33464] for cells=4 (use cells=9 or more), got 0.01"),
        ({"within": 0.34}, "within must be in [0.04053, 0.33464], got 0.34"),
        ({"within": 0.0}, "within must be in [0.04053, 0.33464], got 0.0"),
        ({"between": 0.09}, "between must be in [within, 0.33464], got 0.09"),
        ({"between": 0.5}, "between must be in [within, 0.33464], got 0.5"),
        ({"groups": (700, 1, 1)}, "groups need 2100 images, more than 2032; use more cells"),
        ({"groups": (2, 0)}, "groups must be the numbers of images of each group, >= 1, got (2, 0)"),
        ({"groups": ()}, "groups must be the numbers of images of each group, >= 1, got ()"),
        ({"groups": 5}, "groups must be the numbers of images of each group, >= 1, got 5"),
        ({"cells": 5}, "size must be a positive multiple of 5, got 12"),
        ({"cells": 0}, "cells must be an integer >= 1, got 0"),
        ({"seed": -1}, "image seed must be in [0, 2**63), got -1"),
    ],
)
def test_targets_out_of_reach_and_other_wrong_values_are_refused(fields, message):
    given = {"groups": (2, 3), "within": 0.1, "between": 0.2, **fields}

    with pytest.raises(ValueError, match=re.escape(message)):
        GroupedImages(**given)


def test_the_number_of_cells_that_an_error_proposes_is_the_least_that_works():
    images = GroupedImages((2, 3), within=0.01, between=0.2, size=9, cells=9)

    with pytest.raises(ValueError, match="use cells=9 or more"):
        GroupedImages((2, 3), within=0.01, between=0.2, size=8, cells=8)

    assert images.num_images == 5


def test_a_wrong_number_of_cells_is_not_blamed_on_the_size():
    with pytest.raises(ValueError, match="cells must be an integer >= 1, got 0") as error:
        GroupedImages((2, 3), within=0.1, between=0.2, size=3, cells=0)

    assert "size" not in str(error.value)
