"""Sequences of a layer with plastic weights, whose gradient is written out.

A step keeps its state, one matrix a row, or two if modulation is retroactive, where autograd keeps some ten. Equations
are those of `baselines.cells.backpropamine`; a fast weight at its bound has gradient 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear
from typing_extensions import override

from baselines.cells.cell import CellOutput, CellState


class PlasticSteps(NamedTuple):
    """How the steps of a sequence are taken."""

    step: Callable[[Tensor, CellState, Tensor], CellOutput]
    """Returns units and next state from the inputs times their weights, [rows, H], a state, and [rows, H, H] to
    overwrite.
    """

    bound: float
    """Of fast weights."""

    resets: Sequence[Tensor]
    """The rows reset before each step, int64 [n]; none before the first."""


class Plastic(NamedTuple):
    """The weights of a plastic layer, or their gradients; None where modulation has none."""

    recurrent: Tensor
    """W, [H, H]."""

    plasticity: Tensor
    """A, [H, H]."""

    rate: Any = None
    """The learned rate, []."""

    modulator: Any = None
    """w_m, [1, H]."""

    modulator_bias: Any = None
    """b, [1]."""

    fan_out: Any = None
    """f, [H, 1]."""

    fan_out_bias: Any = None
    """g, [H]."""


class PlasticSequence(torch.autograd.Function):
    """Take step after step, and return the units, [rows, steps, H].

    Arguments are the steps, the inputs times their weights, [steps, rows, H], the tensors of `Plastic`, and the units,
    fast weights and, if retroactive, trace before the first step.
    """

    @staticmethod
    @override
    def forward(ctx: Any, steps: PlasticSteps, given: Tensor, *tensors: Tensor) -> Tensor:
        weights = tensors[: len(Plastic._fields)]
        state = tensors[len(Plastic._fields) :]
        ctx.save_for_backward(*weights)
        ctx.bound = steps.bound
        ctx.resets = steps.resets
        ctx.states = []
        units = []
        product = torch.empty_like(state[1])
        for values, rows in zip(given, steps.resets, strict=True):
            if len(rows):
                state = state[0].index_fill(0, rows, 0.0), *(each.index_fill_(0, rows, 0.0) for each in state[1:])
            ctx.states.append(state)
            output, state = steps.step(values, state, product)
            units.append(output)
        ctx.states.append(state)
        ctx.units = torch.stack(units)
        return ctx.units.transpose(0, 1).contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_units: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients by the arguments."""
        gradient = PlasticGradient(Plastic(*ctx.saved_tensors), ctx.bound, ctx.units, ctx.states[-1])
        for t in reversed(range(len(ctx.units))):
            gradient.step(t, by_units[:, t], ctx.states[t], ctx.states[t + 1])
            for value in gradient.state if len(ctx.resets[t]) else ():
                value.index_fill_(0, ctx.resets[t], 0.0)
        before = torch.stack([state[0] for state in ctx.states[:-1]])
        return None, gradient.given, *gradient.weights(before), *gradient.state


class PlasticGradient:
    """The gradient of a sequence, step by step from the last one.

    Args:
        bound: of fast weights.
        units: of all steps, [steps, rows, H].
        state: after the last step.
    """

    def __init__(self, weights: Plastic, bound: float, units: Tensor, state: CellState) -> None:
        self._weights = weights
        self._bound = bound
        self._units = units
        self._slope = 1 - units.square()
        self.given = torch.empty_like(units)
        """The gradient by the inputs times their weights."""
        self.state = [torch.zeros_like(value) for value in state]
        """The gradient by the state before the last step taken."""
        self._plasticity = torch.zeros_like(state[1])
        self._product = torch.empty_like(state[1])
        self._rate = units.new_zeros(())
        self._by_eta = torch.empty_like(units)
        self._modulation: Tensor | None = None
        if weights.modulator is None:
            self._eta = weights.rate.expand(len(units), 1)
        else:
            self._modulation = linear(units, weights.modulator, weights.modulator_bias).tanh()
            self._eta = linear(self._modulation, weights.fan_out, weights.fan_out_bias)
            self._through_eta = (1 - self._modulation.square()) * weights.modulator

    def step(self, t: int, by_units: Tensor, state: CellState, after: CellState) -> None:
        """Go back through a step.

        Args:
            by_units: the gradient by its units without the next step's share, [rows, H].
            state: before it.
            after: after it, before any reset.
        """
        before, hebb, *_ = state
        by_hebb = self.state[1]
        weights = self._weights
        torch.ops.aten.hardtanh_backward.grad_input(by_hebb, after[1], -self._bound, self._bound, grad_input=by_hebb)
        by_units, by_before = self._through_change(t, by_units + self.state[0], state)
        by_given = torch.mul(by_units, self._slope[t], out=self.given[t])
        by_fast = rows_times(torch.mul(weights.plasticity, hebb, out=self._product), by_given)
        self.state[0] = torch.addmm(by_before + by_fast, by_given, weights.recurrent.T)
        pairs = torch.mul(before.unsqueeze(2), by_given.unsqueeze(1), out=self._product)
        self._plasticity.addcmul_(pairs, hebb)
        by_hebb.addcmul_(pairs, weights.plasticity)

    def weights(self, before: Tensor) -> Plastic:
        """Return the gradient by the weights; ``before`` are the units before each step, [steps, rows, H]."""
        recurrent = before.flatten(0, 1).T @ self.given.flatten(0, 1)
        plasticity = self._plasticity.sum(dim=0)
        by_eta = self._by_eta.flatten(0, 1)
        if self._modulation is None:
            return Plastic(recurrent, plasticity, self._rate + by_eta.sum())
        modulation = self._modulation.flatten(0, 1)
        inner = by_eta @ self._weights.fan_out * (1 - modulation.square())
        modulator = (inner.T @ self._units.flatten(0, 1), inner.sum(dim=0), by_eta.T @ modulation, by_eta.sum(dim=0))
        return Plastic(recurrent, plasticity, None if self._weights.rate is None else self._rate, *modulator)

    def _through_change(self, t: int, by_units: Tensor, state: CellState) -> tuple[Tensor, Tensor]:
        before = state[0]
        units = self._units[t]
        eta = self._eta[t]
        if len(state) == 2:
            by_hebb = self.state[1]
            rate = eta
            columns = columns_times(before, by_hebb)
            across = rows_times(by_hebb, eta * units)
            torch.mul(columns, units, out=self._by_eta[t])
        else:
            trace = state[2]
            by_hebb, by_trace = self.state[1:]
            rate = self._weights.rate
            columns = columns_times(before, by_trace)
            across = rate * rows_times(by_trace, units)
            self._rate.add_((columns * units).sum() - (by_trace * trace).sum())
            torch.sum(by_hebb * trace, dim=1, out=self._by_eta[t])
            by_trace.mul_(1 - rate).addcmul_(by_hebb, eta.unsqueeze(1))
        by_units = torch.addcmul(by_units, columns, rate)
        if self._modulation is not None:
            by_units.addcmul_(self._by_eta[t] @ self._weights.fan_out, self._through_eta[t])
        return by_units, across


def columns_times(vectors: Tensor, matrices: Tensor) -> Tensor:
    """Multiply each row's vector, [rows, H], with its matrix, [rows, H, H]."""
    return torch.bmm(vectors.unsqueeze(1), matrices).squeeze(1)


def rows_times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Multiply each row's matrix with its vector, faster than as a column."""
    return torch.bmm(vectors.unsqueeze(1), matrices.transpose(1, 2)).squeeze(1)
