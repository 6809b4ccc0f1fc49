"""Backpropamine: its equations by hand, and what only plastic weights can hold."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from helpers.small_agents import batches, learnt_from, others_slow
from torch import nn

from baselines.cells.backpropamine import MODULATIONS, Backpropamine
from baselines.cells.cell import Cell
from curricula.paper import ct_su_b1

every_modulation = pytest.mark.parametrize("modulation", MODULATIONS)


def cell(units: int, inputs: int = 3, **settings) -> Backpropamine:
    torch.manual_seed(0)
    return Backpropamine(inputs, units, 3, **settings)


def over(made: Backpropamine, inputs: torch.Tensor, starts: torch.Tensor | None = None) -> torch.Tensor:
    """The outputs at all steps of [rows, steps, n] from the state at the start of an episode."""
    groups = torch.arange(inputs.shape[0] * inputs.shape[1]).view(inputs.shape[:2])
    starts = torch.zeros(groups.shape, dtype=torch.bool) if starts is None else starts
    return made.sequence(inputs.flatten(0, 1), groups, starts, made.zeros(len(inputs)))


@every_modulation
def test_without_plasticity_it_is_a_plain_recurrent_layer_bit_for_bit(modulation):
    made = cell(8, modulation=modulation)
    nn.init.zeros_(made.plasticity)
    nn.init.normal_(made.recurrent)
    inputs, starts = torch.randn(5, 12, 3), torch.rand(5, 12) < 0.2

    found, units, expected = over(made, inputs, starts), torch.zeros(5, 8), []
    given = made.input(inputs.flatten(0, 1)).view(5, 12, 8)
    for step in range(12):
        units = torch.where(starts[:, step, None], 0.0, units)
        units = (given[:, step] + units @ made.recurrent).tanh()
        expected.append(units)

    assert torch.equal(found, torch.stack(expected, dim=1))


def by_hand(made: Backpropamine) -> Backpropamine:
    """Two units that see the two inputs, no slow weights, plasticity 1; eta is 1, or the learned rate 1/4."""
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.zero_()
        made.input.weight.copy_(torch.eye(2))
        made.plasticity.fill_(1)
        if made.modulation != "none":
            made.fan_out.bias.fill_(1)
        if made.modulation != "simple":
            made.rate.fill_(0.25)
    return made


@pytest.mark.parametrize(("modulation", "rate"), [("simple", 1.0), ("none", 0.25)])
def test_three_steps_by_hand(modulation, rate):
    made = by_hand(cell(2, 2, modulation=modulation))
    inputs = torch.tensor([[[0.5, -1.0], [1.0, 0.25], [0.0, 0.0]]])

    found = over(made, inputs)[0]

    one = (math.tanh(0.5), math.tanh(-1.0))
    two = (math.tanh(1.0), math.tanh(0.25))  # no pair of units was active before
    seen = rate * (two[0] * one[0] + two[1] * one[1])
    three = (math.tanh(seen * two[0]), math.tanh(seen * two[1]))
    torch.testing.assert_close(found, torch.tensor([one, two, three]))


def test_retroactive_modulation_acts_on_the_trace_of_the_steps_before():
    made = by_hand(cell(2, 2, modulation="retroactive"))
    made.fan_out.weight.data.fill_(2)
    made.modulator.bias.data.fill_(0.5)
    eta = 2 * math.tanh(0.5) + 1
    one, two, three = (torch.tensor([row]) for row in ([0.5, -1.0], [1.0, 0.25], [0.1, 0.2]))

    state = made.zeros(1)
    for inputs in (one, two, three):
        _, state = made.step(inputs, state)

    h_one, h_two = one.tanh(), two.tanh()
    trace = 0.25 * h_one.T @ h_two
    torch.testing.assert_close(state[1][0], eta * trace)
    torch.testing.assert_close(state[2][0], 0.75 * trace + 0.25 * h_two.T @ three.tanh())


def test_fast_weights_stay_within_two():
    made = by_hand(cell(2, 2))
    made.fan_out.bias.data.copy_(torch.tensor([9.0, -9.0]))
    before = torch.ones(1, 2)

    _, (_, fast) = made.step(torch.full((1, 2), 5.0), (before, torch.zeros(1, 2, 2)))

    assert fast.tolist() == [[[2.0, -2.0], [2.0, -2.0]]]


@every_modulation
def test_gradients_are_those_of_finite_differences(modulation):
    made = cell(3, 2, modulation=modulation).double()
    for weights in (made.recurrent, made.plasticity):
        nn.init.normal_(weights)
    inputs = torch.randn(2, 4, 2, dtype=torch.float64)
    names, values = zip(*made.named_parameters(), strict=True)

    def outputs(*given):
        return torch.func.functional_call(
            Sequences(made), {f"made.{n}": v for n, v in zip(names, given, strict=True)}, inputs
        )

    assert torch.autograd.gradcheck(outputs, values)


@every_modulation
def test_gradients_written_out_are_those_of_autograd_at_the_bound_and_over_resets(modulation):
    made = cell(3, 2, modulation=modulation).double()
    for weights in (made.recurrent, made.plasticity, getattr(made, "rate", torch.empty(0))):
        nn.init.normal_(weights)
    inputs, groups, starts = torch.randn(10, 2).double(), torch.arange(20).view(2, 10) % 10, torch.zeros(2, 10) > 0
    starts[0, 6], slopes = True, torch.randn(2, 10, 3).double()
    state = [2 * torch.randn_like(value) for value in made.zeros(2)]  # beyond the bound, some fast weights at any rate
    state = [value.requires_grad_() for value in state]

    outputs = [how(inputs, groups, starts, state) for how in (partial(Cell.sequence, made), made.sequence)]

    expected, found = (torch.autograd.grad(each, [*made.parameters(), *state], slopes) for each in outputs)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


class Sequences(nn.Module):
    """A cell over sequences as a module, which `functional_call` needs."""

    def __init__(self, made: Backpropamine) -> None:
        super().__init__()
        self.made = made

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return over(self.made, inputs)


def recalled(made: Backpropamine, num_updates: int, num_blanks: int = 6) -> float:
    """The loss of telling two symbols apart after blanks, when all but the weights within and to the units learns."""
    symbols = nn.functional.one_hot(torch.tensor([[0], [1]]), 3)
    blanks = nn.functional.one_hot(torch.full((2, num_blanks), 2), 3)
    inputs, head = torch.cat([symbols, blanks], dim=1).float(), nn.Linear(made.num_outputs, 2)
    fixed = {id(weights) for weights in (made.recurrent, *made.input.parameters())}
    learned = [weights for weights in (*made.parameters(), *head.parameters()) if weights.requires_grad]
    optimiser = torch.optim.Adam([weights for weights in learned if id(weights) not in fixed], 0.03)
    for _ in range(num_updates):
        loss = nn.functional.cross_entropy(head(over(made, inputs)[:, -1]), torch.tensor([0, 1]))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return loss.item()


@pytest.mark.parametrize("modulation", others_slow(MODULATIONS, "retroactive"))
def test_plastic_weights_recall_a_symbol_after_blanks_where_slow_weights_are_fixed(modulation):
    assert recalled(cell(8, modulation=modulation), 150) < 0.1


def test_fixed_slow_weights_alone_recall_nothing():
    made = cell(8)
    nn.init.zeros_(made.plasticity).requires_grad_(False)

    assert recalled(made, 20) == pytest.approx(math.log(2), abs=0.01)


@every_modulation
def test_a_batch_holds_fast_weights_once_and_no_step_of_a_minibatch_has_its_own(small_agent, modulation):
    agent = small_agent("lstm_ppo", [ct_su_b1()], "cell=backpropamine", f"agent.cell.modulation={modulation}")
    batch = batches(agent, ct_su_b1(), 1)[0]
    minibatch = learnt_from(agent, batch)[0]

    fast = [value for value in batch.values(True, True) if value.shape[2:] == (8, 8)]
    assert len(fast) == (4 if modulation == "retroactive" else 2)
    assert {value.untyped_storage().nbytes() for value in fast} == {16 * 8 * 8 * 4}
    assert {value.shape[1] for value in minibatch.values() if value.shape[2:] == (8, 8)} == {1}
