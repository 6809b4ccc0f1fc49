"""Rotation and noise on read, and the bank of turned images."""

from __future__ import annotations

import cmath
import dataclasses
import math
from dataclasses import dataclass
from itertools import product

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
    is_uniform,
    surjective,
)

from ctgraph_rl import CTGraph, CTGraphEnv, Observations, OneHot, PaperImages, StateType, Task
from ctgraph_rl.core.reading import noise_bank
from ctgraph_rl.core.rotation import rotate


@dataclass(frozen=True)
class Black:
    """A user's own image set: black images."""

    num_images: int = 5
    num_variants: int = 1
    shape: tuple[int, ...] = (1, 8, 8)

    def bank(self, read_rotation):
        return torch.zeros(self.num_images * (read_rotation + 1), *self.shape, dtype=torch.uint8)


@pytest.mark.parametrize("size", [4, 12, 16, 84])
@pytest.mark.parametrize("quarters", [0, 1, 2, 3, 4, 5])
def test_quarter_turns_are_exact(size, quarters):
    images = PaperImages(6, size=size).images

    turned = rotate(images, 90 * quarters)

    assert torch.equal(turned, torch.rot90(images, quarters, dims=(1, 2)))


@pytest.mark.parametrize("degrees", [1, 30, 45, 60, 137, 300])
def test_rotation_is_counter_clockwise_bilinear_and_rounded(degrees):
    images = PaperImages(4, size=8).images
    pixels = list(product(range(8), repeat=2))
    expected = [[bilinear(image, degrees, *pixel) for pixel in pixels] for image in images.tolist()]

    turned = rotate(images, degrees)

    assert (turned.flatten(1) - torch.tensor(expected)).abs().max() <= 0.51


def bilinear(image, degrees, y, x):
    """The value of one pixel of a rotated image, in plain Python; black outside."""
    middle, turn = (len(image) - 1) / 2, cmath.rect(1, math.radians(degrees))
    source = complex(x - middle, y - middle) * turn + complex(middle, middle)
    value = 0.0
    for row, column in product(range(len(image)), repeat=2):
        value += max(0, 1 - abs(source.imag - row)) * max(0, 1 - abs(source.real - column)) * image[row][column]
    return value


@pytest.mark.parametrize("degrees", [1, 37, 90, 200])
def test_rotation_wraps_at_a_full_turn(degrees):
    images = PaperImages(6).images

    assert torch.equal(rotate(images, degrees + 360), rotate(images, degrees))


def test_rotation_keeps_a_uniform_disc_and_leaves_black_outside():
    images = torch.full((1, 12, 12), 254, dtype=torch.uint8)

    turned = rotate(images, 45)

    assert (turned[0, 2:10, 2:10] == 254).all()
    assert turned[0, [0, 0, -1, -1], [0, -1, 0, -1]].tolist() == [0, 0, 0, 0]


def test_the_bank_holds_all_rotations_of_an_image_in_a_row():
    images = PaperImages(3, seed=1)

    bank = images.bank(read_rotation=2)

    assert bank.shape == (9, 1, 12, 12)
    assert torch.equal(bank[3:6, 0], torch.cat([rotate(images.images[1:2], angle) for angle in (0, 1, 2)]))


def test_read_noise_is_a_uniform_addition_of_zero_to_n_per_pixel():
    task = dataclasses.replace(surjective(read_noise=3), images=Black())

    observations = CTGraphEnv([task] * 2000, seed=1).reset()["observation"]

    assert observations.unique().tolist() == [0, 1, 2, 3]
    assert is_uniform(torch.bincount(observations.flatten()).tolist())
    assert len(observations.flatten(1).unique(dim=0)) == 2000


def test_read_noise_saturates_at_white():
    task = surjective(read_noise=255)

    observations = CTGraphEnv([task] * 500, seed=1).reset()["observation"].int()

    base = task.images.images[0].int()
    assert (observations >= base).all()
    assert observations[..., base == 254].unique().tolist() == [254, 255]
    assert observations[..., base == 0].unique().tolist() == list(range(256))


def test_the_noise_of_neighbouring_pixels_rows_and_steps_is_independent():
    env = CTGraphEnv([dataclasses.replace(surjective(read_noise=1), images=Black())] * 20_000, seed=2)

    first = env.reset()["observation"][:, 0]
    second = env.reset()["observation"][:, 0]

    pairs = [(first[:, 0, 0], first[:, 0, 1]), (first[:-1, 0, 0], first[1:, 0, 0]), (first[:, 0, 0], second[:, 0, 0])]
    for one, other in pairs:
        assert is_uniform(torch.bincount(2 * one + other, minlength=4).tolist(), ALPHA / len(pairs))


def test_read_rotation_draws_every_angle_from_zero_to_r_alike():
    task = surjective(read_rotation=5)
    expected = task.images.bank(5)[:6]

    observations = CTGraphEnv([task] * 6000, seed=1).reset()["observation"]

    matches = (observations.unsqueeze(1) == expected).flatten(2).all(-1)
    assert matches.any(1).all()
    assert len(expected.flatten(1).unique(dim=0)) == 6
    assert is_uniform(matches.sum(0).tolist())


def test_noise_is_added_after_rotation():
    task = surjective(read_noise=1, read_rotation=45)
    turned = task.images.bank(45)[:46].int()

    observations = CTGraphEnv([task] * 200, seed=1).reset()["observation"].int()

    added = observations.unsqueeze(1) - turned
    assert ((added >= 0) & (added <= 1)).flatten(2).all(-1).any(1).all()


@pytest.mark.parametrize("kind", [HOME, WAIT, DECISION, END, FAIL])
def test_both_ids_of_a_range_of_two_are_shown_where_nothing_else_is_random(kind):
    ranges = {f"{each.name.lower()}_ids": (2 * each, 2 * each + (each == kind)) for each in StateType}
    env = CTGraphEnv([Task(CTGraph(2, 1), (1,), Observations(**ranges), OneHot(10))] * 64)
    env.reset()

    ids = [env.observation_id.clone()]
    for action in (0, 0, 1, 1 if kind == FAIL else 0):
        act(env, [action] * 64)
        ids.append(env.observation_id.clone())

    shown = torch.stack(ids).unique().tolist()
    passed = [HOME, WAIT, DECISION, FAIL if kind == FAIL else END]
    assert shown == sorted([2 * each for each in passed] + [2 * kind + 1])


def test_noise_drawn_in_advance_lies_by_its_largest_addition():
    none, little, much = noise_bank((0, 4, 200), 300, (1, 5, 5)).chunk(3)

    assert none.max() == 0
    assert little.max() == 4
    assert much.max() == 200
