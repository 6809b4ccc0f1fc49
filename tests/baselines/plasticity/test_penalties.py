"""Penalties and the optimiser: their equations, by hand and by autograd; the errors of public versions fail here."""

from __future__ import annotations

import pytest
import torch
from helpers.plastic import equal, learned, minibatch_of, plastic, weights_of
from helpers.small_agents import TASKS, batches, small

from baselines.parts.units import hidden_layers
from baselines.plasticity.c_chain import CChain
from baselines.plasticity.l2_init import L2Init
from baselines.plasticity.parseval import Parseval
from baselines.plasticity.upgd import UPGD, UPGDOptimiser

NEUTRAL = {
    "l2_init": lambda: L2Init(0.0),
    "parseval": lambda: Parseval(0.0, 2.0),
    "c_chain": lambda: CChain(0.0, 0.0, 2, None, "kl"),
}


@pytest.mark.parametrize("name", NEUTRAL)
def test_a_coefficient_of_0_changes_no_bit(compose, name):
    plain = learned(small(compose, "a2c"))

    assert equal(plain, learned(plastic(compose, NEUTRAL[name](), "a2c")))


def gradients(agent, batch=None) -> list[torch.Tensor]:
    """Of the only penalty, by all weights."""
    [loss] = [value for key, value in agent.plasticity.penalties(batch, agent.weights).items() if "loss" in key]
    return list(torch.autograd.grad(loss, agent.weights, materialize_grads=True))


@torch.no_grad()
def moved(agent, by: float = 0.1) -> None:
    """Change all weights at random."""
    torch.manual_seed(1)
    for weight in agent.weights:
        weight += by * torch.randn_like(weight)


@pytest.mark.parametrize("by", [0.1, 10.0])
def test_l2_init_pulls_in_proportion_to_the_distance_from_the_initial_weights(compose, by):
    agent = plastic(compose, L2Init(0.3))
    initial = weights_of(agent)
    assert all(not gradient.any() for gradient in gradients(agent))
    agent.end_task()
    moved(agent, by)

    for gradient, weight, first in zip(gradients(agent), agent.weights, initial, strict=True):
        torch.testing.assert_close(gradient, 0.6 * (weight - first).detach())


def test_l2_init_by_its_variants_is_a_pull_of_one_strength_or_a_mean_of_each_tensor(compose):
    norm = plastic(compose, L2Init(0.3, power=1))
    assert all(not gradient.any() for gradient in gradients(norm))
    mean = plastic(compose, L2Init(0.3, reduction="mean"))
    initial = weights_of(mean)
    for agent in (norm, mean):
        moved(agent)

    size = torch.cat([gradient.flatten() for gradient in gradients(norm)]).norm()
    assert size.item() == pytest.approx(0.3)
    for gradient, weight, first in zip(gradients(mean), mean.weights, initial, strict=True):
        torch.testing.assert_close(gradient, 0.6 * (weight - first).detach() / weight.numel())


def test_l2_init_without_other_losses_shrinks_the_distance_at_its_rate(compose):
    agent = plastic(compose, L2Init(0.3))
    initial = weights_of(agent)
    moved(agent)
    before = weights_of(agent)

    pulls = gradients(agent)
    with torch.no_grad():
        for weight, pull in zip(agent.weights, pulls, strict=True):
            weight -= 0.1 * pull

    for weight, far, first in zip(agent.weights, before, initial, strict=True):
        torch.testing.assert_close(weight - first, (1 - 2 * 0.1 * 0.3) * (far - first), rtol=1e-4, atol=1e-6)


def test_parseval_is_by_all_hidden_layers_and_0_for_orthogonal_rows_of_its_length(compose):
    agent = plastic(compose, Parseval(0.01, scale=2.0), "ppo", "agent.num_layers=3", "agent.hidden_size=4")
    layers = hidden_layers(agent.policy)
    hidden = [layer.linear.weight for layer in layers]
    expected = {}
    for weight in hidden:
        product = weight @ weight.T - 2 * torch.eye(4)
        expected[id(weight)] = (0.01 * (64 / 4) ** 2 * 4 * product @ weight).detach()

    for weight, gradient in zip(agent.weights, gradients(agent), strict=True):
        torch.testing.assert_close(gradient, expected.get(id(weight), torch.zeros_like(weight)))
    assert len(hidden) == 3

    for weight in hidden:
        torch.nn.init.orthogonal_(weight, gain=2**0.5)
    assert agent.plasticity.penalties({}, agent.weights)["loss_parseval"].item() == pytest.approx(0, abs=1e-8)


def churned(agent, seed: int = 0) -> dict:
    """A minibatch with the other one that C-CHAIN draws."""
    [batch] = batches(agent, TASKS[0], 1, seed)
    agent.plasticity.on_batch(batch)
    return agent.plasticity.transform_minibatch(next(agent.minibatches(batch)))


@pytest.mark.parametrize("distance", ["kl", "cross_entropy"])
def test_c_chain_has_no_gradient_at_its_reference(compose, distance):
    agent = plastic(compose, CChain(10.0, 0.0, 2, None, distance))
    batch = churned(agent)

    assert all(gradient.abs().max() < 1e-6 for gradient in gradients(agent, batch))
    value = agent.plasticity.penalties(batch, agent.weights)["churn"].item()
    assert (abs(value) < 1e-7) == (distance == "kl")
    moved(agent)
    assert any(gradient.abs().max() > 1e-3 for gradient in gradients(agent, batch))


def test_c_chain_compares_with_the_weights_of_the_step_before_on_another_minibatch(compose):
    agent = plastic(compose, CChain(3.0, 0.0, 2, None, "kl"))
    first = weights_of(agent)
    churned(agent)
    moved(agent)
    batch = churned(agent)
    other = {key[1]: value for key, value in batch.items() if key[0] == "churn"}
    now = agent.outputs(other)["log_probs"]
    loss = agent.plasticity.penalties(batch, agent.weights)["loss_c_chain"]

    with torch.no_grad():
        for weight, value in zip(agent.parameters(), first, strict=True):
            weight.copy_(value)
    before = agent.outputs(other)["log_probs"]
    expected = 3.0 * (before.exp() * (before - now)).sum(-1).mean()
    torch.testing.assert_close(loss, expected)
    assert len(other["observation"]) == len(batch["action"])
    assert not torch.equal(other["observation"], batch["observation"])


def test_c_chain_of_action_values_compares_with_the_weights_of_two_steps_before(compose):
    agent = plastic(compose, CChain(3.0, 0.0, 2, None, "kl"), "dqn")
    first = weights_of(agent.greedy)
    minibatch = minibatch_of(agent)
    agent.plasticity.earlier[:] = torch.cat([value.flatten() for value in first])
    agent.plasticity.transform_minibatch(minibatch)
    moved(agent)
    batch = agent.plasticity.transform_minibatch(minibatch)
    other = {key[1]: value for key, value in batch.items() if key[0] == "churn"}
    loss = agent.plasticity.penalties(batch, agent.weights)["loss_c_chain"]
    now = agent.values(other)

    with torch.no_grad():
        for weight, value in zip(agent.greedy.parameters(), first, strict=True):
            weight.copy_(value)
    torch.testing.assert_close(loss, 3.0 * (now - agent.values(other)).square().mean())


@pytest.mark.parametrize(("losses", "expected"), [((2.0, 4.0), 0.1 * 3 / 0.5), ((-2.0, 1.0), 0.0)])
def test_c_chain_holds_its_share_of_the_loss_and_never_turns_its_sign(compose, losses, expected):
    agent = plastic(compose, CChain(7.0, 0.1, 2, None, "kl"))
    coeffs = []
    for loss, churn in zip((*losses, 0.0), (0.25, 0.75, 0.5), strict=True):
        measured = {"loss_objective": loss, "churn": churn, "grad_norm": 0.0}
        given = {key: torch.tensor(value) for key, value in measured.items()}
        coeffs.append(agent.plasticity.after_step({}, given)["c_chain_coeff"].item())

    assert coeffs == pytest.approx([7.0, 7.0, expected])


def optimiser(weights: list[float], **settings) -> tuple[UPGDOptimiser, torch.nn.Parameter]:
    """With one tensor; no decay, no noise and utilities of the present step unless given."""
    weight = torch.nn.Parameter(torch.tensor(weights))
    given = {"form": "sgd", "weight_decay": 0.0, "utility_decay": 0.0, "noise": 0.0, "betas": (0.9, 0.999)}
    return UPGDOptimiser([weight], lr=0.1, seed=0, **{**given, "eps": 1e-8, **settings}), weight


def test_upgd_of_two_weights_is_by_hand():
    made, weight = optimiser([1.0, -2.0], weight_decay=0.5)
    weight.grad = torch.tensor([-3.0, 1.0])

    made.step()

    utility = torch.tensor([3.0, 2.0])  # -g w
    change = torch.tensor([-3.0, 1.0]) * (1 - torch.sigmoid(utility / 3))
    expected = torch.tensor([1.0, -2.0]) * (1 - 0.1 * 0.5) - 0.1 * change
    torch.testing.assert_close(weight.detach(), expected)


def test_upgd_corrects_utilities_for_their_start_and_not_their_maximum():
    made, weight = optimiser([1.0, 1.0], utility_decay=0.75)
    weight.grad = torch.tensor([-1.0, -0.5])

    made.step()

    ratio = torch.tensor([1.0, 0.5]) / 0.25  # u = (1 - b) (-g w), u / (1 - b) by max u
    expected = 1 - 0.1 * weight.grad * (1 - torch.sigmoid(ratio))
    torch.testing.assert_close(weight.detach(), expected)


@pytest.mark.parametrize("form", ["sgd", "adam"])
def test_upgd_without_utility_takes_half_a_step_of_sgd_or_a_step_of_adam(form):
    made, weight = optimiser([0.0, 0.0], form=form, utility_decay=0.999)
    plain = torch.nn.Parameter(torch.zeros(2))
    usual = torch.optim.SGD([plain], lr=0.05) if form == "sgd" else torch.optim.Adam([plain], lr=0.1)
    weight.grad = plain.grad = torch.tensor([1.0, -2.0])

    made.step()
    usual.step()

    torch.testing.assert_close(weight.detach(), plain.detach())


def test_upgd_with_only_negative_utilities_learns_at_full_rate():
    made, weight = optimiser([1.0, 2.0])
    weight.grad = torch.tensor([1.0, 1.0])

    made.step()

    torch.testing.assert_close(weight.detach(), torch.tensor([0.9, 1.9]))


def test_upgds_noise_is_twice_as_large_for_adam_and_not_divided_by_its_root():
    changes = {}
    for form in ("sgd", "adam"):
        made, weight = optimiser([0.0] * 4, form=form, noise=0.5)
        weight.grad = torch.zeros(4)
        made.step()
        changes[form] = weight.detach().clone()

    torch.testing.assert_close(changes["adam"], 2 * changes["sgd"])
    assert 0.001 < changes["sgd"].abs().mean() < 0.1


def test_upgds_maximum_is_over_all_tensors():
    one = torch.nn.Parameter(torch.tensor([1.0]))
    other = torch.nn.Parameter(torch.tensor([1.0]))
    settings = {"form": "sgd", "weight_decay": 0.0, "utility_decay": 0.0, "noise": 0.0, "betas": (0.9, 0.999)}
    made = UPGDOptimiser([one, other], lr=0.1, seed=0, eps=1e-8, **settings)
    one.grad = torch.tensor([-1.0])
    other.grad = torch.tensor([-4.0])

    made.step()

    assert one.item() == pytest.approx(1 + 0.1 * (1 - torch.sigmoid(torch.tensor(0.25)).item()))


def test_upgd_takes_the_place_of_the_agents_optimiser(compose):
    agent = plastic(compose, UPGD("adam", 0.001, 0.999, 0.001, [0.9, 0.999], 1e-5), "ppo", "agent.learning_rate=0.02")

    [group] = agent.optimiser.param_groups
    assert (group["lr"], group["utility_decay"]) == (0.02, 0.999)
    assert not equal(weights_of(agent), learned(agent, 1))
