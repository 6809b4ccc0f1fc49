"""Collecting: every batch has the keys of the environment, and the values of its own steps."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers.oracles import confounding, surjective
from tensordict import TensorDict, TensorDictBase
from tensordict.nn.common import TensorDictModuleWrapper
from torch import Tensor

from baselines.parts.networks import ActorCritic
from ctgraph_rl import CTGraphEnv
from ctgraph_rl.learn.collect import collect, take_step

TASKS = [surjective(goal=(2, 1)), confounding(p=0.3)]
IDS = {TASKS[0]: 0, TASKS[1]: 2}
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "no info": {"info": False},
    "task ids": {"task_ids": IDS},
    "task ids, no info": {"task_ids": IDS, "info": False},
}


class Remembering:
    """Acts at random and counts in a recurrent state."""

    def __init__(self, env: CTGraphEnv) -> None:
        self.generator = torch.Generator().manual_seed(0)
        self.env = env

    def initial_state(self, num_envs: int) -> TensorDict:
        return TensorDict({"count": torch.zeros(num_envs, 1)}, [num_envs])

    def __call__(self, data: TensorDictBase) -> TensorDictBase:
        data["action"] = torch.randint(0, 3, self.env.batch_size, generator=self.generator)
        return data.set(("next", "count"), data["count"] + 1)


@pytest.mark.parametrize("kernel", ["off", "required"])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_every_batch_has_the_keys_of_the_environment_also_after_a_change_of_tasks(options, kernel):
    env = CTGraphEnv(TASKS * 4, kernel=kernel, **options)
    policy = Remembering(env)

    def change(frames: int) -> None:
        if frames == 9 * env.numel():
            env.set_tasks(TASKS[::-1] * 4, at_episode_end=True)

    found = list(collect(env, policy, 18 * 8, 6, policy.initial_state, change))

    shown, action = set(env.observation_spec.keys()) | set(env.done_keys), {"action", "count"}
    keys = shown | action | {("next", key) for key in (*shown, "count", "reward")}
    assert [set(batch.keys(True, True)) - {"next"} for batch in found] == [keys] * 3
    assert found[0]["next", "done"].any() and set(env.rows.task.tolist()) == {0, 1}


@pytest.mark.parametrize("kernel", ["off", "required"])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_a_step_of_the_collecting_loop_is_that_of_torchrl(options, kernel):
    env, twin = (CTGraphEnv(TASKS * 4, seed=2, kernel=kernel, **options) for _ in range(2))
    data, expected = env.reset(), twin.reset()
    policy = Remembering(env)

    for number in range(30):
        if number == 10:
            for one in (env, twin):
                one.set_tasks(TASKS[::-1] * 4, at_episode_end=True)
        written = policy(TensorDict(count=torch.zeros(8, 1), batch_size=[8]))
        step, data = take_step(env, dict(data) | dict(written.items(True, True)))
        taken, expected = twin.step_and_maybe_reset(expected.update(written))
        assert same(step, dict(taken.items(True, True)))
        del expected["count"]
        assert same(
            {key: data[key] for key in data.keys() - {"action", "count"}}, dict(expected.exclude("action").items())
        )


def same(found: dict[Any, Tensor], expected: dict[Any, Tensor]) -> bool:
    return found.keys() == expected.keys() and all(torch.equal(found[key], expected[key]) for key in expected)


class Zero(ActorCritic):
    """A policy derived from one that acts on tensors."""

    def forward(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        return super().forward(tensordict).set("action", torch.zeros(8, dtype=torch.int64))


def hooked(policy: ActorCritic) -> ActorCritic:
    policy.register_forward_hook(lambda module, given, data: data.set("action", torch.zeros(8, dtype=torch.int64)))
    return policy


class Wrapped(TensorDictModuleWrapper):
    """A policy around one that acts on tensors."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.td_module(tensordict).set("action", torch.zeros(8, dtype=torch.int64))


@pytest.mark.parametrize(
    "change", [lambda policy: Zero(*policy.module), hooked, Wrapped], ids=["derived", "hook", "around"]
)
def test_what_changes_the_actions_of_a_policy_is_asked(small_agent, change):
    env = CTGraphEnv(TASKS * 4)
    policy = small_agent("ppo", TASKS).policy
    [plain] = collect(env, policy, 8 * 40, 40)

    [batch] = collect(env, change(policy), 8 * 40, 40)

    assert plain["action"].any() and not batch["action"].any()
