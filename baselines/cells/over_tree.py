"""An LSTM or a GRU over a tree of histories, with one backward pass for all steps.

It multiplies for all histories at once where PyTorch's does each step's operations.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from typing_extensions import override

from baselines.cells.cell import CellState
from ctgraph_rl.learn.histories import Tree

Kept = tuple[Tensor, ...]
"""What the gradients of steps are made of, [n, ...] each."""


class Gates(Protocol):
    """A step of a cell without its products, and its gradients."""

    @staticmethod
    def step(given: Tensor, carried: Tensor, before: CellState) -> tuple[CellState, Kept]:
        """Return the next state, and what `factors` needs.

        Args:
            given: the product of the inputs, [n, G].
            carried: the product of the first part of the state, [n, G]; may be overwritten.
            before: the parts of the state, [n, H] each.
        """
        ...

    @staticmethod
    def factors(kept: Kept, before: CellState) -> Kept:
        """Return what gradients of any number of steps are multiplied by."""
        ...

    @staticmethod
    def back(factors: Kept, by: CellState) -> tuple[Tensor, Tensor, CellState]:
        """Return gradients by ``given``, ``carried`` and the state, without that through ``carried``.

        Args:
            by: gradients by the parts of the next state.
        """
        ...


class LSTMGates(Gates):
    """i, f, g and o of an LSTM with the state h and c."""

    @override
    @staticmethod
    def step(given: Tensor, carried: Tensor, before: CellState) -> tuple[CellState, Kept]:
        size = before[1].shape[1]
        gates = carried.add_(given)
        g = gates[:, 2 * size : 3 * size].tanh()
        gates.sigmoid_()
        i, f, _, o = gates.chunk(4, dim=1)
        c = torch.addcmul(f * before[1], i, g)
        squashed = c.tanh()
        return (o * squashed, c), (gates, g, squashed)

    @override
    @staticmethod
    def factors(kept: Kept, before: CellState) -> Kept:
        gates, g, squashed = kept
        i, f, _, o = gates.chunk(4, dim=1)
        slope = gates * (1 - gates)
        slope_i, slope_f, _, slope_o = slope.chunk(4, dim=1)
        of_g = i * (1 - g.square())
        of_gates = torch.cat([g * slope_i, before[1] * slope_f, of_g, squashed * slope_o], dim=1)
        return of_gates, o * (1 - squashed.square()), f

    @override
    @staticmethod
    def back(factors: Kept, by: CellState) -> tuple[Tensor, Tensor, CellState]:
        of_gates, of_h, f = factors
        by_h, by_c = by
        by_c = torch.addcmul(by_c, by_h, of_h)
        by_gates = torch.cat([by_c, by_c, by_c, by_h], dim=1).mul_(of_gates)
        return by_gates, by_gates, (torch.zeros_like(by_h), by_c * f)


class GRUGates(Gates):
    """r, z and n of a GRU with the state h."""

    @override
    @staticmethod
    def step(given: Tensor, carried: Tensor, before: CellState) -> tuple[CellState, Kept]:
        size = before[0].shape[1]
        r, z = (given[:, : 2 * size] + carried[:, : 2 * size]).sigmoid().chunk(2, dim=1)
        of_h = carried[:, 2 * size :]
        n = torch.addcmul(given[:, 2 * size :], r, of_h).tanh()
        return (torch.lerp(n, before[0], z),), (r, z, n, of_h)

    @override
    @staticmethod
    def factors(kept: Kept, before: CellState) -> Kept:
        r, z, n, of_h = kept
        of_n = (1 - z) * (1 - n.square())
        of_r = of_n * of_h * r * (1 - r)
        of_z = (before[0] - n) * z * (1 - z)
        return torch.cat([of_r, of_z, of_n], dim=1), torch.cat([of_r, of_z, of_n * r], dim=1), z

    @override
    @staticmethod
    def back(factors: Kept, by: CellState) -> tuple[Tensor, Tensor, CellState]:
        of_given, of_carried, z = factors
        by_gates = torch.cat([by[0], by[0], by[0]], dim=1)
        return by_gates * of_given, by_gates * of_carried, (by[0] * z,)


class GatedTree(NamedTuple):
    """Histories, and the cell of `Gates` over them."""

    gates: type[Gates]

    tree: Tree

    inputs: Tensor
    """The product of each history's last input, int64 [num_histories]."""


class GatesOverTree(torch.autograd.Function):
    """Outputs of a cell of `Gates` at the ends of histories, differentiable once by products and weights."""

    @staticmethod
    def forward(
        ctx: Any,
        gated: GatedTree,
        given: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        *initial: Tensor,
    ) -> Tensor:
        """Return the outputs, [num_histories, H].

        Args:
            given: products of inputs, [n, G].
            weight: of the first part of the state, [G, H].
            bias: of that product, [G], or None.
            initial: what histories of length 1 continue, [n, H] each, without a gradient.
        """
        gates, tree, inputs = gated
        states = [torch.cat([part, part.new_empty(len(inputs), part.shape[1])]) for part in initial]
        in_order = given.index_select(0, inputs)
        turned = weight.t()
        kept = []
        end = tree.sizes[0]
        for products, shorter in zip(in_order.split(tree.sizes), tree.shorter.split(tree.sizes), strict=True):
            before = tuple(part.index_select(0, shorter) for part in states)
            carried = before[0] @ turned if bias is None else torch.addmm(bias, before[0], turned)
            after, of_step = gates.step(products, carried, before)
            for part, value in zip(states, after, strict=True):
                part[end : end + len(shorter)] = value
            end += len(shorter)
            kept.append(of_step)
        ctx.gated = gated
        ctx.kept = kept
        ctx.has_bias = bias is not None
        ctx.save_for_backward(given, weight, *states)
        return states[0][tree.sizes[0] :]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_outputs: Tensor) -> tuple[Any, ...]:
        """Return the gradients by the products, the weight and the bias."""
        gates, tree, inputs = ctx.gated
        given, weight, *states = ctx.saved_tensors
        before = tuple(part.index_select(0, tree.shorter) for part in states)
        kept = tuple(torch.cat(parts) for parts in zip(*ctx.kept, strict=True))
        factors = gates.factors(kept, before)
        by_states = [torch.zeros_like(part) for part in states]
        by_states[0][tree.sizes[0] :] = by_outputs
        by_given = given.new_empty(len(inputs), given.shape[1])
        by_carried = torch.empty_like(by_given)
        last = len(inputs)
        for size in reversed(tree.sizes):
            first = last - size
            by = [part[tree.sizes[0] + first : tree.sizes[0] + last] for part in by_states]
            of_step = tuple(part[first:last] for part in factors)
            by_given[first:last], by_carried[first:last], by_before = gates.back(of_step, by)
            if first:
                shorter = tree.shorter[first:last]
                by_states[0].index_add_(0, shorter, torch.addmm(by_before[0], by_carried[first:last], weight))
                for part, value in zip(by_states[1:], by_before[1:], strict=True):
                    part.index_add_(0, shorter, value)
            last = first
        by_weight = by_carried.t() @ before[0]
        by_bias = by_carried.sum(dim=0) if ctx.has_bias else None
        by_products = torch.zeros_like(given).index_add_(0, inputs, by_given)
        return None, by_products, by_weight, by_bias, *[None] * len(states)
