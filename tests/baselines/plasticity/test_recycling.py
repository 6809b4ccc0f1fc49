"""Methods that write weights: what a step or a boundary changes, by hand; the errors of public versions fail here."""

from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from helpers.plastic import MOMENTS, equal, learned, minibatch_of, plastic, weights_of
from helpers.small_agents import CURRICULUM, others_slow, small

from baselines.parts.units import activations, hidden_layers
from baselines.plasticity.continual_backprop import ContinualBackprop, outgoing
from baselines.plasticity.fire import FIRE, isometry
from baselines.plasticity.fresh_optimiser import FreshOptimiser
from baselines.plasticity.layer_norm import LayerNorm
from baselines.plasticity.redo import ReDo, dormancy
from baselines.plasticity.shrink_and_perturb import ShrinkAndPerturb

NEVER = 1000  # gradient steps
NEUTRAL = {
    "shrink_and_perturb": lambda: ShrinkAndPerturb(1.0, 0.0, "step", False),
    "continual_backprop": lambda: ContinualBackprop(0.0, 0, 0.9, reset_moments=True),
    "redo": lambda: ReDo(10.0, NEVER, reset_moments=True),
}


@pytest.mark.parametrize("name", NEUTRAL)
def test_a_neutral_setting_changes_no_bit(compose, name):
    plain = learned(small(compose, "a2c"))

    assert equal(plain, learned(plastic(compose, NEUTRAL[name](), "a2c")))


def test_the_inputs_of_units_are_where_the_weights_have_moved(compose):
    torch.__future__.set_swap_module_params_on_conversion(True)
    try:
        agent = plastic(compose, NEUTRAL["redo"]()).to("meta")
    finally:
        torch.__future__.set_swap_module_params_on_conversion(False)

    assert {reader.columns.device.type for layer in agent.plasticity.layers for reader in layer.readers} == {"meta"}


def with_redo(compose, threshold: float, *agent: str, reset_moments: bool = True) -> tuple:
    """An agent that has learned from a batch, and acts from the next step on; and a minibatch."""
    made = plastic(compose, ReDo(threshold, NEVER, reset_moments=reset_moments), *agent)
    minibatch = minibatch_of(made)
    made.plasticity.period = 1
    return made, minibatch


def act(agent, minibatch: dict) -> float:
    """Let the plasticity act after a step; return the units that it recycled."""
    return agent.plasticity.after_step(minibatch, {"grad_norm": torch.tensor(0.0)})["recycled"].item()


def set_biases(layer, value: float, units: object = ...) -> None:
    """Of +-100 units are on, or off, for all inputs."""
    with torch.no_grad():
        layer.linear.bias[units] = value


def chosen(layers: list, number: int, *units: int) -> list[torch.Tensor]:
    """Units of one of the layers."""
    found = [torch.zeros(layer.num_units, dtype=torch.bool) for layer in layers]
    found[number][list(units)] = True
    return found


def test_redo_starts_dead_units_again_and_leaves_all_outputs(compose):
    agent, minibatch = with_redo(compose, 0.0)
    first, last = hidden_layers(agent.policy)
    set_biases(first, 100.0)
    set_biases(last, 100.0)
    set_biases(last, -1e6, [2, 5])
    outputs = agent.outputs(minibatch)
    rows = last.linear.weight[[2, 5]].clone()

    assert act(agent, minibatch) == 2

    assert all(torch.equal(value, outputs[key]) for key, value in agent.outputs(minibatch).items())
    assert not last.linear.bias[[2, 5]].any()
    new = last.linear.weight[[2, 5]]
    assert not (new == rows).any() and new.abs().max() <= 1 / math.sqrt(8) and new.abs().max() > 0.1
    assert len(last.readers) == 2  # actor and critic
    assert not any(reader.weight[:, [2, 5]].any() for reader in last.readers)


def test_redo_sets_the_moments_of_recycled_units_to_0_and_no_others(compose):
    agent, _ = with_redo(compose, 0.0)
    kept, _ = with_redo(compose, 0.0, reset_moments=False)
    for each in (agent, kept):
        each.plasticity.recycle(chosen(hidden_layers(each.policy), 1, 2, 5))
    last = hidden_layers(agent.policy)[1]

    changed = {id(last.linear.weight), id(last.linear.bias), *(id(reader.weight) for reader in last.readers)}
    for weight, old in zip(agent.trainable, kept.trainable, strict=True):
        for name in MOMENTS:
            expected = kept.optimiser.state[old][name].clone()
            assert expected.any()
            if id(weight) in changed:
                index = (slice(None), [2, 5]) if len(weight) < 8 else [2, 5]
                expected[index] = 0
            assert torch.equal(agent.optimiser.state[weight][name], expected)
        assert agent.optimiser.state[weight]["step"] == kept.optimiser.state[old]["step"] > 0


def test_redo_with_a_threshold_of_0_and_no_dead_unit_changes_no_bit(compose):
    agent, minibatch = with_redo(compose, 0.0)
    for layer in hidden_layers(agent.policy):
        set_biases(layer, 100.0)
    before = weights_of(agent)

    assert act(agent, minibatch) == 0

    assert equal(before, weights_of(agent))


def test_dormancy_is_normalised_by_the_mean_of_the_batch_and_not_of_each_frame():
    values = torch.tensor([[1.0, 9.0], [1.0, 0.0]])

    assert dormancy(values, torch.tensor([0.5, 0.5])).tolist() == pytest.approx([4 / 11, 18 / 11])
    assert dormancy(values, torch.tensor([0.1, 0.9])).tolist() == pytest.approx([1 / 0.95, 0.9 / 0.95])


@pytest.mark.parametrize(
    ("name", "number"), others_slow([("dqn", 0), ("dqn", 1), ("lstm_ppo", 0), ("ppo", 0)], ("dqn", 1))
)
def test_nothing_reads_a_live_unit_that_was_recycled(compose, name, number):
    agent, minibatch = with_redo(compose, 0.0, name)
    layer = hidden_layers(agent.policy)[number]
    set_biases(layer, 100.0)
    target = [value.clone() for value in agent.other_weights().values()]
    handle = layer.activation.register_forward_hook(lambda module, given, output: output.index_fill(-1, UNIT, 0.0))
    expected = agent.outputs(minibatch)
    handle.remove()
    assert not all(torch.allclose(value, expected[key]) for key, value in agent.outputs(minibatch).items())

    for _ in range(2):
        layers = agent.plasticity.layers
        assert agent.plasticity.recycle(chosen(layers, number, int(UNIT))) == 1
        for key, value in agent.outputs(minibatch).items():
            torch.testing.assert_close(value, expected[key], rtol=1e-5, atol=1e-4)
    assert equal(target, list(agent.other_weights().values()))


UNIT = torch.tensor(1)


def test_a_recycled_unit_behind_a_layer_norm_has_its_scale_and_offset_at_the_start(compose):
    agent = small(compose, "ppo")
    for plasticity in (LayerNorm(), ReDo(0.0, 1, reset_moments=True)):
        plasticity.attach(agent, CURRICULUM)
    norm = hidden_layers(agent.policy)[0].norm
    with torch.no_grad():
        norm.weight.fill_(3.0)
        norm.bias.fill_(4.0)

    agent.plasticity.recycle(chosen(agent.plasticity.layers, 0, 1))

    assert norm.weight.tolist() == [3.0, 1.0] + [3.0] * 6
    assert norm.bias.tolist() == [4.0, 0.0] + [4.0] * 6


@pytest.mark.parametrize("name", others_slow(["ppo", "lstm_ppo"], "ppo"))
def test_what_reads_a_unit_keeps_its_mean_inputs_when_continual_backprop_replaces_it(compose, name):
    agent = plastic(compose, ContinualBackprop(0.0, 0, 0.9, reset_moments=True), name)
    minibatch = minibatch_of(agent)
    [layer] = [each for each in agent.plasticity.layers if each.name == "encoder.1"]

    def mean_inputs() -> list[torch.Tensor]:
        values, shares = activations(agent.policy, minibatch)["encoder.1"]
        of_units = shares @ values
        return [(reader.weight[:, reader.columns[:, 0]] @ of_units + reader.bias).detach() for reader in layer.readers]

    found = activations(agent.policy, minibatch)
    means = [found[each.name][1] @ found[each.name][0] for each in agent.plasticity.layers]
    before = mean_inputs()
    live = int(means[0].argmax())

    agent.plasticity.recycle(chosen(agent.plasticity.layers, 0, live), means)

    for one, other in zip(before, mean_inputs(), strict=True):
        torch.testing.assert_close(one, other)


def test_continual_backprop_starts_with_the_utility_and_mean_of_one_step(compose):
    agent = plastic(compose, ContinualBackprop(0.0, 0, 0.75, reset_moments=True))
    minibatch = minibatch_of(small(compose, "ppo"))

    act(agent, minibatch)

    found = activations(agent.policy, minibatch)
    sizes = []
    for layer in agent.plasticity.layers:
        values, shares = found[layer.name]
        every = torch.cat([reader.weight for reader in layer.readers])
        sizes.append(every.abs().mean(dim=0) * (shares @ values.abs()))
    corrected = agent.plasticity.utility / (1 - 0.75)
    torch.testing.assert_close(corrected, torch.cat(sizes))
    assert len(every) == 4  # three actions, and the value


def test_continual_backprop_replaces_the_share_that_adds_up_over_the_steps(compose):
    rate, maturity = 0.13, 3
    agent = plastic(compose, ContinualBackprop(rate, maturity, 0.9, reset_moments=True))
    minibatch = minibatch_of(small(compose, "ppo"))
    total = 0
    ages = [0] * 8
    eligible = replaced = 0

    for _ in range(15):
        total += act(agent, minibatch)
        ages = [age + 1 for age in ages]
        mature = [unit for unit, age in enumerate(ages) if age > maturity]
        eligible += len(mature)
        for unit in mature[: math.floor(rate * eligible) - replaced]:
            ages[unit] = 0
            replaced += 1

    assert replaced > 5 and total == 2 * replaced
    assert agent.plasticity.replaced.tolist() == [replaced] * 2


def test_continual_backprop_counts_the_weights_of_both_heads(compose):
    agent = plastic(compose, ContinualBackprop(0.125, 0, 0.9, reset_moments=True))
    minibatch = minibatch_of(small(compose, "ppo"))
    last = agent.plasticity.layers[1]
    set_biases(last, 100.0)
    of_actor, of_critic = last.readers
    with torch.no_grad():
        of_actor.weight[:, 3] = 0.0
        of_critic.weight[:, 3] = 50.0
        of_actor.weight[:, 6] = of_critic.weight[:, 6] = 1e-6
    assert outgoing(last)[3].item() == pytest.approx(50 / 4)

    act(agent, minibatch)

    assert agent.plasticity.age[8:].tolist() == [1] * 6 + [0, 1]
    assert of_critic.weight[0, 3] == 50.0 and not of_critic.weight[:, 6].any()


@pytest.mark.parametrize("overrides", [(), ("+agent.orthogonal_init=true",)])
def test_shrink_and_perturb_by_0_and_1_draws_the_network_again(compose, overrides):
    agent = plastic(compose, ShrinkAndPerturb(0.0, 1.0, "boundary", False), "ppo", *overrides)
    initial = weights_of(agent)
    generator = deepcopy(agent.plasticity.generator)
    agent.plasticity.start_task()
    assert equal(initial, weights_of(agent))

    agent.plasticity.start_task()

    drawn = weights_of(agent)
    torch.manual_seed(int(torch.randint(2**62, (), generator=generator)))
    agent.reset_parameters()
    assert equal(drawn, weights_of(agent)) and not equal(drawn, initial)
    agent.plasticity.start_task()
    assert not equal(drawn, weights_of(agent))  # another draw each time


def test_shrink_and_perturb_mixes_present_and_new_weights_and_leaves_the_moments(compose):
    agent = plastic(compose, ShrinkAndPerturb(0.5, 0.25, "boundary", False), "dqn")
    learned(agent, 1)
    before = weights_of(agent.greedy)
    drawn = list(deepcopy(agent).plasticity.draw_weights().values())
    target = weights_of(agent.target)
    moments = [value.clone() for state in agent.optimiser.state.values() for value in state.values()]

    agent.plasticity.at_boundary()

    for weight, old, new in zip(agent.greedy.parameters(), before, drawn, strict=True):
        torch.testing.assert_close(weight.detach(), 0.5 * old + 0.25 * new)
    assert equal(target, weights_of(agent.target))
    assert equal(moments, [value for state in agent.optimiser.state.values() for value in state.values()])


def test_soft_shrink_and_perturb_shrinks_in_each_step_and_acts_at_no_boundary(compose):
    agent = plastic(compose, ShrinkAndPerturb(0.9, 0.0, "step", reset_moments=True))
    minibatch = minibatch_of(agent)
    before = weights_of(agent)
    agent.plasticity.start_task()
    agent.plasticity.start_task()
    assert equal(before, weights_of(agent))

    for _ in range(3):
        agent.plasticity.after_step(minibatch, {})

    for weight, old in zip(agent.parameters(), before, strict=True):
        torch.testing.assert_close(weight.detach(), 0.9**3 * old)
    assert not any(state[name].any() for state in agent.optimiser.state.values() for name in MOMENTS)


@pytest.mark.parametrize("shape", [(6, 4), (4, 6), (1, 5)])
def test_fire_makes_all_singular_values_the_root_of_outputs_by_inputs(shape):
    torch.manual_seed(0)
    matrix = torch.randn(*shape)

    found = isometry(matrix)

    values = torch.linalg.svdvals(found)
    torch.testing.assert_close(values, torch.full_like(values, math.sqrt(shape[0] / shape[1])), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(isometry(found), found)
    nearest = torch.linalg.svd(matrix, full_matrices=False)
    torch.testing.assert_close((nearest.U.T @ found @ nearest.Vh.T).diagonal(), values)


def test_fire_of_the_published_iterations_misses_small_singular_values():
    matrix = torch.diag(torch.tensor([1.0, 0.9, 1e-4]))

    assert torch.linalg.svdvals(isometry(matrix))[-1].item() == pytest.approx(1)
    published = torch.linalg.svdvals(isometry(matrix, iterations=10))
    assert published[0].item() == pytest.approx(1, abs=1e-4) and published[-1] < 0.01
    wide = torch.randn(3, 7)
    torch.testing.assert_close(isometry(wide, iterations=40), isometry(wide), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("heads", [True, False])
def test_fire_changes_matrices_and_no_biases(compose, heads):
    agent = plastic(compose, FIRE(None, heads=heads, reset_moments=False))
    before = dict(zip([name for name, _ in agent.named_parameters()], weights_of(agent), strict=True))

    agent.plasticity.at_boundary()

    for name, value in agent.named_parameters():
        is_head = name.startswith(("actor", "critic"))
        changes = name.endswith("weight") and (heads or not is_head)
        expected = isometry(before[name]) if changes else before[name]
        assert torch.equal(value, expected)
        assert torch.equal(value, before[name]) != changes


def test_a_fresh_optimiser_keeps_the_weights_and_starts_its_state(compose):
    agent = plastic(compose, FreshOptimiser())
    before = learned(agent, 1)
    agent.plasticity.start_task()
    assert all(value.any() for state in agent.optimiser.state.values() for value in state.values())

    agent.plasticity.start_task()

    assert equal(before, weights_of(agent))
    assert not any(value.any() for state in agent.optimiser.state.values() for value in state.values())


@pytest.mark.parametrize("name", others_slow(["ppo", "dqn", "lstm_ppo"], "dqn"))
def test_layer_norm_stands_before_each_relu(compose, name):
    agent = plastic(compose, LayerNorm(), name)
    minibatch = minibatch_of(agent)
    layers = [layer for layer in hidden_layers(agent.policy) if layer.linear is not None]
    written = []
    for layer in layers:
        with torch.no_grad():
            layer.linear.weight *= 1000  # 1e-5 in the variance is then nothing
            layer.norm.bias.zero_()
            layer.norm.weight.fill_(1.0)
        layer.norm.register_forward_hook(lambda module, given, output: written.append(output.detach()))
    before = agent.outputs(minibatch)
    for values in written:
        torch.testing.assert_close(values.mean(-1), torch.zeros_like(values[..., 0]), rtol=0, atol=1e-5)
        torch.testing.assert_close(values.var(-1, correction=0), torch.ones_like(values[..., 0]), rtol=1e-3, atol=0)

    found = activations(agent.policy, minibatch)
    assert all(found[layer.name][0].min() == 0 for layer in layers)

    with torch.no_grad():
        for layer in layers:
            layer.linear.weight *= 7
            layer.linear.bias *= 7

    assert len(written) >= len(layers) and all(layer.norm is not None for layer in layers)
    for key, value in agent.outputs(minibatch).items():
        torch.testing.assert_close(value, before[key], rtol=1e-4, atol=1e-5)
    if name == "dqn":
        assert len(agent.other_weights()) == len(list(agent.greedy.parameters()))
    assert all(any(norm is each for each in agent.trainable) for layer in layers for norm in layer.norm.parameters())
