"""On a GPU: the environment has the bits of a CPU, captured steps are those taken one by one, and no step waits."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch
from helpers.oracles import confounding
from helpers.small_agents import POLICY_GRADIENTS, agent_of
from helpers.sweeping import sweep

import baselines.parts.learner
import curricula
from baselines.update.captured import CapturedGroup
from benchmarks import environment_ladder as ladder
from benchmarks.environments import configurations
from ctgraph_rl import CTGraphEnv, Evaluation, Rows, RunLog, Steps, learn_curriculum, make_agent, rollout
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.region import WARM_UP, Region
from ctgraph_rl.learn import collect

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
]


@contextmanager
def without_waiting() -> Iterator[None]:
    """Raise an error where the host waits for the device."""
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.fixture
def eager(monkeypatch):
    """Take steps one by one."""

    def take() -> None:
        for module in (collect, baselines.parts.learner):
            monkeypatch.setattr(module, "captures", lambda device: False)

    return take


def learner(compose, name: str) -> tuple:
    env = CTGraphEnv([confounding(p=0.3)] * 64, device="cuda", check_actions=False)
    agent = agent_of(compose, name, env, "agent.num_envs=64").to("cuda")
    torch.cuda.manual_seed(0)
    collected = collect.collect(env, agent.policy, 10**6 * env.numel(), agent.num_steps, agent.initial_state)
    return agent, collected


@pytest.mark.parametrize("name", configurations())
def test_rollouts_have_the_bits_of_a_cpu(name):
    task, actions = configurations()[name], torch.randint(0, 3, (64, 256))

    def steps(device: str) -> Steps:
        rows = Rows([task] * 256, device=device)
        return rollout(rows, actions.to(device), Steps.empty(rows, 64))

    assert all(torch.equal(one.cpu(), other) for one, other in zip(steps("cuda"), steps("cpu"), strict=True))


@pytest.mark.parametrize("way", ladder.WAYS)
def test_every_way_of_the_ladder_runs(way):
    rung = ladder.Rung(way, "CO", 1024, lambda: ladder.WAYS[way]([confounding(p=0.5)] * 1024, torch.device("cuda")))

    ladder.measure(rung, 1, 0.01, torch.device("cuda"))

    assert rung.failure == "" and len(rung.speeds) == 1


def test_compiled_steps_have_the_bits_of_a_cpu():
    task, actions = configurations()["CO, noise 10"], torch.randint(0, 3, (20, 256))
    rows = Rows([task] * 256)
    steps = rollout(rows, actions, Steps.empty(rows, 20))
    twin = Rows([task] * 256, device="cuda")
    twin.reset()
    step = torch.compile(ladder.write_step, fullgraph=True, dynamic=False)

    state, words = tuple(twin.state), dynamics.words_of(twin.state.tick, twin.params, twin.uses)
    for t, action in enumerate(actions.to("cuda")):
        expected = (steps.observation[t + 1], steps.reward[t], steps.done[t], steps.outcome[t])
        shown = [torch.empty_like(each, device="cuda") for each in expected]
        state, words = step(shown, state, action, words, params=twin.params, uses=twin.uses)
        assert all(torch.equal(one.cpu(), other) for one, other in zip(shown, expected, strict=True))


def test_a_region_that_is_replayed_computes_what_its_function_does():
    state = torch.zeros(5, device="cuda")

    def function(given: dict) -> dict:
        state.add_(given["x"])
        return {"y": state * 2, "noise": torch.rand_like(state)}

    region = Region(function)
    found = [{key: value.clone() for key, value in region({"x": state.new_full((5,), i)}).items()} for i in range(8)]

    assert region.graph is not None
    assert [each["y"][0].item() for each in found] == [i * (i + 1) for i in range(8)]
    assert len({each["noise"][0].item() for each in found}) == 8


@pytest.mark.parametrize("name", POLICY_GRADIENTS)
def test_captured_acting_is_acting_bit_for_bit(name, compose, eager):
    _, collected = learner(compose, name)
    found = [next(collected).clone() for _ in range(WARM_UP)]

    eager()
    _, collected = learner(compose, name)

    for batch in found:
        expected = next(collected)
        for key in ("observation", "action", ("next", "reward"), ("next", "done")):
            assert torch.equal(batch[key], expected[key]), key
        torch.testing.assert_close(batch["state_value"], expected["state_value"], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", POLICY_GRADIENTS)
def test_captured_gradient_steps_are_those_taken_one_by_one(name, compose, eager):
    agent, collected = learner(compose, name)
    batches = [next(collected).clone() for _ in range(4)]
    torch.cuda.manual_seed(1)
    measured = [agent.learn(batch) for batch in batches]

    eager()
    its, _ = learner(compose, name)
    torch.cuda.manual_seed(1)
    expected = [its.learn(batch) for batch in batches]

    assert expected == [pytest.approx(each, rel=1e-4, abs=1e-6) for each in measured]
    for one, other in zip(agent.parameters(), its.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", ["ppo", "a2c", "lstm_ppo"])
def test_neither_a_step_nor_a_gradient_step_waits_for_the_device(name, compose):
    agent, collected = learner(compose, name)
    for _ in range(WARM_UP):
        agent.learn(next(collected))

    with without_waiting():
        batch = next(collected)
        for minibatch in agent.minibatches(batch):
            agent.gradient_step(minibatch)


@pytest.mark.parametrize("name", ["ppo", "lstm_ppo"])
def test_several_seeds_learn_by_graphs_what_they_learn_step_by_step_and_never_wait(name, compose, eager):
    def learned(is_captured: bool) -> list:
        task = confounding(p=0.3)
        env = CTGraphEnv([task] * 3 * 64, device="cuda", check_actions=False)
        agents = [agent_of(compose, name, env, "agent.num_envs=64").to("cuda") for _ in range(3)]
        group = CapturedGroup(agents, [torch.Generator().manual_seed(seed) for seed in range(3)])
        if not is_captured:
            group.gradient_step = group._usual_update
        collected = collect.collect(env, group.policy, 10**6 * 192, group.first.num_steps, group.first.initial_state)
        measured = [group.learn(next(collected)) for _ in range(WARM_UP + 1)]
        if is_captured:
            with without_waiting():
                for minibatch in group.first.minibatches_of(next(collected), group.seeds):
                    group.gradient_step(minibatch)
        return measured[0]

    found = learned(True)
    eager()
    expected = learned(False)

    assert [pytest.approx(each, rel=1e-4, abs=1e-6) for each in found] == expected


def test_the_seeds_of_a_sweep_learn_as_one_job_on_a_gpu(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = ("device=cuda", "curriculum=ct2_interfering", "curriculum.num_frames=4096", "agent=ppo")

    assert sweep(monkeypatch, "seed=0,1,2", "together=true", *settings, "agent.num_envs=64", "agent.num_steps=16") == 0

    begun = [RunLog.begun(path) for path in sorted(tmp_path.rglob("run.jsonl"))]
    assert [line["together"] for line in begun] == [[0, 1, 2]] * 3


def test_a_run_learns_on_a_gpu():
    curriculum = curricula.load("fo_b1_4tasks", num_frames=64 * 16 * 8)
    torch.manual_seed(0)
    agent = make_agent("ppo", curriculum, num_envs=64, num_steps=16).to("cuda")

    log = learn_curriculum(curriculum, agent, device="cuda")

    assert log.performance(4).shape == (5, 4)


def test_exact_evaluation_and_metrics_of_units_read_an_agent_on_a_gpu():
    curriculum = curricula.load("su_b1_4tasks", num_frames=64 * 16)
    curriculum = replace(curriculum, evaluation=Evaluation(exact=True))
    agent = make_agent("lstm_ppo", curriculum, num_envs=64, num_steps=16).to("cuda")

    log = learn_curriculum(curriculum, agent, device="cuda", log_units=True)

    assert log.performance(4).shape == (5, 4)
    assert log.of_kind("units")
