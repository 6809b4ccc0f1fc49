"""Embeddings of tasks, and the plan of optimal transport, against exact values and independent solvers."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from baselines.parts.embedding import (
    linear_wasserstein,
    reference_points,
    sliced_wasserstein,
    transitions,
    unit_directions,
)
from baselines.parts.transport import optimal_plan


@pytest.fixture(autouse=True)
def seeded():
    """Equal points in every run of a test."""
    torch.manual_seed(0)


@pytest.mark.parametrize("seed", range(20))
def test_with_equal_masses_the_plan_is_the_best_of_all_permutations(seed):
    cost = np.random.default_rng(seed).normal(size=(5, 5))
    ones = np.ones(5, dtype=np.int64)

    plan = optimal_plan(cost, ones, ones)

    best = min(permutations(range(5)), key=lambda order: cost[range(5), order].sum())
    assert plan[range(5), best].tolist() == [1] * 5 and plan.sum() == 5


@pytest.mark.parametrize(("rows", "columns", "ties"), [(30, 45, False), (20, 9, False), (7, 4, True), (1, 3, True)])
def test_the_plan_costs_what_linear_programming_finds(rows, columns, ties):
    linprog = pytest.importorskip("scipy.optimize").linprog
    random = np.random.default_rng(rows + columns)
    cost = random.integers(0, 3, (rows, columns)).astype(float) if ties else random.normal(size=(rows, columns))
    masses = [random.multinomial(6400, random.dirichlet(np.ones(number))) for number in (rows, columns)]

    plan = optimal_plan(cost, *masses)

    sums = [np.kron(np.eye(rows), np.ones(columns)), np.kron(np.ones(rows), np.eye(columns))]
    found = linprog(cost.ravel(), A_eq=np.concatenate(sums), b_eq=np.concatenate(masses), method="highs")
    assert (plan * cost).sum() == pytest.approx(found.fun, rel=1e-12, abs=1e-9)
    assert (plan >= 0).all()
    assert [plan.sum(axis=1).tolist(), plan.sum(axis=0).tolist()] == [each.tolist() for each in masses]


def test_masses_that_differ_are_refused():
    with pytest.raises(ValueError, match="supply and demand must have equal sums, got 3 and 2"):
        optimal_plan(np.zeros((1, 2)), np.array([3]), np.array([1, 1]))


def test_the_linear_embedding_has_its_exact_values():
    reference, shift = reference_points(50, 148), torch.randn(148)
    order = torch.randperm(50)

    assert not linear_wasserstein(reference[order], reference).any()
    moved = linear_wasserstein((reference + shift)[order], reference)
    assert_close(moved.view(50, 148), (shift / 50**0.5).expand(50, 148))
    assert_close(moved.norm(), shift.norm())
    copies = linear_wasserstein(shift.repeat(128, 1), reference)
    assert_close(copies.view(50, 148), (shift - reference) / 50**0.5)


def test_the_norm_of_the_linear_embedding_is_the_distance_of_the_best_permutation():
    points, reference = torch.randn(6, 2), reference_points(6, 2)

    embedding = linear_wasserstein(points, reference)

    squares = (points[:, None] - reference).square().sum(dim=-1)
    best = min(squares[list(order), range(6)].mean() for order in permutations(range(6)))
    assert_close(embedding.norm().square(), best)


def test_a_reference_point_gets_the_mean_of_what_the_plan_sends_to_it():
    reference = torch.tensor([[0.0], [1.0]])
    points = torch.tensor([[0.1], [0.4], [2.0]])  # a third each; the second is split in equal parts

    embedding = linear_wasserstein(points, reference)

    assert_close(embedding, torch.tensor([0.6 / 3 - 0, 4.4 / 3 - 1]) / 2**0.5)


def test_repeated_points_weigh_as_often_as_they_occur():
    points, reference = torch.randn(16, 3)[torch.arange(16) % 5], reference_points(4, 3)
    nearly = points + 1e-6 * torch.randn(16, 3)  # 16 different points

    assert_close(linear_wasserstein(points, reference), linear_wasserstein(nearly, reference), atol=1e-5, rtol=0)


def test_the_sliced_embedding_has_the_quantiles_along_each_direction():
    points, directions = torch.randn(128, 148), unit_directions(128, 148)

    embedding = sliced_wasserstein(points, directions, 40)

    levels = np.linspace(0, 1, 40)
    quantiles = np.concatenate([np.quantile(points.numpy() @ each, levels) for each in directions.numpy()])
    assert_close(embedding, torch.tensor(quantiles / np.linalg.norm(quantiles), dtype=torch.float32))
    assert_close(embedding.norm(), torch.tensor(1.0))
    assert_close(directions.norm(dim=1), torch.ones(128))


def test_copies_of_a_point_have_its_projections_at_all_quantiles():
    point, directions = torch.randn(4), unit_directions(3, 4)

    embedding = sliced_wasserstein(point.repeat(8, 1), directions, 5)

    along = directions @ point
    assert_close(embedding.view(3, 5), (along / (5**0.5 * along.norm()))[:, None].expand(3, 5))


def test_transitions_are_standardised_pixels_an_action_and_a_reward():
    observation = torch.tensor([[[0, 255]], [[255, 255]]], dtype=torch.uint8)
    action, reward = torch.tensor([2, 0]), torch.tensor([0.0, 0.5])

    points = transitions(observation, action, reward, 3)

    root = 3**0.5  # mean 3/4 and deviation sqrt(3)/4 of 255
    expected = [[-root, 1 / root, 0, 0, 1, 0], [1 / root, 1 / root, 1, 0, 0, 0.5]]
    assert_close(points, torch.tensor(expected))
    assert not transitions(torch.full((2, 4), 7), action, reward, 3)[:, :4].any()


def test_the_reference_is_the_same_for_all_and_leaves_the_global_generator_alone():
    before = torch.get_rng_state()

    points = reference_points(50, 148)

    assert torch.equal(points, reference_points(50, 148)) and points.min() >= 0 and points.max() < 1
    unit_directions(4, 4)
    assert torch.equal(torch.get_rng_state(), before)
