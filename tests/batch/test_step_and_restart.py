"""A step and the restarts after it in one call of the kernel: the data of two calls of the tensor engine."""

from __future__ import annotations

import pytest
import torch
from helpers.oracles import fully_observable
from helpers.small_agents import others_slow, same
from helpers.task_families import EVERY_KIND, batch, likely
from tensordict import TensorDict

from ctgraph_rl import CTGraphEnv
from ctgraph_rl.policies import OptimalPolicy


@pytest.mark.parametrize("kind", others_slow(EVERY_KIND, *list(EVERY_KIND)[::2]))
def test_a_step_and_its_restarts_in_one_call_give_the_data_of_two(kind, monkeypatch):
    tasks = batch(EVERY_KIND[kind], 6)
    once, twice = (CTGraphEnv(tasks, seed=3, noise_bank=5, kernel=kernel) for kernel in ("required", "off"))
    monkeypatch.setattr(once, "step_data", None)
    num_ended = 0
    for env in (once, twice):
        env.reset()

    for action in likely(tasks, 40):
        after = twice.step_data(action)
        expected = after, twice.restart_data(after["done"], after["observation"])
        found = once.step_and_restart_data(action)

        assert [each.keys() for each in found] == [each.keys() for each in expected]
        assert all(map(same, found, expected))
        assert same(once.rows.state._asdict(), twice.rows.state._asdict())
        num_ended += after["done"].sum()
    assert num_ended


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (None, "got none"),
        (torch.tensor([0, 3, 0]), r"values in 0..2, got \[3\]"),
        (torch.tensor([0, 0, -1]), r"values in 0..2, got \[-1\]"),
        (torch.zeros(3), "got dtype torch.float32"),
        (torch.zeros(2, dtype=torch.int64), r"got shape \[2\]"),
        (torch.zeros(3, dtype=torch.int64), r"rows \[1\] are done: reset them first"),
    ],
)
def test_it_refuses_what_a_step_refuses_and_changes_nothing(action, message):
    env = CTGraphEnv([fully_observable()] * 3, kernel="required")
    env.reset()
    if "done" in message:
        for before in ([0, 0, 0], [0, 1, 0]):
            env.step_data(torch.tensor(before))
    state = env.rows.state

    with pytest.raises(ValueError, match=message):
        env.step_and_restart_data(action)

    assert same(env.rows.state._asdict(), state._asdict())


def test_rows_that_are_over_are_refused_or_with_unchecked_actions_restarted():
    tasks = [fully_observable()] * 2
    trusting, plain = (CTGraphEnv(tasks, kernel=kernel, check_actions=False) for kernel in ("required", "off"))
    strict = CTGraphEnv(tasks, kernel="required")
    for env in (trusting, plain, strict):
        env.reset()
        policy, data = OptimalPolicy(env), TensorDict(batch_size=[2])
        while not env.rows.is_done.all():
            env.step_data(policy.action(data))
    action = torch.zeros(2, dtype=torch.int64)

    after = plain.step_data(action)
    expected = after, plain.restart_data(after["done"], after["observation"])

    assert all(map(same, trusting.step_and_restart_data(action), expected))
    with pytest.raises(ValueError, match=r"rows \[0, 1\] are done"):
        strict.step_and_restart_data(action)
