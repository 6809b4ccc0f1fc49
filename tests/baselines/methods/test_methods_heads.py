"""Output layers of each task's own, of the methods that hold the weights."""

from __future__ import annotations

import pytest
import torch
from helpers.scripted import ONE, THREE, TWO
from helpers.small_agents import stay, tiny, weights_for, with_method

from baselines.methods.ewc import EWC
from baselines.methods.l2 import L2
from baselines.methods.mas import MAS
from baselines.methods.si import SI

EWC_SETTINGS = {"online": False, "alpha": 0.5, "fisher": "policy", "num_samples": 100, "heads": "single"}


MULTI = {
    "ewc": lambda: EWC(coeff=10, **{**EWC_SETTINGS, "num_samples": 8, "heads": "multi"}),
    "l2": lambda: L2(coeff=0.1, heads="multi"),
    "mas": lambda: MAS(coeff=1, num_samples=8, heads="multi"),
    "si": lambda: SI(coeff=10, epsilon=0.1, heads="multi"),
}


@pytest.mark.parametrize(
    ("agent", "name"),
    [
        pytest.param(agent, name, marks=[pytest.mark.slow] if (place + number) % 3 else [])
        for place, agent in enumerate(("dqn", "ppo", "lstm_ppo"))
        for number, name in enumerate(MULTI)
    ],
)
def test_output_layers_are_swapped_with_the_task_and_not_held(compose, agent, name):
    attached = with_method(compose, agent, MULTI[name]())
    method, inside = attached.method, attached.method.weights.in_heads
    begun_with = method.weights.vector().detach()[inside]

    stay(attached, 0)
    first = method.weights.vector().detach()
    assert not torch.equal(first[inside], begun_with)
    attached.start_task(1)
    assert torch.equal(method.weights.vector()[inside], begun_with)
    assert torch.equal(method.weights.vector()[~inside], first[~inside])
    stay(attached, 1)
    second = method.weights.vector().detach()

    acted = torch.cat([weights.flatten() for weights in weights_for(attached, 0)])
    assert method.importance[~inside].any() and not method.importance[inside].any()
    attached.start_task(0)
    assert torch.equal(method.weights.vector()[inside], first[inside])
    assert torch.equal(method.weights.vector()[~inside], second[~inside])
    assert torch.equal(acted, torch.cat([parameter.flatten() for parameter in attached.policy.parameters()]))


def test_the_output_layers_are_the_last_layers_of_policy_and_critic(compose):
    found = {}
    for agent in ("a2c", "dqn", "lstm_ppo", "ppo"):
        weights = with_method(compose, agent, L2(coeff=1, heads="multi")).method.weights
        found[agent] = sorted(tuple(parameter.shape) for parameter in weights.in_head_parameters)

    heads = [(1,), (1, 8), (3,), (3, 8)]
    assert found == {"a2c": heads, "dqn": [(3,), (3, 8)], "lstm_ppo": heads, "ppo": heads}


def test_the_optimiser_forgets_former_output_layers_and_nothing_else(compose):
    attached = with_method(compose, "ppo", L2(coeff=0.1, heads="multi"))
    stay(attached, 0)

    attached.start_task(1)

    state, heads = attached.agent.optimiser.state, attached.method.weights.in_head_parameters
    known = {parameter: any(value.any() for value in state[parameter].values()) for parameter in attached.agent.weights}
    assert [known[parameter] for parameter in heads] == [False] * 4
    assert all(known[parameter] for parameter in known if not any(parameter is head for head in heads))


def test_the_target_network_gets_the_task_s_output_layers(compose):
    attached = with_method(compose, "dqn", L2(coeff=0.1, heads="multi"))
    stay(attached, 0)

    attached.start_task(1)

    agent = attached.agent
    assert all(map(torch.equal, agent.target.parameters(), agent.greedy.parameters()))


def test_an_agent_without_layers_behind_a_trunk_has_no_output_layers_to_swap():
    with pytest.raises(
        ValueError, match="Tiny has no output layers behind a trunk, so tasks cannot have their own: take a method"
    ):
        tiny(L2(coeff=1, heads="multi"))


def test_a_task_that_never_began_is_acted_in_with_output_layers_that_have_learned_nothing(compose):
    attached = with_method(compose, "ppo", L2(coeff=0.1, heads="multi"), (ONE, TWO, THREE))
    method, inside = attached.method, attached.method.weights.in_heads
    begun_with = method.weights.vector().detach()[inside]
    stay(attached, 0)
    stay(attached, 1)

    unseen, present = method.task_weights(2), method.weights.vector()

    assert torch.equal(unseen[inside], begun_with)
    assert torch.equal(unseen[~inside], present[~inside])
    assert not torch.equal(unseen[inside], present[inside])
