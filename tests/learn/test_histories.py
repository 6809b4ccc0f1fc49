"""Histories: which frames of a batch have the same, which continue which, and what a part of a batch has of them."""

from __future__ import annotations

import pytest
import torch

from ctgraph_rl.learn import histories
from ctgraph_rl.learn.histories import distinct, number_histories, renumber, tree

ROWS, STEPS, INPUTS = 9, 7, 3


def frames(start_probability: float) -> tuple[torch.Tensor, torch.Tensor]:
    """The numbers of inputs, and where episodes start."""
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randint(INPUTS, (ROWS, STEPS), generator=generator)
    return inputs, torch.rand(ROWS, STEPS, generator=generator) < start_probability


def in_words(inputs: torch.Tensor, starts: torch.Tensor, state: torch.Tensor) -> list[tuple]:
    """The history of each frame: what it began with, and its inputs since."""
    words = []
    for row in range(ROWS):
        began: tuple = ("stored", state[row].item())
        for step in range(STEPS):
            if starts[row, step]:
                began = ("started",)
            began = (*began, int(inputs[row, step]))
            words.append(began)
    return words


@pytest.mark.parametrize("start_probability", [0.0, 0.3, 1.0])
def test_histories_have_one_number_where_state_and_inputs_since_the_start_are_equal(start_probability):
    inputs, starts = frames(start_probability)
    state = torch.arange(ROWS).remainder(4).float().unsqueeze(1)

    numbers = number_histories(inputs, starts, [state]).flatten().tolist()

    words = in_words(inputs, starts, state)
    assert len(set(numbers)) == len(set(words)) == len(set(zip(numbers, words, strict=True)))
    assert sorted(set(numbers)) == list(range(len(set(words))))


@pytest.mark.parametrize("start_probability", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("rows", [[0], [4, 2, 7], list(range(ROWS))])
def test_the_tree_of_some_rows_has_their_histories_and_what_each_goes_on_from(start_probability, rows):
    inputs, starts = frames(start_probability)
    state = torch.arange(ROWS).remainder(4).float().unsqueeze(1)
    words = in_words(inputs, starts, state)
    numbers = number_histories(inputs, starts, [state])

    found = tree(numbers[rows], starts[rows])
    [initial] = found.initial(starts[rows], [state[rows]])

    of_rows = [words[row * STEPS + step] for row in rows for step in range(STEPS)]
    ends = [of_rows[frame] for frame in found.frames.tolist()]
    assert [ends[history] for history in found.of_frames.tolist()] == of_rows
    assert sum(found.sizes) == len(ends) == len(set(of_rows))
    before = [*(("stored", value) for value in initial.flatten().tolist()), *ends]
    for end, shorter in zip(ends, found.shorter.tolist(), strict=True):
        begun = before[shorter]
        assert begun == end[:-1] or (begun == ("stored", 0.0) and end[:-1] == ("started",))
    lengths = [length for length, size in enumerate(found.sizes) for _ in range(size)]
    assert [len(end) - (2 if end[0] == "started" else 3) for end in ends] == lengths


def test_rows_are_grouped_where_all_values_are_equal():
    images = torch.tensor([[[7]], [[9]], [[7]], [[7]]]).byte()
    numbers = torch.tensor([[0.5], [0.5], [0.5], [0.0]])

    examples, groups = distinct([images, numbers])

    assert len(examples) == 3
    assert groups[0] == groups[2]
    assert torch.equal(images[examples][groups], images) and torch.equal(numbers[examples][groups], numbers)


@pytest.mark.parametrize("place", range(16))
def test_rows_that_differ_by_one_bit_are_of_different_groups(place):
    values = torch.zeros(4, 19, dtype=torch.uint8)
    values[1, place] = 1
    values[2, place] = 128

    examples, groups = distinct([values[:, 1:]])  # whose rows begin at odd places in memory

    assert len(examples) == (3 if place else 1)
    assert torch.equal(values[examples][groups][:, 1:], values[:, 1:])


def test_a_single_row_of_odd_length_in_a_wider_tensor_is_a_group():
    values = torch.arange(3 * 19, dtype=torch.uint8).view(3, 19)

    for width in (8, 11, 16):
        assert [part.tolist() for part in distinct([values[:1, :width]])] == [[0], [0]]


def test_rows_that_differ_by_less_than_rounding_are_of_different_groups():
    values = torch.tensor([[1e30, 0.0], [1e30, 1.0], [1e30, 0.0]])

    examples, groups = distinct([values])

    assert len(examples) == 2
    assert torch.equal(values[examples][groups], values)


def test_of_many_rows_that_differ_as_with_noise_each_is_a_group():
    values = torch.arange(2048).unsqueeze(1)

    examples, groups = distinct([values])

    assert torch.equal(examples, groups) and torch.equal(groups, torch.arange(2048))
    assert len(distinct([values % 7])[0]) == 7


def test_rows_that_differ_despite_equal_sums_are_of_different_groups(monkeypatch):
    monkeypatch.setattr(histories, "_sums", lambda words: words[:, 0] * 0)

    assert distinct([torch.tensor([[1], [2], [1]])])[1].tolist() == [0, 1, 2]
    assert distinct([torch.tensor([[1], [1], [1]])])[1].tolist() == [0, 0, 0]


def test_numbers_of_some_rows_are_numbered_again():
    examples, groups = renumber(torch.tensor([5, 2, 5, 9]))

    assert groups.tolist() == [1, 0, 1, 2]
    assert torch.equal(torch.tensor([5, 2, 5, 9])[examples][groups], torch.tensor([5, 2, 5, 9]))
