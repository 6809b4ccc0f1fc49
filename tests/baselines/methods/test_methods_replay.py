"""Replay, all tasks at once, what methods store, and compiled steps."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import pytest
import torch
from helpers.scripted import ONE, THREE, TWO, of
from helpers.small_agents import (
    TASKS,
    batches,
    others_slow,
    same,
    saved_and_loaded,
    small,
    stay,
    weights_for,
    with_method,
)
from torch import Tensor

from baselines.methods.cka_rl import CKARL
from baselines.methods.clear import CLEAR, Reservoir
from baselines.methods.ewc import EWC
from baselines.methods.l2 import L2
from baselines.methods.mas import MAS
from baselines.methods.mask_amsc import MaskAMSC
from baselines.methods.mask_blc import MaskBLC
from baselines.methods.mask_lc import MaskLC
from baselines.methods.mask_ri import MaskRI
from baselines.methods.method import AgentWithMethod, Method
from baselines.methods.multitask import Multitask
from baselines.methods.packnet import PackNet
from baselines.methods.scratch import Scratch
from baselines.methods.si import SI
from ctgraph_rl import Block
from ctgraph_rl.learn.collect import collect, make_env
from ctgraph_rl.policies import OptimalPolicy

OF_EWC = {"coeff": 10.0, "online": False, "alpha": 0.5, "fisher": "policy", "num_samples": 16}

# The reservoir


OFFERS = {
    "one by one": [1] * 12,
    "more than there is room for": [12],
    "odd sizes": [3, 1, 4, 2, 2],
}


@pytest.mark.slow
@pytest.mark.parametrize("offers", OFFERS.values(), ids=OFFERS)
def test_every_item_is_kept_with_the_same_chance_and_every_pair_too(offers):
    """12 items and 3 places: an item is kept with chance 1/4, a pair with 3/12 * 2/11."""
    torch.manual_seed(0)
    trials, capacity, total = 1000, 3, 12
    kept, early = torch.zeros(total), []

    for _ in range(trials):
        reservoir, start = Reservoir(capacity), 0
        for number in offers:
            reservoir.offer({"item": torch.arange(start, start + number)})
            start += number
        held = reservoir.items["item"]
        assert len(held.unique()) == capacity == len(reservoir)
        kept[held] += 1
        early.append((held < total // 2).sum())

    # Chi-square of draws without replacement, 11 degrees of freedom: above 49.0 with a chance of 1e-6.
    chance = capacity / total
    off = (kept - trials * chance).square().sum() / (trials * chance * (1 - chance))
    assert off * (total - 1) / total < 49.0
    # How many are of the first half is hypergeometric: mean 1.5, variance 27/44; that of its square is below 0.8**2.
    gap = torch.stack(early) - 1.5
    assert abs(gap.mean()) < 5 * math.sqrt(27 / 44 / trials)
    assert abs(gap.square().mean() - 27 / 44) < 5 * 0.8 / math.sqrt(trials)


def test_a_reservoir_keeps_all_items_until_it_is_full_and_keys_together():
    torch.manual_seed(0)
    reservoir = Reservoir(10)
    for start in (0, 4, 8, 12):
        number = torch.arange(start, start + 4)
        reservoir.offer({"number": number, ("next", "square"): (number**2).unsqueeze(-1).float()})
        if start < 8:
            assert reservoir.items["number"][: start + 4].tolist() == list(range(start + 4))
        assert len(reservoir) == min(start + 4, 10)

    number, square = reservoir.items.values()

    assert torch.equal(square[:, 0], number.float() ** 2)
    assert reservoir.offered == 16


def test_samples_are_drawn_alike_from_what_is_there():
    torch.manual_seed(0)
    reservoir = Reservoir(50)
    reservoir.offer({"item": torch.arange(4) + 7})

    drawn = reservoir.sample(40_000)["item"]

    assert drawn.bincount(minlength=12)[7:11].tolist() == pytest.approx([10_000] * 4, abs=500)  # over 5 deviations
    assert drawn.min() == 7 and drawn.max() == 10


# Behaviour cloning


def cloning(compose, agent: str, **settings: float) -> tuple[AgentWithMethod, dict[str, Tensor], dict[Any, Tensor]]:
    """An agent with a batch of 128 steps in its reservoir, its losses, and what was replayed."""
    method = CLEAR(**{"buffer_size": 128, "policy_coeff": 1.0, "value_coeff": 1.0, **settings})
    attached = with_method(compose, agent, method)
    method.on_batch(batches(attached, ONE, 1)[0])
    torch.manual_seed(1)
    mixed = method.transform_minibatch({"action": torch.zeros(6, dtype=torch.int64)})
    replayed = {key[1]: value for key, value in mixed.items() if isinstance(key, tuple) and key[0] == "replay"}
    return attached, mixed, replayed


def test_the_memory_that_replay_asks_for_is_that_of_its_images_and_states(compose, monkeypatch):
    asked = []
    monkeypatch.setattr("baselines.methods.clear.require_memory", lambda what, size, fix: asked.append((what, size)))

    states = []
    for agent in ("ppo", "lstm_ppo"):
        attached = with_method(compose, agent, CLEAR(buffer_size=128, policy_coeff=1.0, value_coeff=1.0))
        states.append(sum(each[0].nbytes for each in attached.agent.initial_state(3).values()))

    image = batches(attached, ONE, 1)[0]["observation"][0, 0].nbytes
    assert states[0] == 0 < states[1]
    assert asked == [("replay of buffer_size=128 steps", 128 * (image + state)) for state in states]


@pytest.mark.parametrize("agent", ["a2c", "dqn", "lstm_ppo", "ppo"])
def test_cloning_loses_nothing_right_after_storing(compose, agent):
    attached, mixed, replayed = cloning(compose, agent)

    losses = attached.method.penalties(mixed, attached.agent.weights)

    names = ["loss_policy_cloning", "loss_value_cloning"] if agent != "dqn" else ["loss_value_cloning"]
    assert list(losses) == names
    assert all(abs(loss.item()) < 1e-7 for loss in losses.values())
    assert all(len(value) == 6 for value in replayed.values())


def change(attached: AgentWithMethod) -> None:
    """Other weights."""
    weights = attached.method.weights
    weights.write(weights.vector() + 0.3 * torch.randn(len(weights), generator=torch.Generator().manual_seed(2)))


@pytest.mark.parametrize("agent", ["lstm_ppo", "ppo"])
def test_cloning_losses_are_the_divergence_of_the_policies_and_the_squared_error_of_values(compose, agent):
    attached, mixed, replayed = cloning(compose, agent, policy_coeff=0.5, value_coeff=3.0)
    change(attached)

    losses = attached.method.penalties(mixed, attached.agent.weights)

    now = attached.agent.outputs(replayed)
    old, new = (torch.distributions.Categorical(logits=each["log_probs"]) for each in (replayed, now))
    divergence = torch.distributions.kl_divergence(old, new)
    assert divergence.min() > 1e-4
    torch.testing.assert_close(losses["loss_policy_cloning"], 0.5 * divergence.mean())
    error = (replayed["state_value"] - now["state_value"]) ** 2
    torch.testing.assert_close(losses["loss_value_cloning"], 3 * error.mean())
    gradients = torch.autograd.grad(sum(losses.values()), attached.agent.weights)
    assert all(gradient.any() for gradient in gradients)


def test_a_q_learner_clones_its_action_values(compose):
    attached, mixed, replayed = cloning(compose, "dqn", value_coeff=3.0)
    change(attached)

    losses = attached.method.penalties(mixed, attached.agent.weights)

    error = (replayed["action_value"] - attached.agent.values(replayed)) ** 2
    assert list(losses) == ["loss_value_cloning"] and error.shape == (6, 3)
    torch.testing.assert_close(losses["loss_value_cloning"], 3 * error.mean())


def test_what_is_replayed_are_steps_that_were_seen_with_what_was_said_then(compose):
    attached, _, replayed = cloning(compose, "ppo")
    batch = batches(attached, ONE, 1)[0]
    said = attached.agent.outputs({"observation": batch["observation"].flatten(0, 1)})["log_probs"]

    known = {
        (*map(float, o), *p) for o, p in zip(batch["observation"].flatten(0, 1).tolist(), said.tolist(), strict=True)
    }
    found = [
        (*map(float, o), *p)
        for o, p in zip(replayed["observation"].tolist(), replayed["log_probs"].tolist(), strict=True)
    ]

    assert all(min(math.dist(one, other) for other in known) < 1e-6 for one in found)


def test_every_gradient_step_replays_as_many_items_as_it_has_fresh_ones(compose):
    attached = with_method(compose, "ppo", CLEAR(buffer_size=64, policy_coeff=1.0, value_coeff=1.0))
    sizes, loss = Counter(), attached.method.penalties

    def counted(batch, weights):
        sizes.update([len(batch["replay", "log_probs"])])
        return loss(batch, weights)

    attached.method.penalties = counted

    attached.learn(batches(attached, ONE, 1)[0])

    assert sizes == {attached.agent.minibatch_size: 8}


# All tasks at once


def test_multitask_is_one_block_in_which_all_tasks_are_met_equally_often():
    curriculum = of(Block(ONE, 80), Block(THREE, 120), Block(TWO, 56), Block(ONE, 44), task_id="one_hot")
    at_once = Multitask().prepare(curriculum)
    env = make_env(at_once, at_once.blocks[0].rows(4), 0)
    env.switch_tasks(at_once.blocks[0].tasks, at_once.blocks[0].switch)

    batch = next(collect(env, OptimalPolicy(env), 4 * 600, 600))

    assert len(at_once.blocks) == 1 and at_once.num_frames == 300
    assert at_once.tasks == curriculum.tasks == (ONE, THREE, TWO)
    assert at_once.task_ids == curriculum.task_ids and at_once.evaluation == curriculum.evaluation
    began = batch["is_init"].squeeze(-1)
    for row, first in zip(batch["task_id"], began, strict=True):
        order = row[first].argmax(dim=-1)
        assert order.tolist() == [number % 3 for number in range(len(order))] and len(order) > 100


# What is stored


def nbytes(value: Any) -> int:
    """Of all tensors in nested plain values."""
    if isinstance(value, Tensor):
        return value.nbytes
    values = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else ()
    return sum(map(nbytes, values))


HEADS, WEIGHTS, LAYERS = 8 * 4 + 4, 8 * 5 + 8 + 8 * 8 + 8 + 8 * 4 + 4, 8
"""Numbers of the small PPO's output layers and of all; its weight tensors."""

COUNTED = {
    "CLEAR": (lambda: CLEAR(buffer_size=100, policy_coeff=1.0, value_coeff=1.0), 100 * (5 + 4 * 3 + 4)),
    "EWC": (lambda: EWC(**OF_EWC, heads="single"), 12 * WEIGHTS),
    "EWC online": (lambda: EWC(**{**OF_EWC, "online": True}, heads="single"), 12 * WEIGHTS),
    "EWC multi": (lambda: EWC(**OF_EWC, heads="multi"), 12 * WEIGHTS + 3 * 4 * HEADS),
    "L2": (lambda: L2(coeff=1, heads="single"), 12 * WEIGHTS),
    "MAS": (lambda: MAS(coeff=1, num_samples=16, heads="single"), 12 * WEIGHTS),
    "MaskBLC": (MaskBLC, (3 + 2) * 4 * WEIGHTS + 3 * 4 * LAYERS),
    "MaskLC": (MaskLC, (3 + 2) * 4 * WEIGHTS + 3 * 4 * LAYERS),
    "MaskRI": (MaskRI, (3 + 2) * 4 * WEIGHTS),
    "Multitask": (Multitask, 0),
    "None": (Method, 0),
    "PackNet": (lambda: PackNet(retrain=0.5), 8 * WEIGHTS + 3 * 4 * HEADS),
    "SI": (lambda: SI(coeff=1, epsilon=1, heads="single"), 28 * WEIGHTS),
    "Scratch": (Scratch, 3 * 4 * WEIGHTS),
}
"""Methods, and the bytes that their docstrings count for three tasks."""


@pytest.mark.parametrize("name", others_slow(COUNTED, "CLEAR", "EWC multi", "MaskLC", "PackNet", "SI"))
def test_what_is_stored_is_what_is_counted(compose, name):
    make, counted = COUNTED[name]
    method = make()
    if name in ("None", "Multitask"):
        attached = AgentWithMethod(small(compose, "ppo"), method, of(*(Block(task, 160) for task in TASKS)))
    else:
        attached = with_method(compose, "ppo", method)
    assert len(attached.method.weights) == WEIGHTS and len(attached.method.weights.parameters) == LAYERS

    for number in range(3):
        stay(attached, number)

        assert nbytes(dict(method.state_dict())) == counted


def test_the_samples_of_a_task_are_stored_until_its_end(compose):
    method = EWC(**{**OF_EWC, "num_samples": 20}, heads="single")
    attached = with_method(compose, "ppo", method)
    attached.start_task(0)

    attached.learn(batches(attached, ONE, 1)[0])

    # 32 frames, the last minibatch: observation, action, chance, advantage, target.
    assert nbytes(method.get_extra_state()) == 32 * (5 + 8 + 3 * 4)
    held = [value for minibatch in method.samples.minibatches for value in minibatch.values()]
    assert all(value.untyped_storage().nbytes() == value.nbytes for value in held)


# Compiled steps


AMSC = {"distance": "cosine", "z_score": True, "temperature": 1.0, "shuffled": False, "every": 1, "embedding": "lwe"}
AMSC |= {"competence": "none", "competence_batches": 1, "num_samples": 8, "buffer_size": 64}
AMSC |= {"num_references": 4, "num_directions": 4, "num_quantiles": 4}

COMPILED = {
    "cka_rl": (lambda: CKARL(scope="all", pool_size=2, scale=1.0, random_alpha=False, alpha_rate=1.0)),
    "clear": (lambda: CLEAR(buffer_size=64, policy_coeff=1.0, value_coeff=1.0)),
    "ewc": (lambda: EWC(**OF_EWC, heads="multi")),
    "mask_amsc": (lambda: MaskAMSC(**AMSC)),
    "mask_lc": MaskLC,
    "mask_ri": MaskRI,
    "packnet": (lambda: PackNet(retrain=0.5)),
    "si": (lambda: SI(coeff=10.0, epsilon=0.1, heads="single")),
}


COMBINING = ("cka_rl", "mask_amsc", "mask_lc")
"""Methods that compute something else in each of three tasks, and when the first one comes back."""


def two_tasks(compose, name: str, *overrides: str) -> AgentWithMethod:
    attached = with_method(compose, "ppo", COMPILED[name](), TASKS, *overrides)
    for number in range(2):
        torch.manual_seed(number)
        stay(attached, number)
    return attached


def check_close(one: AgentWithMethod, other: AgentWithMethod) -> None:
    """Equal up to rounding: weights of all tasks, and the method's buffers."""
    for found, expected in zip(one.agent.parameters(), other.agent.parameters(), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-3)
    for found, expected in zip(one.method.buffers(), other.method.buffers(), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-2)


@pytest.mark.parametrize("name", others_slow(COMPILED, "cka_rl", "ewc"))
def test_the_step_that_is_compiled_does_with_a_method_what_the_eager_one_does(compose, monkeypatch, name):
    eager = two_tasks(compose, name)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    whole = two_tasks(compose, name)

    check_close(whole, eager)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["packnet", "mask_lc"])
def test_a_compiled_agent_with_a_method_goes_on_from_a_saved_state(compose, compile_by, name):
    compile_by("eager")
    whole, resumed = (with_method(compose, "ppo", COMPILED[name](), TASKS, "agent.compile=true") for _ in range(2))
    torch.manual_seed(1)
    stay(whole, 0)
    whole.start_task(1)
    first, second = batches(whole, TWO, 2)
    whole.learn(first)
    resumed.load_state_dict(saved_and_loaded(whole.state_dict()))

    for attached in (whole, resumed):
        torch.manual_seed(2)
        attached.learn(second)
        attached.end_task()

    for number in range(2):
        assert same(weights_for(resumed, number), weights_for(whole, number))


@pytest.mark.parametrize(
    ("name", "order"),
    [
        pytest.param("mask_ri", (0, 1), marks=pytest.mark.slow),
        *(pytest.param(name, (0, 1, 2, 0), marks=pytest.mark.slow) for name in ("cka_rl", "packnet")),
    ],
)
def test_tasks_and_agents_of_one_structure_share_a_compiled_step(compose, compile_by, name, order):
    compiled = []
    compile_by(lambda graph, *_, **__: compiled.append(graph) or graph)

    for _ in range(2):
        attached = with_method(compose, "ppo", COMPILED[name](), TASKS, "agent.compile=true")
        for number in order:
            stay(attached, number)

    assert len(compiled) == (4 if name in COMBINING else 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["clear", "mask_lc"])
def test_compiled_steps_with_a_method_equal_eager_ones_but_for_rounding(compose, compile_by, name):
    compile_by("aot_eager")
    eager, compiled = two_tasks(compose, name), two_tasks(compose, name, "agent.compile=true")

    assert compiled.agent.compiled_step is not None
    check_close(compiled, eager)
