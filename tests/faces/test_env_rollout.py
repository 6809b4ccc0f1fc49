"""`CTGraphEnv.rollout` gives what TorchRL's own method gives, and ``info=False`` only leaves keys out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers.oracles import confounding, fully_observable, record, scripts, surjective
from tensordict import LazyStackedTensorDict, TensorDict, TensorDictBase
from torchrl.envs import EnvBase, StepCounter, TransformedEnv, check_env_specs

from ctgraph_rl import CTGraphEnv

TASKS = [confounding(), surjective(p=0.3), fully_observable(), confounding(p=0.5)] * 2
INFO = {"step_count", "episode_reward", "outcome", "leaf", "truncated"}

Prepare = Callable[[CTGraphEnv], dict[str, Any]]
every_env = pytest.mark.parametrize(
    "options", [{"kernel": kernel, "info": info} for kernel in ("off", "auto") for info in (True, False)], ids=str
)


def make(**options: Any) -> CTGraphEnv:
    return CTGraphEnv(TASKS, seed=3, check_actions=False, **options)


def both(
    *args: Any, options: dict[str, Any] | None = None, prepare: Prepare = lambda env: {}, **kwargs: Any
) -> tuple[TensorDictBase, TensorDictBase]:
    """What the stock method and this class's give from equal states with equal random actions."""

    def run(method: Callable[..., TensorDictBase]) -> TensorDictBase:
        torch.manual_seed(7)
        env = make(**(options or {}))
        return method(env, *args, **kwargs, **prepare(env))

    return run(EnvBase.rollout), run(CTGraphEnv.rollout)


def is_same(stock: TensorDictBase, found: TensorDictBase) -> bool:
    """Type, batch size, names, device, keys, dtypes and values."""
    keys = set(stock.keys(True, True))
    return (
        type(stock) is type(found)
        and (stock.batch_size, stock.names, stock.device) == (found.batch_size, found.names, found.device)
        and keys == set(found.keys(True, True))
        and all(stock[key].dtype == found[key].dtype and torch.equal(stock[key], found[key]) for key in keys)
    )


def waits(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.zeros(tensordict.batch_size, dtype=torch.int64))


def numbered(tensordict: TensorDictBase) -> TensorDictBase:
    """A policy with an output of its own."""
    return waits(tensordict).set("hidden", tensordict["observation"].flatten(1).float().mean(1, keepdim=True))


ARGUMENTS: dict[str, dict[str, Any]] = {
    "random actions": {},
    "one row done ends it": {"break_when_any_done": True},
    "all rows done end it": {"break_when_all_done": True},
    "never ends": {"break_when_any_done": False},
    "policy": {"policy": numbered, "break_when_any_done": False},
    "actions": {"actions": list(scripts(12, len(TASKS))), "break_when_any_done": False},
    "storing device": {"storing_device": "cpu", "break_when_any_done": False},
    "cast": {"auto_cast_to_device": True, "policy": waits},
    "contiguous": {"return_contiguous": True, "break_when_any_done": False},
    "as the specs allow": {"return_contiguous": None, "break_when_any_done": False},
}


@pytest.mark.parametrize("options", [{"kernel": "off", "info": True}, {"kernel": "auto", "info": False}], ids=str)
@pytest.mark.parametrize(("name", "max_steps"), [*((name, 15) for name in ARGUMENTS), ("never ends", 1)])
def test_rollout_gives_the_data_of_the_stock_method(options, name, max_steps):
    stock, found = both(max_steps, options=options, **ARGUMENTS[name])

    assert is_same(stock, found)
    assert stock.names == [None, "time"] and isinstance(found, TensorDict)


def test_rollouts_that_end_early_are_as_long_as_the_stock_methods():
    lengths = [
        both(40, **arguments)[1].shape[1]
        for arguments in ({}, {"break_when_all_done": True}, {"break_when_any_done": False})
    ]

    assert 1 < lengths[0] < lengths[1] < lengths[2] == 40


def test_the_memory_of_a_rollout_is_time_major_unless_it_is_asked_to_be_contiguous():
    env = CTGraphEnv(TASKS)

    data, contiguous = env.rollout(5, waits), env.rollout(5, waits, return_contiguous=True)

    assert data["observation"].transpose(0, 1).is_contiguous() and data["next", "done"].transpose(0, 1).is_contiguous()
    assert contiguous["observation"].is_contiguous()


def test_truncation_and_a_given_output_are_the_stock_methods():
    like = make().rollout(6, waits, break_when_any_done=False)

    truncated = both(6, waits, break_when_any_done=False, set_truncated=True)
    outs = both(6, waits, break_when_any_done=False, prepare=lambda env: {"out": like.clone().zero_()})

    assert is_same(*truncated) and truncated[1]["next", "truncated"][:, -1].all()
    assert is_same(*outs) and is_same(outs[1], like)


def test_a_callback_sees_the_steps_of_the_stock_method_and_may_roll_out_the_same_environment():
    seen = []

    def callback(env, data):
        seen.append((data["observation"].clone(), env.rollout(2, waits).shape))

    stock, found = both(6, waits, callback, break_when_any_done=False)

    assert is_same(stock, found)
    assert [shape for _, shape in seen] == [(8, 2)] * 10
    assert all(torch.equal(seen[i][0], seen[i + 5][0]) for i in range(5))


def test_a_rollout_goes_on_from_given_data_and_from_a_given_state():
    def carry_on(env):
        return {"tensordict": env.rollout(3, waits)[:, -1]["next"], "auto_reset": False}

    def from_state(env):
        env.rollout(2, waits)
        return {"tensordict": TensorDict(state=env.get_state(), batch_size=env.batch_size), "set_state": True}

    for prepare in (carry_on, from_state):
        stock, found = both(5, break_when_any_done=False, prepare=prepare)

        assert is_same(stock, found)


@pytest.mark.parametrize("name, width", [("memory{}", 1), ("memory", None)], ids=["keys", "shapes"])
def test_steps_with_different_keys_or_shapes_are_stacked_as_by_the_stock_method(name, width):
    def prepare(env):
        counts = iter(range(1, 9))

        def policy(tensordict):
            count = next(counts)
            return waits(tensordict).set(name.format(count % 2), torch.zeros(len(TASKS), width or count))

        return {"policy": policy}

    stock, found = both(4, break_when_any_done=False, prepare=prepare)

    assert type(stock) is type(found) is LazyStackedTensorDict
    assert found.stack_dim == stock.stack_dim == 1 and found.names == stock.names
    assert all(is_same(*pair) for pair in zip(stock.unbind(1), found.unbind(1), strict=True))


def test_a_wrapped_environment_gives_the_same_rollout():
    actions = list(scripts(20, len(TASKS)))
    alone = CTGraphEnv(TASKS, seed=3).rollout(20, actions=actions, break_when_any_done=False)
    wrapped = TransformedEnv(CTGraphEnv(TASKS, seed=3), StepCounter(step_count_key="steps"))

    data = wrapped.rollout(20, actions=actions, break_when_any_done=False)

    assert (data.select(*alone.keys(True, True)) == alone).all()


def test_after_a_rollout_that_fails_the_stock_method_stacks_its_own_steps():
    env = CTGraphEnv(TASKS, seed=3)

    with pytest.raises(ValueError, match="action must be int64"):
        env.rollout(3, lambda tensordict: tensordict)

    assert EnvBase.rollout(env, 3, waits)["observation"].shape == (8, 3, 1, 12, 12)


@pytest.mark.parametrize("kernel", ["off", "required"])
def test_without_info_the_data_are_the_same_but_for_five_keys(kernel):
    full, lean = (CTGraphEnv(TASKS, seed=3, kernel=kernel, info=info) for info in (True, False))
    actions = scripts(40, len(TASKS))

    data, found = record(full, actions), record(lean, actions)

    names = [{key[-1] if isinstance(key, tuple) else key for key in one.keys(True, True)} for one in (data, found)]
    assert names[0] - names[1] == INFO and names[1] < names[0]
    assert (data.select(*found.keys(True, True)) == found).all()
    assert found["next", "done"].any()


def test_without_info_the_specs_hold_and_a_step_counter_still_truncates():
    env = CTGraphEnv(TASKS, info=False, task_ids={TASKS[0]: 1})
    check_env_specs(env)

    data = TransformedEnv(env, StepCounter(max_steps=2)).rollout(4, waits, break_when_any_done=False)

    assert data["next", "truncated"][:, 1].all()


def test_info_must_be_true_or_false():
    with pytest.raises(ValueError, match="info must be true or false, got 1"):
        CTGraphEnv(TASKS, info=1)
