"""Steps of some rows only: TorchRL's ``_step`` mask, in both engines."""

from __future__ import annotations

import pytest
import torch
from helpers.oracles import STATE, confounding, fully_observable, scripts, surjective
from torchrl.envs import EnvBase, MultiAction, TransformedEnv

from ctgraph_rl import CTGraphEnv

NOISY = confounding(p=0.5, read_noise=20, read_rotation=20)
TASKS = [NOISY, surjective(p=0.3), fully_observable(), NOISY, surjective(goal=(2, 1)), confounding(p=0.5)]
N = len(TASKS)

every_engine = pytest.mark.parametrize("kernel", ["off", "required"])


def make(kernel="auto", **options):
    return CTGraphEnv(TASKS, seed=3, kernel=kernel, **options)


def masked(data, actions, mask):
    """The input of a step of the rows of a mask."""
    return data.clone().update({"action": torch.as_tensor(actions), "_step": torch.as_tensor(mask)})


@every_engine
@pytest.mark.parametrize("info", [True, False])
def test_rows_outside_the_mask_keep_their_state_and_their_data_without_a_reward(kernel, info):
    env, twin = make(kernel, info=info), make(kernel, info=info)
    mask = torch.tensor([True, False, False, False, True, False])
    root = env.step_mdp(env.step(env.reset().set("action", torch.zeros(N, dtype=torch.int64))))
    twin.step(twin.reset().set("action", torch.zeros(N, dtype=torch.int64)))
    state = {name: getattr(env.rows, name).clone() for name in STATE}

    after = env.step(masked(root, [0] * N, mask))["next"]
    whole = twin.step(root.clone().set("action", torch.zeros(N, dtype=torch.int64)))["next"]

    assert all((after[key][~mask] == root[key][~mask]).all() for key in root.keys(True) if key != "action")
    assert not after["reward"][~mask].any() and (after[mask] == whole[mask]).all()
    assert all(torch.equal(getattr(env.rows, name)[~mask], state[name][~mask]) for name in STATE)
    assert all(torch.equal(getattr(env.rows, name)[mask], getattr(twin.rows, name)[mask]) for name in STATE)


@every_engine
def test_rows_outside_the_mask_draw_nothing(kernel):
    env, alone = make(kernel, check_actions=False), make(kernel, check_actions=False)
    mask, actions = torch.tensor([True, False] * 3), scripts(20, N)
    data = env.reset()
    for action in actions[:3]:
        env.step(masked(data, action, mask))
    alone.reset()

    for action in actions:
        stepped, expected = (each.step(data.clone().set("action", action))["next"] for each in (env, alone))

        assert (stepped == expected)[~mask].all()


@every_engine
@pytest.mark.parametrize("shape", [(N,), (N, 1)])
def test_a_mask_that_is_all_true_is_a_step_and_one_that_is_all_false_is_none(kernel, shape):
    env, twin = make(kernel), make(kernel)
    root, actions = env.reset(), torch.zeros(N, dtype=torch.int64)
    twin.reset()

    none = env.step(masked(root, actions, torch.zeros(shape, dtype=torch.bool)))["next"]
    every = env.step(masked(root, actions, torch.ones(shape, dtype=torch.bool)))["next"]

    assert all((none[key] == root[key]).all() for key in root.keys(True)) and not none["reward"].any()
    assert (every == twin.step(root.clone().set("action", actions))["next"]).all()


def test_actions_are_checked_in_the_rows_of_the_mask_only():
    env = make()
    data = env.reset()
    env.step(data.clone().set("action", torch.zeros(N, dtype=torch.int64)))
    data = env.step(data.clone().set("action", torch.tensor([1] + [0] * (N - 1))))["next"]
    assert data["done"][0]

    env.step(masked(data, [99, 0, 0, 0, 0, -5], [False] + [True] * (N - 2) + [False]))

    with pytest.raises(ValueError, match=r"rows \[0\] are done: reset them first"):
        env.step(masked(data, [0] * N, [True] + [False] * (N - 1)))
    with pytest.raises(ValueError, match=r"got \[9\]"):
        env.step(masked(data, [0, 9] + [0] * (N - 2), [False, True] + [False] * (N - 2)))


@every_engine
@pytest.mark.parametrize("seed", range(3))
def test_a_rollout_until_all_rows_are_done_leaves_each_where_its_episode_ended(kernel, seed):
    torch.manual_seed(seed)
    env, alone = make(kernel), make(kernel)

    data = env.rollout(50, break_when_all_done=True)

    lengths = (1 + data["next", "done"].int().argmax(1)).flatten().tolist()
    assert len(set(lengths)) > 1 and max(lengths) == data.shape[1] and "_step" not in data
    assert env.rows.step_count.tolist() == lengths
    whole = alone.rollout(data.shape[1], actions=list(data["action"].T), break_when_any_done=False)
    for row, length in enumerate(lengths):
        assert (data[row, :length] == whole[row, :length]).all()
        assert (data[row, length - 1 :] == data[row, length - 1]).all()


def test_a_step_of_some_rows_that_resets_finished_ones_is_the_stock_methods():
    def run(method):
        env = make()
        data, found = env.reset(), []
        for i, action in enumerate(scripts(12, N)):
            taken, data = method(env, masked(data, action, [(i + row) % 3 > 0 for row in range(N)]))
            found += [taken["next"], data.exclude("_step")]
        return torch.stack([step.select("observation", "done", "is_init", "step_count") for step in found])

    assert (run(EnvBase._step_and_maybe_reset) == run(CTGraphEnv._step_and_maybe_reset)).all()


def test_macro_actions_stop_where_an_episode_ends():
    env, single = TransformedEnv(CTGraphEnv([surjective()] * 3), MultiAction()), CTGraphEnv([surjective()] * 3)
    plans = torch.tensor([[0, 0, 1, 0, 1, 0], [0, 1, 0, 0, 0, 0], [0, 0, 2, 0, 2, 0]])

    after = env.step(env.reset().set("action", plans))["next"]

    ends = single.rollout(6, actions=list(plans.T), break_when_all_done=True)["next"][:, -1]
    assert after["step_count"].flatten().tolist() == ends["step_count"].flatten().tolist() == [6, 2, 6]
    assert after["outcome"].flatten().tolist() == [3, 1, 2] and after["reward"].sum(1).flatten().tolist() == [1, 0, 0]
