"""CKA-RL: weights of the first task, a vector of the task's own and a mixture of earlier ones."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers.scripted import TWO
from helpers.small_agents import CURRICULUM, RATE, Tiny, batches, same, seen, small, stay, weights_for, with_method
from torch import Tensor
from torch.testing import assert_close

from baselines.methods.cka_rl import CKARL, merged
from baselines.methods.finetune import Finetune
from baselines.methods.method import AgentWithMethod
from baselines.methods.parts.weights import flat


def cka(**changes: Any) -> CKARL:
    """The method over all weights, with equal shares at first."""
    return CKARL(**{"scope": "all", "pool_size": 3, "scale": 2.0, "random_alpha": False, "alpha_rate": 0.5, **changes})


def behind(number: int, **changes: Any) -> AgentWithMethod:
    """A `Tiny` agent in a task behind the first one, with so many random vectors in the pool."""
    torch.manual_seed(0)
    attached = AgentWithMethod(Tiny(), cka(**changes), CURRICULUM)
    its = attached.method
    attached.start_task(0)
    attached.end_task()
    with torch.no_grad():
        its.pool.copy_(torch.randn(its.pool.shape))
    its.num_pooled = number
    attached.start_task(1)
    return attached


def network(attached: AgentWithMethod) -> Tensor:
    return attached.method.weights.vector().detach()


@pytest.mark.parametrize("scope", ["all", "actor_head"])
@pytest.mark.parametrize("agent", ["a2c", "dqn"])
def test_the_first_task_has_the_bits_of_the_agent_alone(compose, agent, scope):
    attached, alone = with_method(compose, agent, cka(scope=scope)), with_method(compose, agent, Finetune())

    for each in (attached, alone):
        torch.manual_seed(0)
        stay(each, 0)

    assert same(list(attached.policy.parameters()), list(alone.policy.parameters()))


def test_with_an_empty_pool_the_second_task_trains_the_weights_of_the_first():
    attached, minibatch = behind(0), seen(6)
    before = network(attached)

    attached.agent.gradient_step(minibatch)

    assert torch.equal(before, attached.method.base)
    of_weight = (minibatch["factor"].T @ minibatch["observation"] / 6).flatten()
    assert_close(network(attached)[:6], before[:6] - RATE * of_weight)
    assert not attached.method.alpha.any()


def test_with_one_vector_nothing_depends_on_alpha():
    attached = behind(1)
    its, before = attached.method, network(attached)
    assert_close(before, its.base + its.pool[0])

    with torch.no_grad():
        its.alpha.fill_(-7.0)
    its.after_step(its.weights.parameters)

    assert torch.equal(network(attached), before)
    assert not its.transform_gradients([torch.ones(3, 2), torch.ones(3)], its.weights.parameters)[-1].any()


def test_with_vectors_of_zeros_the_weights_are_those_of_the_first_task_and_the_own_vector():
    attached = behind(3)
    its = attached.method
    own = torch.randn(9)

    with torch.no_grad():
        its.pool.zero_()
        for part, value in zip(its.own, its.weights.split(its.base + own), strict=True):
            part.copy_(value.view_as(part))
    its.after_step(its.weights.parameters)

    assert_close(network(attached), its.base + own)


def test_gradients_are_those_of_autograd():
    its = behind(3).method
    alpha, own = (torch.randn(n, dtype=torch.float64, requires_grad=True) for n in (3, 9))
    gradient, pool = torch.randn(9), its.pool.double()

    value = (own + (2.0 * 0.5 * alpha).softmax(0) @ pool) @ gradient.double()
    of_alpha, of_own = torch.autograd.grad(value, [alpha, own])

    with torch.no_grad():
        its.alpha.copy_(alpha)
    parts = [part.view_as(each) for part, each in zip(its.weights.split(gradient), its.own, strict=True)]
    found = its.transform_gradients(parts, its.weights.parameters)
    assert_close(found[-1].double(), of_alpha, atol=1e-6, rtol=1e-5)
    assert_close(flat(found[:-1]).double(), of_own)


def test_a_step_trains_the_own_vector_and_the_mixture_and_the_pool_gets_the_own_vector_alone():
    attached, minibatch = behind(2), seen(6)
    its, pool = attached.method, attached.method.pool.clone()
    assert_close(network(attached), its.base + pool[:2].mean(dim=0))

    for _ in range(2):
        attached.agent.gradient_step(minibatch)
    assert its.alpha[:2].any() and not its.alpha[2]
    own, shares = flat(list(its.own)).detach(), (2.0 * 0.5 * its.alpha[:2]).softmax(dim=0).detach()
    weights = network(attached)
    attached.end_task()

    assert_close(weights, own + shares @ pool[:2])
    assert torch.equal(its.kept[1], weights) and torch.equal(network(attached), weights)
    assert its.num_pooled == 3
    assert_close(its.pool, torch.stack([pool[0], pool[1], own - its.base]))


def test_a_full_pool_merges_the_two_most_similar_vectors():
    vectors = torch.tensor([[1.0, 0.0, 0.0], [0.0, 3.0, 0.0], [-1.0, -1.0, 0.0], [0.5, 0.0, 0.1]])
    assert_close(merged(vectors), torch.tensor([[0.0, 3.0, 0.0], [-1.0, -1.0, 0.0], [0.75, 0.0, 0.05]]))

    attached = behind(3)
    attached.end_task()

    assert attached.method.num_pooled == 3


def test_alpha_starts_at_random_where_that_is_set():
    its = behind(3, random_alpha=True).method

    torch.manual_seed(5)
    its.start_task(2)

    torch.manual_seed(5)
    assert_close(its.alpha.detach() * 0.5, torch.randn(3) / 3)


def test_the_actor_head_alone_is_of_the_task_and_the_rest_is_carried_over(compose):
    attached = with_method(compose, "a2c", cka(scope="actor_head"))
    names = [name for name, _ in attached.policy.named_parameters()]
    assert sum(attached.method.inside) == 2 and len(attached.method.base) == 3 * 8 + 3
    stored = [*attached.method.buffers(), *attached.method.parameters()]
    assert sum(each.nbytes for each in stored) == 20 * 27 + 12 + 3 * 4 * 27
    stay(attached, 0)
    first = weights_for(attached, 0)
    attached.start_task(1)
    assert same(weights_for(attached, 1), first)

    for batch in batches(attached, TWO, 2):
        attached.learn(batch)

    present = weights_for(attached, 1)
    for name, old, shown, new in zip(names, first, weights_for(attached, 0), present, strict=True):
        assert torch.equal(shown, old if name.startswith("module.1.") else new)
        assert not torch.equal(old, new)


def test_an_agent_without_an_output_layer_is_refused_unless_all_weights_are_adapted(compose):
    with pytest.raises(ValueError, match="Tiny has no output layer behind a trunk for scope=actor_head: set scope=all"):
        AgentWithMethod(Tiny(), cka(scope="actor_head"), CURRICULUM)

    assert with_method(compose, "dqn", cka(scope="actor_head")).method.inside.count(True) == 2
    assert small(compose, "dqn").trainable
