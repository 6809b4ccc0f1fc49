"""Methods that keep weights for each task: masks over a fixed network, PackNet's shares, networks from scratch."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest
import torch
from helpers.scripted import ONE, TWO
from helpers.small_agents import (
    CURRICULUM,
    GREEDY,
    RATE,
    TASKS,
    Tiny,
    batches,
    others_slow,
    same,
    seen,
    small,
    stay,
    weights_for,
    with_method,
)
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import set_exploration_type

from baselines.methods.cka_rl import CKARL
from baselines.methods.mask_blc import MaskBLC
from baselines.methods.mask_lc import MaskLC
from baselines.methods.mask_ri import MaskRI
from baselines.methods.method import AgentWithMethod
from baselines.methods.packnet import PackNet
from baselines.methods.parts.masks import Masks
from baselines.methods.parts.weights import flat
from baselines.methods.scratch import Scratch

MASKS = (MaskRI, MaskLC, MaskBLC)
KEEPS = {method.__name__: method for method in (*MASKS, Scratch)} | {
    "PackNet": lambda: PackNet(retrain=0.5),
    "CKARL": lambda: CKARL(scope="all", pool_size=1, scale=1.0, random_alpha=True, alpha_rate=1.0),
}

every_mask = pytest.mark.parametrize("method", MASKS)

every_family = pytest.mark.parametrize("name", others_slow(KEEPS, "MaskLC", "Scratch", "PackNet", "CKARL"))


def said(attached: AgentWithMethod, number: int, data: Any) -> dict[Any, Tensor]:
    """All that the policy for a task writes."""
    with torch.no_grad(), set_exploration_type(GREEDY):
        written = attached.policy_for(number)(data.select(*attached.policy.in_keys))
    return dict(written.items(True, True))


def masked(method: type[Masks]) -> AgentWithMethod:
    """A `Tiny` agent with masks."""
    torch.manual_seed(0)
    return AgentWithMethod(Tiny(), method(), CURRICULUM)


class Normed(Tiny):
    """Its outputs go through a layer whose weights are a vector."""

    def __init__(self) -> None:
        super().__init__()
        self.policy = TensorDictModule(nn.Sequential(self.linear, nn.LayerNorm(3)), ["observation"], ["logits"])
        self.optimiser = torch.optim.SGD(self.parameters(), RATE)


class Scaled(nn.Module):
    """A layer of a kind of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(3))

    def forward(self, values: Tensor) -> Tensor:
        return self.scale * values


@every_mask
def test_weights_that_are_no_matrix_are_refused(method):
    with pytest.raises(ValueError, match=r"weight matrices, and module\.1\.weight are none: take another"):
        AgentWithMethod(Normed(), method(), CURRICULUM)


def test_networks_from_scratch_have_all_kinds_of_layers_drawn_anew():
    attached = AgentWithMethod(Normed(), Scratch(), CURRICULUM)
    norm = attached.agent.policy.module[1]
    attached.start_task(0)
    with torch.no_grad():
        norm.weight.fill_(2.0)
    attached.end_task()

    attached.start_task(1)

    assert norm.weight.tolist() == [1.0, 1.0, 1.0]


def test_a_layer_that_cannot_be_drawn_anew_is_refused_where_that_is_needed():
    agent = Normed()
    agent.policy = TensorDictModule(nn.Sequential(agent.linear, Scaled()), ["observation"], ["logits"])
    agent.optimiser = torch.optim.SGD(agent.policy.parameters(), RATE)

    with pytest.raises(ValueError, match=r"by reset_parameters, which module\.1 lack: add it"):
        AgentWithMethod(agent, Scratch(), CURRICULUM)


# What holds for all of them


@pytest.mark.parametrize(
    ("agent", "name"),
    [
        pytest.param(agent, name, marks=[pytest.mark.slow] if (place + number) % 3 or agent == "lstm_ppo" else [])
        for place, agent in enumerate(("dqn", "ppo", "lstm_ppo"))
        for number, name in enumerate(KEEPS)
    ],
)
def test_an_earlier_tasks_outputs_stay_bit_equal_while_others_are_learned(compose, agent, name):
    attached = with_method(compose, agent, KEEPS[name]())
    data = batches(attached, ONE, 1)[0][:, 0].clone()
    stay(attached, 0)
    first = said(attached, 0, data), weights_for(attached, 0)
    stay(attached, 1)
    second = said(attached, 1, data), weights_for(attached, 1)
    stay(attached, 2)

    for number, (outputs, weights) in enumerate((first, second)):
        assert same(weights_for(attached, number), weights)
        assert same(said(attached, number, data), outputs)
    others = [weights_for(attached, number) for number in range(3)]
    assert not same(others[0], others[1]) and not same(others[1], others[2])


@every_family
def test_a_task_that_comes_again_goes_on_with_what_it_had(compose, name):
    attached = with_method(compose, "ppo", KEEPS[name]())
    stay(attached, 0)
    had = weights_for(attached, 0)
    stay(attached, 1)
    other = weights_for(attached, 1)

    attached.start_task(0)
    again = weights_for(attached, 0)
    stay(attached, 0)

    assert same(again, had)
    assert not same(weights_for(attached, 0), had)
    assert same(weights_for(attached, 1), other)


@every_family
def test_a_task_that_never_began_is_acted_in_as_the_first(compose, name):
    attached = with_method(compose, "ppo", KEEPS[name]())
    before = weights_for(attached, 2)
    assert same(before, weights_for(attached, 0))
    stay(attached, 1)  # the first one that begins has the id 1
    stay(attached, 0)

    unseen, first, second = (weights_for(attached, number) for number in (2, 1, 0))

    assert same(unseen, first) and not same(unseen, second)


@every_family
def test_a_task_beyond_those_of_the_curriculum_is_refused(compose, name):
    attached = with_method(compose, "ppo", KEEPS[name](), (ONE, TWO))
    for number in (0, 1, 0):
        stay(attached, number, (ONE, TWO), 1)

    with pytest.raises(ValueError, match="there is room for 2 tasks, got another, 5"):
        attached.start_task(5)


@pytest.mark.parametrize("name", KEEPS)
def test_the_target_network_follows_where_weights_are_changed(compose, name):
    attached = with_method(compose, "dqn", KEEPS[name]())
    stay(attached, 0)

    attached.start_task(1)

    agent = attached.agent
    assert all(map(torch.equal, agent.target.parameters(), agent.greedy.parameters()))


def test_a_policy_for_another_task_explores_as_the_present_one_does(compose):
    attached = with_method(compose, "dqn", MaskRI())
    stay(attached, 0)
    attached.start_task(1)
    assert attached.policy_for(0).module[1].eps.item() == 1.0

    attached.learn(batches(attached, TWO, 1)[0])

    assert attached.policy_for(0).module[1].eps.item() == attached.policy_for(1).module[1].eps.item() < 1.0


# Masks


@pytest.mark.parametrize("agent", ["lstm_ppo", "ppo"])
def test_the_network_is_of_signed_constants_and_zero_biases(compose, agent):
    drawn = [weights.detach().clone() for weights in small(compose, agent).policy.parameters()]
    attached = with_method(compose, agent, MaskRI())

    for number in range(2):
        stay(attached, number)
        for before, now in zip(drawn, weights_for(attached, number), strict=True):
            constant = before.sign() * (2 / before.shape[-1]) ** 0.5 if before.ndim == 2 else torch.zeros_like(before)
            kept = now != 0
            torch.testing.assert_close(now, torch.where(kept, constant, 0.0), atol=0, rtol=1e-6)
            assert before.ndim == 1 or 0 < kept.sum() < kept.numel()


def vector(parts: Iterable[Tensor]) -> Tensor:
    """The values of all weight tensors, [P]."""
    return flat(list(parts)).detach()


def test_scores_begin_uniform_between_plus_and_minus_one_over_the_root_of_the_inputs(compose):
    method = MaskRI()
    attached = with_method(compose, "ppo", method, TASKS, "agent.hidden_size=64")

    attached.start_task(0)

    for parameter, scores in zip(method.weights.parameters, method.own, strict=True):
        if parameter.ndim == 1:
            assert not scores.any()
            continue
        most, n = parameter.shape[1] ** -0.5, scores.numel()
        assert scores.abs().max() <= most
        # Kolmogorov-Smirnov: the empirical distribution is off by more than 2.5 / sqrt(n) with a chance below 1e-5.
        uniform = (scores.sort().values / most + 1) / 2
        assert (uniform - torch.linspace(0, 1, n)).abs().max() < 2.5 * n**-0.5 + 1 / n


@every_mask
def test_each_new_task_s_own_scores_are_drawn_anew(compose, method):
    attached = with_method(compose, "ppo", method())
    own = []
    for number in range(2):
        attached.start_task(number)
        own.append(vector(attached.method.own))
        attached.end_task()

    assert (own[0] != own[1])[attached.method.weights.in_matrices].float().mean() > 0.99


def test_the_gradient_goes_straight_through_the_mask_to_all_scores():
    attached, minibatch = masked(MaskRI), seen(6)
    attached.start_task(0)
    method = attached.method
    before, weights = vector(method.own), method.weights.vector().detach()

    attached.agent.gradient_step(minibatch)

    # dL/dW_kj = mean_n f_nk x_nj whatever the weights are; dL/ds = c dL/dw, and biases have c = 0.
    of_weight = (minibatch["factor"].T @ minibatch["observation"] / 6).flatten()
    expected = before[:6] - RATE * method.constant[:6] * of_weight
    own = vector(method.own)
    torch.testing.assert_close(own[:6], expected)
    assert (weights[:6] == 0).any() and (weights[:6] != 0).any()
    assert not own[6:].any() and not method.constant[6:].any()
    assert torch.equal(method.weights.vector(), torch.where(own >= 0, method.constant, 0.0))


SHARES = {MaskLC: [[1.0], [0.5] * 2, [1 / 3] * 3], MaskBLC: [[1.0], [0.5, 0.5], [0.25, 0.25, 0.5]]}
"""With which the tasks begin; the last is that of the new scores."""


@pytest.mark.parametrize("method", SHARES)
def test_a_linear_combination_begins_with_its_shares(compose, method):
    attached = with_method(compose, "ppo", method())
    its = attached.method

    for number in range(3):
        attached.start_task(number)
        present, own = vector(its.current_scores()), vector(its.own)
        expected = sum(
            share * scores for share, scores in zip(SHARES[method][number], [*its.scores[:number], own], strict=True)
        )
        torch.testing.assert_close(present, expected)
        assert torch.equal(its.weights.vector(), torch.where(present >= 0, its.constant, 0.0))
        stay(attached, number)


@pytest.mark.parametrize("method", SHARES)
def test_a_step_moves_the_combination_of_each_weight_tensor_by_its_own_shares(method):
    attached, minibatch = masked(method), seen(6)
    its = attached.method
    for number in range(2):
        attached.start_task(number)
        attached.agent.gradient_step(minibatch)
        attached.end_task()
    attached.start_task(2)
    shares, own, old = torch.tensor(SHARES[method][2]), vector(its.own), its.scores[:2].clone()
    betas = its.betas.detach().clone()

    attached.agent.gradient_step(minibatch)

    of_scores = its.constant[:6] * (minibatch["factor"].T @ minibatch["observation"] / 6).flatten()
    torch.testing.assert_close(vector(its.own)[:6], own[:6] - RATE * shares[2] * of_scores)
    # d/d b_i of sum_k softmax(b)_k s_k is a_i (s_i - sum_k a_k s_k).
    terms = torch.stack([*old, own])[:, :6]
    of_betas = shares * ((terms - shares @ terms) @ of_scores)
    torch.testing.assert_close(its.betas[0].detach(), betas[0] - RATE * of_betas)
    assert torch.equal(its.betas[1], betas[1])  # of the biases, whose constants are 0
    assert torch.equal(its.scores[:2], old)


@pytest.mark.parametrize("method", SHARES)
def test_the_combination_is_consolidated_at_the_tasks_end(compose, method):
    attached = with_method(compose, "ppo", method())
    its = attached.method
    stay(attached, 0)
    attached.start_task(1)
    for batch in batches(attached, TWO, 2):
        attached.learn(batch)
    combined, weights = vector(its.current_scores()), weights_for(attached, 1)
    assert not torch.equal(combined, vector(its.own))

    attached.end_task()

    assert torch.equal(its.scores[1], combined)
    assert torch.equal(vector(its.current_scores()), combined)
    assert same(weights_for(attached, 1), weights)


@pytest.mark.parametrize("method", SHARES)
def test_a_task_that_comes_again_learns_its_consolidated_scores_alone(method):
    attached, minibatch = masked(method), seen(6)
    its = attached.method
    for number in (0, 1, 2):
        attached.start_task(number)
        attached.agent.gradient_step(minibatch)
        attached.end_task()
    kept = its.scores.clone()

    attached.start_task(1)
    attached.agent.gradient_step(minibatch)
    attached.end_task()

    of_weight = (minibatch["factor"].T @ minibatch["observation"] / 6).flatten()
    torch.testing.assert_close(its.scores[1, :6], kept[1, :6] - RATE * its.constant[:6] * of_weight)
    assert torch.equal(its.scores[[0, 2]], kept[[0, 2]])


@every_mask
def test_the_optimiser_starts_anew_with_each_task(compose, method):
    attached = with_method(compose, "ppo", method())
    stay(attached, 0)
    assert attached.agent.optimiser.state

    attached.start_task(1)

    assert not attached.agent.optimiser.state
    live = attached.agent.trainable
    its = attached.method
    expected = [*its.own] if method is MaskRI else [*its.own, its.betas]
    assert all(one is other for one, other in zip(live, expected, strict=True))
    assert attached.agent.optimiser.defaults == small(compose, "ppo").optimiser.defaults
