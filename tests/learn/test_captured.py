"""Regions: what a GPU replays as a CUDA graph neither makes the host wait nor depends on a device.

The device ``meta`` has shapes and no data: an operation that needs a value on the host, or whose result's shape depends
on data, is an error there, and so is one with a tensor of another device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice

import pytest
import torch
from helpers.oracles import confounding
from helpers.scripted import ONE, THREE, of
from helpers.small_agents import POLICY_GRADIENTS, SMALL_AGENT, agent_of, others_slow, parameters_equal
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs.utils import ExplorationType, set_exploration_type

import baselines.update.update
import curricula
from baselines.parts.learner import Learner
from baselines.update.captured import CapturedGroup
from benchmarks.environments import configurations
from ctgraph_rl import Block, CTGraphEnv, Rows, RunLog, Steps, learn_curriculum, make_agent, rollout
from ctgraph_rl.core.region import Region
from ctgraph_rl.learn import collect
from ctgraph_rl.learn.collect import CapturedAct, make_start, stack_steps
from ctgraph_rl.runs.config import target

META = torch.device("meta")
TWO_TASKS = of(Block(ONE, 8), Block(THREE, 8), task_id="at_boundaries")
TINY = {"num_envs": 8, "num_steps": 4, "hidden_size": 8, "num_epochs": 1}


@pytest.fixture
def captured(monkeypatch) -> None:
    """Use regions on every device."""
    for module in (collect, baselines.update.update):
        monkeypatch.setattr(module, "captures", lambda device: True)


@pytest.fixture
def swapped() -> Iterator[None]:
    """Let parameters that move to ``meta`` stay the same objects."""
    torch.__future__.set_swap_module_params_on_conversion(True)
    yield
    torch.__future__.set_swap_module_params_on_conversion(False)


class Alone(TorchDispatchMode):
    """Refuses copies from the CPU, for which a CUDA graph has no place."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        converted = func is torch.ops.aten._to_copy.default and isinstance(args[0], torch.Tensor)  # or a number
        moved = converted and kwargs.get("device", args[0].device) != args[0].device
        copied = func is torch.ops.aten.copy_.default and args[1].device != args[0].device
        assert not (moved or copied), f"{func} from {args[-1].device}"
        return func(*args, **kwargs)


@pytest.fixture
def alone(monkeypatch) -> Alone:
    """Refuses what copies from the CPU, also by functions that hide it."""

    def on_the_cpu(make: Callable[..., torch.Tensor], *data: object, **how: object) -> torch.Tensor:
        assert how.get("device") in (None, "cpu", torch.device("cpu")), f"{data} is copied to {how['device']}"
        return make(*data, **how)

    for name in ("tensor", "as_tensor"):
        monkeypatch.setattr(torch, name, partial(on_the_cpu, getattr(torch, name)))
    return Alone()


def test_a_region_returns_the_results_of_its_function_and_overwrites_them():
    region = Region(lambda given: {"sum": given["x"] + 1, "x": given["x"]})

    first = region({"x": torch.tensor([1.0])})
    second = region({"x": torch.tensor([2.0])})

    assert second["sum"].tolist() == [3.0] and first["sum"] is second["sum"]
    assert first["x"].tolist() == [2.0]


def test_a_region_takes_arguments_of_the_shapes_of_the_first_call():
    region = Region(lambda given: given)

    assert region.takes({"x": torch.ones(3)}) and region.takes({"x": torch.ones(2)})
    region({"x": torch.ones(3)})
    assert region.takes({"x": torch.zeros(3)})
    assert not region.takes({"x": torch.ones(1)}), "which a copy would repeat"


@pytest.mark.parametrize("name", configurations())
def test_no_step_of_the_tensor_engine_needs_the_host(name, request):
    batch = Rows([configurations()[name]] * 4, kernel="off").to(META)

    with request.getfixturevalue("alone"):
        steps = rollout(batch, torch.zeros(2, 4, dtype=torch.int64, device=META), Steps.empty(batch, 2))

    assert {value.device for value in (*steps, *batch.state)} == {META}


@pytest.mark.parametrize("name", others_slow(POLICY_GRADIENTS, "lstm_ppo"))
def test_neither_acting_nor_learning_needs_the_host(name, compose, captured, swapped, request):
    env = CTGraphEnv([confounding(p=0.3)] * 16, kernel="off")
    agent = agent_of(compose, name, env).to(META)
    for optimiser in (each for each in vars(agent).values() if isinstance(each, torch.optim.Optimizer)):
        optimiser.param_groups[0] |= {"fused": False, "foreach": False}  # unknown on this device
    start, steps = make_start(env, agent.initial_state), []
    act, carried = CapturedAct(env, agent.policy, start), dict(env.reset().to(META).update(start).items(True, True))
    env.rows.to(META)
    env._device = META

    with request.getfixturevalue("alone"), torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        for _ in range(agent.num_steps):
            step, carried = act(carried)
            steps.append(step)
    minibatches = islice(agent.minibatches(stack_steps(steps, env)), 2)
    measured = [agent.gradient_step(minibatch) for minibatch in minibatches]

    assert {value.device for step in measured for value in step.values()} == {META}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("ppo", ()),
        ("a2c", ()),
        ("lstm_ppo", ()),
        ("lstm_ppo", ("cell=gru",)),
        *(("ppo", (f"method={method}",)) for method in ("scratch", "l2", "ewc", "si", "cka_rl", "mask_lc")),
        ("lstm_ppo", ("method=mask_blc",)),
    ],
)
def test_neither_acting_nor_learning_of_several_seeds_needs_the_host(
    name, settings, compose, captured, swapped, request
):
    env = CTGraphEnv([confounding(p=0.3)] * 48, kernel="off")
    cfg = compose(f"agent={name}", *SMALL_AGENT[name], "agent.num_envs=16", *settings)
    agents = []
    for _ in range(3):
        agent = target(cfg, "agent")(env.observation_spec_unbatched, env.action_spec_unbatched)
        agent = target(cfg, "method")().attach(agent, TWO_TASKS)
        agent.start_task(0)
        agent.end_task()
        agent.start_task(1)  # from here on what was learned is held, or combined
        agents.append(agent.to(META))
    group = CapturedGroup(agents, [torch.Generator().manual_seed(seed) for seed in range(3)])
    for learner in group.learners:
        learner.optimiser.param_groups[0] |= {"fused": False, "foreach": False}  # unknown on this device
    start, steps = make_start(env, group.first.initial_state), []
    act, carried = CapturedAct(env, group.policy, start), dict(env.reset().to(META).update(start).items(True, True))
    env.rows.to(META)
    env._device = META
    assert group.stack.weights

    with request.getfixturevalue("alone"):
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            for _ in range(group.first.num_steps):
                step, carried = act(carried)
                steps.append(step)
        minibatches = islice(group.first.minibatches_of(stack_steps(steps, env), group.seeds), 2)
        measured = [group.gradient_step(minibatch) for minibatch in minibatches]
        group.stack.write()

    assert {value.device for step in measured for value in step.values()} == {META}
    assert {value.shape for step in measured for value in step.values()} == {(3,)}


@pytest.mark.parametrize("name", ["ppo", "rl2"])
def test_a_gpu_estimates_the_advantages_that_a_cpu_estimates(name, compose, monkeypatch):
    env = CTGraphEnv([confounding(p=0.3)] * 16)
    agent = agent_of(compose, name, env)
    [batch] = collect.collect(env, agent.policy, 16 * agent.num_steps, agent.num_steps, agent.initial_state)
    batch["next", "terminated"][::2] = False  # some episodes are truncated

    def learned_from() -> dict:
        torch.manual_seed(0)
        return next(agent.minibatches(batch))

    expected = learned_from()
    monkeypatch.setattr(torch.Tensor, "is_cpu", False)
    found = learned_from()

    assert batch["next", "done"].any()
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "boundaries"),
    [
        ("ppo", "announced"),
        ("ppo", "hidden"),
        ("rl2", "hidden"),
        ("rl2", "announced"),
    ],
)
def test_memory_that_is_used_again_and_again_changes_no_bit_of_a_run(name, boundaries, captured, monkeypatch):
    published = curricula.load("fo_b1_4tasks", num_frames=112)  # no whole number of batches of 32
    protocol = replace(published.protocol, boundaries=boundaries)
    curriculum = replace(published, protocol=protocol, evaluation=replace(published.evaluation, num_episodes=2))

    def learned() -> tuple[list, Learner]:
        torch.manual_seed(0)
        agent = make_agent(name, curriculum, **TINY)
        log = learn_curriculum(curriculum, agent, log=RunLog())
        return [{**line, "seconds": 0} for line in log.measurements], agent

    lines, agent = learned()
    monkeypatch.undo()
    expected, its = learned()

    assert lines == expected
    assert parameters_equal(agent, its)


def test_acting_is_captured_again_where_rows_have_other_tasks(small_agent):
    one, other = confounding(), confounding(goal=(2, 2))
    env = CTGraphEnv([one] * 2, task_pool=[one, other])
    agent = small_agent("ppo", [one])
    act = CapturedAct(env, agent.policy, make_start(env, agent.initial_state))
    regions = []

    for task in (one, other, None):
        if task is not None:
            env.set_tasks([task] * 2)
        act(dict(env.reset().items(True, True)))
        regions.append(act._region)

    assert regions[0] is not regions[1]
    assert regions[1] is regions[2]
