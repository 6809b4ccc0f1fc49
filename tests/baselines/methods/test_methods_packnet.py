"""PackNet's shares of a network, and networks from scratch."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from helpers.scripted import ONE, THREE
from helpers.small_agents import TASKS, batches, same, small, stay, weights_for, with_method

from baselines.methods.finetune import Finetune
from baselines.methods.method import AgentWithMethod
from baselines.methods.packnet import FREE, PackNet
from baselines.methods.scratch import Scratch


def packed(compose, agent: str = "ppo", retrain: float = 0.5) -> tuple[AgentWithMethod, PackNet]:
    method = PackNet(retrain=retrain)
    return with_method(compose, agent, method), method


@pytest.mark.parametrize("agent", ["dqn", pytest.param("lstm_ppo", marks=pytest.mark.slow)])
def test_each_task_keeps_an_equal_share_of_every_weight_matrix(compose, agent):
    attached, method = packed(compose, agent)
    for number in range(3):
        stay(attached, number)

    of_parameters = zip(
        method.weights.names, method.weights.parameters, method.weights.split(method.owner), strict=True
    )
    for name, parameter, owner in of_parameters:
        counts = [int((owner == place).sum()) for place in (FREE, 0, 1, 2)]
        if name in method.weights.head_names:
            assert counts == [parameter.numel(), 0, 0, 0]
        elif parameter.ndim == 1:
            assert counts == [0, parameter.numel(), 0, 0]
        else:
            assert counts[0] == 0 and all(abs(count - parameter.numel() / 3) < 1 for count in counts[1:])


def test_the_largest_free_weights_are_kept_and_the_others_are_zero(compose):
    attached, method = packed(compose)
    attached.start_task(0)
    attached.learn(batches(attached, ONE, 1)[0])
    trained = [parameter.detach().clone() for parameter in method.weights.parameters]

    attached.end_task()

    for name, before, now, owner in zip(
        method.weights.names, trained, method.weights.parameters, method.weights.split(method.owner), strict=True
    ):
        kept = owner.view_as(before) == 0
        if name in method.weights.head_names or before.ndim == 1:
            assert torch.equal(now, before)
        else:
            assert before[kept].abs().min() >= before[~kept].abs().max()
            assert torch.equal(now, torch.where(kept, before, 0.0))


def test_kept_weights_are_bit_equal_after_later_tasks_and_later_ones_begin_at_zero(compose):
    attached, method = packed(compose)
    stay(attached, 0)
    trunk = ~method.in_heads
    kept, first = (method.owner == 0) & trunk, method.weights.vector().detach()
    stay(attached, 1)
    second = method.weights.vector().detach()
    free = (method.owner == FREE) & trunk
    stay(attached, 2)

    last = method.weights.vector().detach()

    assert torch.equal(second[kept], first[kept]) and torch.equal(last[kept], first[kept])
    own = (method.owner == 1) & trunk
    assert not first[own].any() and second[own].any() and torch.equal(last[own], second[own])
    assert not first[free].any() and not second[free].any()


@pytest.mark.parametrize("method", [PackNet(retrain=0.5), Finetune(trunk="kept")])
def test_a_step_is_undone_in_the_weights_that_the_hook_gets(compose, method):
    attached = with_method(compose, "a2c", method)
    stay(attached, 0)
    attached.start_task(1)
    before = method.weights.vector().detach()
    given = [torch.ones_like(parameter) for parameter in method.weights.parameters]

    method.after_step(given)

    assert torch.equal(method.weights.vector(), before)
    assert any((each != 1).any() for each in given)


def test_a_kept_trunk_stays_after_the_first_task_and_output_layers_learn_on(compose):
    method = Finetune(trunk="kept")
    attached = with_method(compose, "ppo", method)
    start = method.weights.vector().detach()
    stay(attached, 0)
    first = method.weights.vector().detach()
    stay(attached, 1)
    last = method.weights.vector().detach()

    heads = method.in_heads
    assert not torch.equal(first[~heads], start[~heads])
    assert torch.equal(last[~heads], first[~heads])
    assert not torch.equal(last[heads], first[heads])


@pytest.mark.parametrize(("retrain", "number_of_prunings"), [(0.5, 2), (0.0, 4), (0.75, 1)])
def test_pruning_leaves_a_share_of_the_block_for_retraining(compose, retrain, number_of_prunings):
    """Blocks of 160 frames are announced; batches have 16."""
    method = PackNet(retrain=retrain)
    shape = ("agent.num_envs=4", "agent.num_steps=10", "agent.num_minibatches=1")
    attached = with_method(compose, "ppo", method, TASKS, *shape)
    attached.start_task(0)

    pruned = []
    for batch in batches(attached, ONE, 4):
        attached.learn(batch)
        pruned.append(bool((method.owner == 0).any()))
    before = method.weights.vector().detach()
    attached.end_task()

    assert pruned == [number >= number_of_prunings for number in range(4)]
    zero = (method.owner == FREE) & ~method.in_heads
    assert bool(before[zero].any()) == (retrain == 0)  # pruned at the end only
    assert not method.weights.vector()[zero].any()


def test_pruned_weights_stay_zero_and_kept_ones_are_trained_further(compose):
    attached, method = packed(compose, retrain=0.999)
    attached.start_task(0)
    one, other, more = batches(attached, ONE, 3)
    attached.learn(one)
    attached.learn(other)
    kept, free = (method.owner == 0) & ~method.in_heads, (method.owner == FREE) & ~method.in_heads
    before = method.weights.vector().detach()

    attached.learn(more)

    after = method.weights.vector().detach()
    assert kept.any() and free.any()
    assert not before[free].any() and not after[free].any()
    assert not torch.equal(after[kept], before[kept])


def test_a_returning_task_trains_its_output_layers_alone_on_the_network_that_it_acts_with(compose):
    attached, method = packed(compose)
    for number in range(3):
        stay(attached, number)
    inside, packed_before, owner = method.in_heads, method.packed.clone(), method.owner.clone()
    acted, others = attached.policy_for(0), [weights_for(attached, number) for number in (1, 2)]
    had = torch.cat([dict(acted.named_parameters())[name].flatten() for name in method.weights.names]).detach().clone()

    attached.start_task(0)
    for batch in batches(attached, ONE, 2):
        attached.learn(batch)
    trained = method.weights.vector().detach()
    attached.end_task()

    assert torch.equal(trained[~inside], had[~inside])
    assert not torch.equal(trained[inside], had[inside])
    assert torch.equal(method.packed, packed_before) and torch.equal(method.owner, owner)
    assert all(same(weights_for(attached, number), weights) for number, weights in zip((1, 2), others, strict=True))


def test_a_new_task_draws_a_new_network_and_forgets_the_optimisers_state(compose):
    begun_with = [weights.detach().clone() for weights in small(compose, "ppo").policy.parameters()]
    attached = with_method(compose, "ppo", Scratch())

    attached.start_task(0)
    assert same([*attached.policy.parameters()], begun_with)
    stay(attached, 0)
    first = weights_for(attached, 0)
    attached.start_task(1)
    drawn = weights_for(attached, 1)

    for was, learned, now in zip(begun_with, first, drawn, strict=True):
        assert not (now == was).any() and not (now == learned).any()
        inputs = now.shape[1] if now.ndim == 2 else None
        assert inputs is None or 0 < now.abs().max() <= inputs**-0.5  # as PyTorch draws linear layers
    assert not any(value.any() for state in attached.agent.optimiser.state.values() for value in state.values())


def test_a_task_from_scratch_is_learned_as_by_a_new_agent_with_those_weights(compose):
    attached, alone = with_method(compose, "ppo", Scratch()), small(compose, "ppo")
    stay(attached, 0)
    attached.start_task(1)
    alone.policy.load_state_dict(deepcopy(attached.policy.state_dict()))
    given = batches(attached, THREE, 2)

    for agent in (attached, alone):
        torch.manual_seed(5)
        for batch in given:
            agent.learn(batch)

    assert same([*attached.policy.parameters()], [*alone.policy.parameters()])
