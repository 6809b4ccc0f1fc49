"""Attention: the steps that its block reads, and its equation."""

from __future__ import annotations

import pytest
import torch

from baselines.cells.attention import Attention


def test_a_step_reads_the_last_steps_of_its_episode_and_no_others():
    torch.manual_seed(0)
    cell = Attention(3, 4, 3, num_frames=3, num_heads=2).double()
    inputs = torch.randn(8, 3).double().requires_grad_()

    starts = torch.arange(8).view(1, 8) == 6
    output = cell.sequence(inputs, torch.arange(8).view(1, 8), starts, cell.zeros(1))

    reads = [torch.autograd.grad(output[0, t, 0], inputs, retain_graph=True)[0].any(-1) for t in (0, 5, 6, 7)]
    assert [each.nonzero().flatten().tolist() for each in reads] == [[0], [3, 4, 5], [6], [6, 7]]


@torch.no_grad()
def test_a_block_is_that_of_its_equation():
    torch.manual_seed(0)
    cell = Attention(3, 4, 3, num_frames=4, num_heads=2).double()
    cell.bias.normal_()
    inputs = torch.randn(4, 3).double()

    entered = cell.enter(inputs)
    normed = [norm(each) for each in entered]
    query, keys, values = (torch.stack([part(n) for n in normed]) for part in thirds(cell))
    heads = []
    for head in range(2):
        part = slice(2 * head, 2 * head + 2)
        scores = [query[3, part] @ keys[s, part] / 2**0.5 + cell.bias[head, 3 - s] for s in range(4)]
        heads.append(torch.stack(scores).softmax(0) @ values[:, part])
    y = entered[3] + cell.leave(torch.cat(heads))
    expected = norm(y + cell.narrower(cell.wider(norm(y)).relu()))

    found = cell.sequence(inputs, torch.arange(4).view(1, 4), torch.zeros(1, 4, dtype=torch.bool), cell.zeros(1))
    torch.testing.assert_close(found[0, 3], expected, rtol=1e-10, atol=1e-10)


def norm(values: torch.Tensor) -> torch.Tensor:
    return (values - values.mean()) / (values.var(correction=0) + 1e-5).sqrt()


def thirds(cell: Attention) -> list:
    """Functions of a normed input that give its query, key and value."""
    parts = zip(cell.attended.weight.chunk(3), cell.attended.bias.chunk(3), strict=True)
    return [lambda n, weight=weight, bias=bias: weight @ n + bias for weight, bias in parts]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_heads": 3}, "hidden_size must be a multiple of num_heads=3, got 4"),
        ({"num_heads": 0}, "num_heads must be an integer >= 1, got 0"),
        ({"num_frames": 1}, "num_frames must be an integer >= 2, got 1: one frame is cell=none"),
    ],
)
def test_settings_that_make_no_block_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Attention(3, 4, 3, **{"num_frames": 4, "num_heads": 2, **settings})
