"""Methods that hold the weights: importances and penalties by hand, and output layers of each task's own."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers.scripted import ONE
from helpers.small_agents import RATE, TASKS, Tiny, batches, seen, tiny, with_method
from tensordict import TensorDict
from torch import Tensor

from baselines.methods.ewc import EWC
from baselines.methods.l2 import L2
from baselines.methods.mas import MAS
from baselines.methods.method import AgentWithMethod
from baselines.methods.si import SI

EWC_SETTINGS = {"online": False, "alpha": 0.5, "fisher": "policy", "num_samples": 100, "heads": "single"}


class Bowl(Tiny):
    """Its loss is sum_i h_i (w_i - t_i)^2 / 2 of the weights as one vector."""

    steepness = torch.linspace(0.5, 2.0, 9)

    def loss(self, batch: Any) -> dict[str, Tensor]:
        gap = vector(self) - batch["target"][0]
        return {"loss_bowl": (self.steepness * gap.square()).sum() / 2}


def vector(agent: Tiny) -> Tensor:
    return torch.cat([agent.linear.weight.flatten(), agent.linear.bias])


def task_with(attached: AgentWithMethod, number: int, *minibatches: dict[str, Tensor]) -> None:
    """A task in which these minibatches are learned from, without a change of the weights."""
    attached.start_task(number)
    for minibatch in minibatches:
        attached.method.transform_minibatch(minibatch)
    attached.end_task()


def softmax_fisher(agent: Tiny, observation: Tensor) -> Tensor:
    """By hand: for logits z = W x + b, E[(d log pi(a) / d z_k)^2] = p_k (1 - p_k), and d z_k / d W_kj = x_j."""
    logits = observation @ agent.linear.weight.T + agent.linear.bias
    chances = logits.exp() / logits.exp().sum(dim=1, keepdim=True)
    of_bias = chances * (1 - chances)
    of_weight = of_bias.unsqueeze(2) * observation.square().unsqueeze(1)
    return torch.cat([of_weight.mean(dim=0).flatten(), of_bias.mean(dim=0)]).detach()


def gradient_of_penalty(attached: AgentWithMethod) -> Tensor:
    losses = attached.method.penalties({}, attached.agent.weights)
    assert list(losses) == ["loss_method"]
    parts = torch.autograd.grad(losses["loss_method"], attached.agent.weights)
    return torch.cat([part.flatten() for part in parts])


def move(attached: AgentWithMethod, seed: int) -> Tensor:
    """Other weights."""
    weights = torch.randn(9, generator=torch.Generator().manual_seed(seed))
    attached.method.weights.write(weights)
    return weights


# Importances


def test_the_fisher_information_of_a_softmax_policy_is_its_closed_form():
    attached, minibatch = tiny(EWC(coeff=1, **EWC_SETTINGS)), seen(7)

    task_with(attached, 0, minibatch)

    expected = softmax_fisher(attached.agent, minibatch["observation"])
    torch.testing.assert_close(attached.method.importance, expected)


@pytest.mark.parametrize("method", [EWC, MAS])
def test_importance_is_of_the_last_samples_alone(method):
    settings = {**(EWC_SETTINGS if method is EWC else {"heads": "single"}), "num_samples": 7}
    attached, other = (tiny(method(coeff=1, **settings)) for _ in range(2))
    last = seen(3, seed=4)

    task_with(attached, 0, seen(50, seed=1), seen(4, seed=3), last)
    task_with(other, 0, {key: torch.cat([value, last[key]]) for key, value in seen(4, seed=3).items()})

    torch.testing.assert_close(attached.method.importance, other.method.importance)
    assert attached.method.importance.any()


@pytest.mark.parametrize("method", [EWC, MAS])
def test_frames_that_are_learned_from_again_are_counted_once(method):
    settings = EWC_SETTINGS if method is EWC else {"heads": "single", "num_samples": 100}
    attached, once = (tiny(method(coeff=1, **settings)) for _ in range(2))
    minibatches = [seen(4, seed=1), seen(4, seed=2)]
    attached.start_task(0)
    for _ in range(2):
        attached.method.on_batch(TensorDict(batch_size=[8]))
        for minibatch in (*minibatches, seen(8, seed=3)):  # the second pass
            attached.method.transform_minibatch(minibatch)

    attached.end_task()
    task_with(once, 0, *minibatches, *minibatches)

    torch.testing.assert_close(attached.method.importance, once.method.importance)


@pytest.mark.parametrize("method", [EWC, MAS])
def test_a_short_task_is_not_weighed_up_by_the_samples_of_the_one_before(method):
    settings = EWC_SETTINGS if method is EWC else {"heads": "single", "num_samples": 100}
    attached, alone = (tiny(method(coeff=1, **settings)) for _ in range(2))
    task_with(attached, 0, seen(9, seed=1))
    before = attached.method.importance.clone()

    task_with(attached, 1, seen(5, seed=2))
    task_with(alone, 0, seen(5, seed=2))

    torch.testing.assert_close(attached.method.importance - before, alone.method.importance)


@pytest.mark.parametrize("learnt", [4, 3, 0])
def test_fisher_of_the_losses_is_the_sum_of_squared_gradients_by_the_frames_of_minibatches(learnt):
    attached = tiny(EWC(coeff=1, **{**EWC_SETTINGS, "fisher": "loss"}))
    minibatches = [{**seen(4, seed=1), "learnt": torch.arange(4) < learnt}, seen(6, seed=2)]

    task_with(attached, 0, *minibatches)

    # The losses sum up to mean_n sum_k f_nk z_nk, whose gradient by W_kj is mean_n f_nk x_nj.
    gradients = [
        torch.cat([(m["factor"].T @ m["observation"] / len(m["factor"])).flatten(), m["factor"].mean(dim=0)])
        for m in minibatches
    ]
    expected = gradients[0].square() / max(learnt, 1) + gradients[1].square() / 6
    torch.testing.assert_close(attached.method.importance, expected)


@pytest.mark.slow
def test_the_fisher_information_of_compiled_gradients_is_that_of_the_losses(compose, compile_by):
    graphs: list[Any] = []
    compile_by(lambda graph, *_, **__: graphs.append(graph) or graph)
    settings = {**EWC_SETTINGS, "fisher": "loss", "num_samples": 40}
    attached = with_method(compose, "ppo", EWC(coeff=1, **settings), TASKS, "agent.compile=true")
    attached.start_task(0)
    for batch in batches(attached, ONE, 2):
        attached.learn(batch)
    minibatches = attached.method.samples.minibatches
    minibatches.append({key: value[:3] for key, value in minibatches[-1].items()})
    before = len(graphs)

    found = attached.method.task_importance()

    assert len(minibatches) > 2
    assert len(graphs) == before + 1
    expected = torch.zeros(len(attached.method.weights))
    for minibatch in minibatches:
        total = sum(attached.agent.loss(minibatch)[key] for key in ("loss_objective", "loss_critic", "loss_entropy"))
        gradients = torch.autograd.grad(total, attached.agent.weights)
        squares = torch.cat([gradient.flatten() for gradient in gradients]).square()
        expected += squares / len(minibatch["action"])
    torch.testing.assert_close(found, expected)


def test_mas_is_the_mean_sensitivity_of_the_squared_length_of_linear_outputs():
    attached, first, second = tiny(MAS(coeff=1, num_samples=100, heads="single")), seen(5, seed=1), seen(8, seed=2)
    attached.agent.output_keys = ("action_value",)

    task_with(attached, 0, first)
    once = attached.method.importance.clone()
    task_with(attached, 1, second)

    def by_hand(observation: Tensor) -> Tensor:  # |W x + b|^2 has the derivatives 2 z_k x_j and 2 z_k
        outputs = (observation @ attached.agent.linear.weight.T + attached.agent.linear.bias).detach()
        of_weight = (2 * outputs.unsqueeze(2) * observation.unsqueeze(1)).abs().mean(dim=0)
        return torch.cat([of_weight.flatten(), (2 * outputs).abs().mean(dim=0)])

    torch.testing.assert_close(once, by_hand(first["observation"]))
    torch.testing.assert_close(attached.method.importance, once + by_hand(second["observation"]))


def test_the_outputs_that_mas_weighs_are_log_probabilities_and_value(compose):
    attached = with_method(compose, "a2c", MAS(coeff=1, num_samples=4, heads="single"))
    batch = batches(attached, ONE, 1)[0]
    attached.start_task(0)
    minibatch = {key: batch[key].flatten(0, 1)[:4] for key in ("observation", "action")}
    attached.method.transform_minibatch(minibatch)
    attached.end_task()

    expected = torch.zeros(len(attached.method.weights))
    for observation in minibatch["observation"]:
        said = attached.agent.outputs({"observation": observation})
        squared = said["log_probs"].square().sum() + said["state_value"].square().sum()
        parts = torch.autograd.grad(squared, attached.agent.weights)
        expected += torch.cat([part.flatten() for part in parts]).abs() / 4
    torch.testing.assert_close(attached.method.importance, expected)


@pytest.mark.parametrize("agent", ["a2c", "dqn", "lstm_ppo", "ppo"])
def test_every_agents_policy_has_the_fisher_information_of_its_frames(compose, agent):
    """Against sum_a (d pi_a / d w)^2 / pi_a, which is the same as E[(d log pi_a / d w)^2], frame by frame."""
    attached = with_method(compose, agent, EWC(coeff=1, **{**EWC_SETTINGS, "num_samples": 16}))
    keys = [*attached.policy.in_keys, "action"]
    rows = batches(attached, ONE, 1)[0][:2]
    minibatch = {key: rows[key] if attached.agent.memory else rows[key].flatten(0, 1) for key in keys}
    attached.start_task(0)
    attached.method.transform_minibatch(minibatch)
    attached.end_task()

    expected = torch.zeros(len(attached.method.weights))
    for chances in attached.agent.outputs(minibatch)["log_probs"].exp().flatten(0, -2):
        for chance in chances:
            parts = torch.autograd.grad(chance, attached.agent.weights, retain_graph=True, materialize_grads=True)
            expected += torch.cat([part.flatten() for part in parts]).square() / chance.detach() / 16
    torch.testing.assert_close(attached.method.importance, expected)


@pytest.mark.parametrize("method", [EWC, MAS])
def test_steps_that_are_not_learned_from_are_not_weighed(compose, method):
    settings = {**(EWC_SETTINGS if method is EWC else {"heads": "single"}), "num_samples": 5}
    attached, other = (with_method(compose, "drqn", method(coeff=1, **settings)) for _ in range(2))
    batch = batches(attached, ONE, 1)[0][:2]
    first = {key: batch[key] for key in [*attached.policy.in_keys, "action"]}
    steps = torch.arange(batch.shape[1])
    masked = {**first, "learnt": torch.stack([steps < 3, steps < 2])}
    for each, minibatch in ((attached, masked), (other, {key: value[:, :3] for key, value in first.items()})):
        each.start_task(0)
        each.method.transform_minibatch(minibatch)
    other.method.samples.minibatches[0]["learnt"] = torch.tensor([[True, True, True], [True, True, False]])

    attached.end_task()
    other.end_task()

    assert attached.method.importance.any()
    torch.testing.assert_close(attached.method.importance, other.method.importance)


def test_a_first_pass_of_rl2_has_no_last_steps(compose):
    attached = with_method(compose, "rl2", MAS(coeff=1, num_samples=1000, heads="single"), TASKS, "agent.num_epochs=2")
    (batch,) = batches(attached, ONE, 1)

    attached.start_task(0)
    attached.learn(batch)

    assert attached.method.samples.num_held == batch.shape[0] * (batch.shape[1] - 1)


# Penalties


PENALTIES = {
    "ewc": (EWC(coeff=3, **EWC_SETTINGS), 1.5),
    "l2": (L2(coeff=3, heads="single"), 3),
    "mas": (MAS(coeff=3, num_samples=4, heads="single"), 3),
    "si": (SI(coeff=3, epsilon=0.1, heads="single"), 3),
}
"""Methods, and what they weigh sum_i I_i (w_i - a_i)^2 with: EWC has lambda / 2."""


@pytest.mark.parametrize("name", PENALTIES)
def test_the_penalty_and_its_gradient_are_those_by_hand(name):
    method, factor = PENALTIES[name]
    attached = tiny(method)
    importance, anchor = torch.rand(9), torch.randn(9)
    method.importance.copy_(importance)
    method.anchor.copy_(anchor)
    weights = move(attached, seed=1)

    losses = attached.loss(seen(4))

    expected = factor * (importance * (weights - anchor) ** 2).sum()
    torch.testing.assert_close(losses["loss_method"], expected)
    assert list(losses) == ["loss_first", "loss_others", "entropy", "loss_method"]
    torch.testing.assert_close(gradient_of_penalty(attached), 2 * factor * importance * (weights - anchor))


@pytest.mark.parametrize("name", PENALTIES)
def test_a_gradient_step_goes_down_the_losses_and_the_penalty(name):
    method, factor = PENALTIES[name]
    attached = tiny(method)
    method.importance.copy_(torch.rand(9))
    method.anchor.copy_(torch.randn(9))
    weights, batch = move(attached, seed=1), seen(4)
    own = torch.cat([(batch["factor"].T @ batch["observation"] / 4).flatten(), batch["factor"].mean(dim=0)])

    attached.agent.gradient_step(batch)

    expected = weights - RATE * (own + 2 * factor * method.importance * (weights - method.anchor))
    torch.testing.assert_close(vector(attached.agent).detach(), expected)


def test_l2_holds_all_weights_alike_where_they_were_last_and_nothing_before():
    attached = tiny(L2(coeff=0.5, heads="single"))
    attached.start_task(0)
    assert not gradient_of_penalty(attached).any()
    attached.end_task()
    attached.start_task(1)
    last = move(attached, seed=3)
    attached.end_task()

    weights = move(attached, seed=4)

    torch.testing.assert_close(gradient_of_penalty(attached), weights - last)


def remembered(attached: AgentWithMethod) -> tuple[list[Tensor], list[Tensor]]:
    """Three tasks with random importances and weights."""
    fishers, anchors = torch.rand(3, 9), []
    fishers[1, 2:4], fishers[:, 5] = 0, 0
    for number, fisher in enumerate(fishers):
        attached.start_task(number)
        anchors.append(move(attached, seed=number))
        attached.method.task_importance = lambda fisher=fisher: fisher
        attached.end_task()
    return list(fishers), anchors


def test_separate_ewc_is_the_sum_of_one_term_for_each_earlier_task():
    attached = tiny(EWC(coeff=4, **EWC_SETTINGS))
    fishers, anchors = remembered(attached)

    def explicit(weights: Tensor) -> Tensor:
        return 2 * sum((f * (weights - a) ** 2).sum() for f, a in zip(fishers, anchors, strict=True))

    differences = []
    for seed in (7, 8):
        weights = move(attached, seed).requires_grad_()
        (expected,) = torch.autograd.grad(explicit(weights), weights)
        torch.testing.assert_close(gradient_of_penalty(attached), expected)
        differences.append(explicit(weights) - attached.method.penalties({}, attached.agent.weights)["loss_method"])
    torch.testing.assert_close(*differences)  # a constant, which no gradient has


def test_online_ewc_is_one_term_with_the_running_mean_at_the_last_weights():
    attached = tiny(EWC(coeff=4, **{**EWC_SETTINGS, "online": True, "alpha": 0.25}))
    fishers, anchors = remembered(attached)

    weights = move(attached, seed=7)

    mean = 0.75 * (0.25**2 * fishers[0] + 0.25 * fishers[1] + fishers[2])  # begins at 0
    torch.testing.assert_close(gradient_of_penalty(attached), 4 * mean * (weights - anchors[2]))


# The path of synaptic intelligence


def test_synaptic_intelligence_is_the_path_integral_of_a_quadratic_loss_by_hand():
    """Over two tasks: in the second the penalty bends the way, but its gradient is no part of the integral."""
    c, xi = 3.0, 0.05
    attached = tiny(SI(coeff=c, epsilon=xi, heads="single"), Bowl)
    weights = vector(attached.agent).detach().double()
    steep, importance, anchor = Bowl.steepness.double(), torch.zeros(9).double(), weights.clone()
    action = torch.zeros(1, dtype=torch.int64)

    for number in range(2):
        targets = torch.randn(5, 9, generator=torch.Generator().manual_seed(number))
        start, path = weights.clone(), torch.zeros(9).double()
        attached.start_task(number)
        for target in targets:
            attached.agent.gradient_step({"action": action, "target": target.unsqueeze(0)})
            own = steep * (weights - target.double())
            step = -RATE * (own + 2 * c * importance * (weights - anchor))
            path, weights = path - own * step, weights + step
        attached.end_task()
        importance = importance + path.clamp(min=0) / ((weights - start) ** 2 + xi)
        anchor = weights.clone()
        torch.testing.assert_close(attached.method.importance.double(), importance, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(attached.method.anchor.double(), anchor, atol=1e-5, rtol=1e-4)

    assert (path < 0).any()  # which counts as 0
