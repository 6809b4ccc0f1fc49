"""Attention: the steps that its block reads, and decisions that change with wait images."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from baselines.cells.attention import Attention
from ctgraph_rl import PaperImages
from ctgraph_rl.learn.swap import changed_decisions
from ctgraph_rl.tasks.configurations import ct_co_b1
from curricula import axes

FIRST_CO = replace(ct_co_b1((1, 2)), graph=replace(ct_co_b1().graph, wait_prob=0.5))
SHOWN, SWAPPED = axes.new_images(FIRST_CO, 2, ("wait",))
DECISION, WAITS = 2, (3, 102)


def images(ids: range) -> torch.Tensor:
    return SHOWN.images.images[ids.start : ids.stop].flatten(1)


class Reader:
    """Waits and decides as the number of decisions and the last wait image say; its state is in the data."""

    def __init__(self, reads_at: tuple[int, ...] = (), fails: bool = False) -> None:
        self.reads_at = reads_at
        self.fails = fails
        self.decision = images(range(DECISION, DECISION + 1))
        self.old = images(range(WAITS[0], WAITS[1] + 1))

    def initial_state(self, num_envs: int) -> TensorDict:
        zeros = torch.zeros(num_envs, 1, dtype=torch.int64)
        return TensorDict({"decisions": zeros, "is_old": zeros.bool()}, [num_envs])

    def __call__(self, data: TensorDict) -> TensorDict:
        seen = data["observation"].flatten(1)
        decides = (seen == self.decision).all(-1, keepdim=True)
        is_old = (seen.unsqueeze(1) == self.old).all(-1).any(-1, keepdim=True)
        reads = torch.stack([data["decisions"] == place for place in (-1, *self.reads_at)]).any(0)
        decision = 1 + (reads & data["is_old"]).long()
        waits = (~is_old & (data["step_count"] > 0)).long() if self.fails else 0
        data["action"] = torch.where(decides, decision, waits).squeeze(-1)
        data["next", "decisions"] = data["decisions"] + decides
        data["next", "is_old"] = torch.where(decides, data["is_old"], is_old)
        return data


@pytest.mark.parametrize(("reads_at", "share"), [((), 0.0), ((1,), 0.5), ((0, 1), 1.0)])
def test_the_share_of_changed_decisions_is_that_of_the_decisions_that_read_wait_images(reads_at, share):
    policy = Reader(reads_at)

    assert changed_decisions(policy, SHOWN, SWAPPED, 20, initial_state=policy.initial_state) == share


def test_a_policy_that_fails_at_swapped_wait_images_is_led_past_them_and_its_decisions_count():
    policy = Reader(fails=True)

    assert changed_decisions(policy, SHOWN, SWAPPED, 20, initial_state=policy.initial_state) == 0


def test_equal_wait_images_change_no_decision():
    policy = Reader((0, 1))

    assert changed_decisions(policy, SHOWN, SHOWN, 5, initial_state=policy.initial_state) == 0


@pytest.mark.parametrize("change", [{"goal": (2, 2)}, {"fail_reward": -1.0}, {"images": PaperImages(204, 9)}])
def test_tasks_that_differ_in_more_than_wait_images_are_refused(change):
    with pytest.raises(ValueError, match="task and swapped must differ in their wait images only"):
        changed_decisions(Reader(), SHOWN, replace(SWAPPED, **change))


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
