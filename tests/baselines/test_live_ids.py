"""Learning with the weights of shown ids alone: bits are those of learning with all."""

from __future__ import annotations

import pytest
import torch
from helpers.small_agents import REPLAY, agent_of, others_slow

from baselines.parts import live_ids
from baselines.parts.hooks import Hooks, PlasticityHooks
from baselines.parts.networks import IdLinear
from ctgraph_rl import CTGraphEnv
from ctgraph_rl.learn.collect import collect
from curricula.paper import ct_su_b1

ONE, TWO, HELD_OUT = ct_su_b1((1, 2)), ct_su_b1((2, 1)), ct_su_b1((1, 1))
IDS = {ONE: 3, TWO: 17}
NUM_IDS = 40

TRIALS = ["agent.adapt_episodes=1", "agent.num_steps=12"]

AGENTS = {
    "a2c": [],
    "ppo": ["agent.num_minibatches=2"],
    "ppo_rnd": ["agent.num_minibatches=2"],
    "lstm_ppo": ["agent.num_minibatches=2"],
    "dqn": [*REPLAY, "agent.replay_on_task_change=keep"],
    "dqn without moments": [*REPLAY, "agent.target_update_interval=4"],
    "drqn": [*REPLAY, "agent.replay_on_task_change=keep"],
    "mohqa": REPLAY,
    "maml": ["agent.outer=ppo", *TRIALS, "agent.gate=soft"],
    "cavia": ["agent.outer=ppo", *TRIALS],
    "pearl without moments": [
        "agent.gate=soft",
        "agent.target_rate=1",
        "agent.num_context=2",
        "agent.context_size=8",
        "agent.batch_size=8",
    ],
}


def learned(compose, name: str, widths: list[int], seen: list[tuple]) -> dict:
    """The state of an agent that learned from some batches of each row of tasks.

    Args:
        widths: gets the columns of the first layer at each gradient step.
    """
    rows = [[ONE] * 16, [TWO, HELD_OUT] * 8, [HELD_OUT] * 16]
    envs = [CTGraphEnv(tasks, seed=1, task_ids=IDS, num_task_ids=NUM_IDS) for tasks in rows]
    agent = agent_of(compose, name.split()[0], envs[0], "agent.max_grad_norm=1e9", *AGENTS[name])
    layer = next(module for module in agent.modules() if isinstance(module, IdLinear) and module.num_ids)
    take_step = agent.gradient_step

    def gradient_step(minibatch):
        widths.append(layer.weight.shape[1])
        return take_step(minibatch)

    agent.gradient_step = gradient_step
    for number, env in enumerate(envs):
        agent.start_task(number)
        if name.endswith("without moments"):
            agent.clear_optimiser_state(agent.trainable)
        for batch in collect(env, agent.policy, 3 * 16 * agent.num_steps, agent.num_steps, agent.initial_state):
            seen.append((number, agent.learn(batch)))
    return {"parameters": agent.state_dict(), "optimiser": agent.optimiser.state_dict()["state"]}


@pytest.mark.parametrize("name", others_slow(AGENTS, "ppo", "dqn without moments"))
def test_an_agent_learns_with_few_of_many_ids_as_with_all(compose, monkeypatch, name):
    few, all_of_them = [], []
    measured, expected_measured = [], []

    expected = learned(compose, name, all_of_them, expected_measured)
    monkeypatch.setattr(live_ids, "MANY_IDS", NUM_IDS)
    found = learned(compose, name, few, measured)

    assert set(all_of_them) == {max(all_of_them)}
    first = max(all_of_them) - NUM_IDS
    assert min(few) == first + 1 and max(few) <= first + 3, "id 3, then 17 and, for tasks without an id, 0"
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    for (_, one), (_, other) in zip(measured, expected_measured, strict=True):
        assert one == pytest.approx(other, rel=1e-5)


def test_a_failed_batch_leaves_all_columns(compose, monkeypatch):
    monkeypatch.setattr(live_ids, "MANY_IDS", NUM_IDS)
    env = CTGraphEnv([ONE] * 16, seed=1, task_ids=IDS, num_task_ids=NUM_IDS)
    agent = agent_of(compose, "ppo", env)
    [batch] = collect(env, agent.policy, 16 * agent.num_steps, agent.num_steps)
    batch["next", "reward"][3, 2] = float("nan")

    with pytest.raises(FloatingPointError):
        agent.learn(batch)

    agent.policy(batch[:, 0])
    assert agent.trunk.module.linear.weight.shape[1] == 144 + NUM_IDS


@pytest.mark.parametrize("what", ["nothing", "method", "plasticity", "weight decay"])
def test_what_may_change_any_weight_keeps_all_columns(compose, monkeypatch, what):
    monkeypatch.setattr(live_ids, "MANY_IDS", NUM_IDS)
    env = CTGraphEnv([ONE] * 16, seed=1, task_ids=IDS, num_task_ids=NUM_IDS)
    agent = agent_of(compose, "ppo", env)
    if what == "method":
        agent.method = type("Shrink", (Hooks,), {})()
    elif what == "plasticity":
        agent.plasticity = type("Shrink", (PlasticityHooks,), {})()
    elif what == "weight decay":
        agent.optimiser.param_groups[0]["weight_decay"] = 0.1

    with live_ids.only_live_ids(agent, torch.tensor([3])):
        assert agent.trunk.module.linear.weight.shape[1] == 144 + (1 if what == "nothing" else NUM_IDS)
