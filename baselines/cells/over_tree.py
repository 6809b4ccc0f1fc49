"""An LSTM or a GRU over a tree of histories, with one backward pass for all steps.

It multiplies for all histories at once where PyTorch's does each step's operations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from baselines.cells.cell import CellState
from ctgraph_rl.learn.histories import Tree


class LSTMGates:
    """i, f, g and o of an LSTM with the state h and c: a step without its products, and its gradients."""

    num_kept = 2
    """Tensors that `step` keeps, [n, H] each."""

    adds = True
    """Whether a step reads only the sum of its two products, so that they have one gradient."""

    @staticmethod
    def step(
        given: Tensor, carried: Tensor, before: Sequence[Tensor], after: Sequence[Tensor], kept: Sequence[Tensor]
    ) -> None:
        """Write the next state, and what `factors` needs.

        Args:
            given: the product of the inputs, [n, G].
            carried: the product of the first part of the state, [n, G]; may be overwritten by what is needed.
            before: the parts of the state, [n, H] each.
            after: the next state, to be written.
            kept: to be written.
        """
        g, squashed = kept
        h, c = after
        carried.add_(given)
        g.copy_(carried.chunk(4, dim=1)[2]).tanh_()
        i, f, _, o = carried.sigmoid_().chunk(4, dim=1)
        torch.addcmul(f * before[1], i, g, out=c)
        torch.tanh(c, out=squashed)
        torch.mul(o, squashed, out=h)

    @staticmethod
    def factors(carried: Tensor, kept: Sequence[Tensor], before: Sequence[Tensor]) -> CellState:
        """Return what gradients of any number of steps are multiplied by."""
        g, squashed = kept
        i, f, _, o = carried.chunk(4, dim=1)
        of_gates = (1 - carried).mul_(carried)
        of_i, of_f, of_g, of_o = of_gates.chunk(4, dim=1)
        of_i.mul_(g)
        of_f.mul_(before[1])
        torch.mul(i, 1 - g.square(), out=of_g)
        of_o.mul_(squashed)
        return of_gates, o * (1 - squashed.square()), f

    @staticmethod
    def back(factors: Sequence[Tensor], by: Sequence[Tensor], by_given: Tensor, by_carried: Tensor) -> CellState:
        """Write gradients by ``given`` and ``carried``; return those by the state, without that through ``carried``.

        Args:
            by: gradients by the parts of the next state.
        """
        of_gates, of_h, f = factors
        by_h, by_c = by
        by_c = torch.addcmul(by_c, by_h, of_h)
        torch.cat([by_c, by_c, by_c, by_h], dim=1, out=by_carried).mul_(of_gates)
        return torch.zeros_like(by_h), by_c * f


class GRUGates:
    """r, z and n of a GRU with the state h; members as of `LSTMGates`."""

    num_kept = 1
    adds = False

    @staticmethod
    def step(
        given: Tensor, carried: Tensor, before: Sequence[Tensor], after: Sequence[Tensor], kept: Sequence[Tensor]
    ) -> None:
        """Write the next state, and what `factors` needs."""
        [n] = kept
        size = n.shape[1]
        r, z = carried[:, : 2 * size].add_(given[:, : 2 * size]).sigmoid_().chunk(2, dim=1)
        torch.tanh(torch.addcmul(given[:, 2 * size :], r, carried[:, 2 * size :]), out=n)
        torch.lerp(n, before[0], z, out=after[0])

    @staticmethod
    def factors(carried: Tensor, kept: Sequence[Tensor], before: Sequence[Tensor]) -> CellState:
        """Return what gradients are multiplied by."""
        [n] = kept
        r, z, of_h = carried.chunk(3, dim=1)
        of_n = (1 - z) * (1 - n.square())
        of_r = of_n * of_h * r * (1 - r)
        of_z = (before[0] - n) * z * (1 - z)
        return torch.cat([of_r, of_z, of_n], dim=1), torch.cat([of_r, of_z, of_n * r], dim=1), z

    @staticmethod
    def back(factors: Sequence[Tensor], by: Sequence[Tensor], by_given: Tensor, by_carried: Tensor) -> CellState:
        """Write gradients by ``given`` and ``carried``; return those by the state."""
        of_given, of_carried, z = factors
        by_gates = torch.cat([by[0], by[0], by[0]], dim=1)
        torch.mul(by_gates, of_given, out=by_given)
        torch.mul(by_gates, of_carried, out=by_carried)
        return (by[0] * z,)


class GatedTree(NamedTuple):
    """Histories, and the gates of the cell over them."""

    gates: type[LSTMGates] | type[GRUGates]

    tree: Tree

    inputs: Tensor
    """The product of each history's last input, int64 [num_histories]."""


class GatesOverTree(torch.autograd.Function):
    """Outputs of a gated cell at the ends of histories, differentiable once by products and weights."""

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
        carried = torch.empty_like(in_order)
        before = [states[0].new_empty(len(inputs), weight.shape[1]) for _ in states]
        kept = [torch.empty_like(before[0]) for _ in range(gates.num_kept)]
        first = 0
        for size in tree.sizes:
            end = first + size
            shorter = tree.shorter[first:end]
            of_step = [torch.index_select(states[k], 0, shorter, out=part[first:end]) for k, part in enumerate(before)]
            if bias is None:
                product = torch.mm(of_step[0], turned, out=carried[first:end])
            else:
                product = torch.addmm(bias, of_step[0], turned, out=carried[first:end])
            after = [part[tree.sizes[0] + first : tree.sizes[0] + end] for part in states]
            gates.step(in_order[first:end], product, of_step, after, [part[first:end] for part in kept])
            first = end
        ctx.gated = gated
        ctx.has_bias = bias is not None
        ctx.num_parts = len(states)
        ctx.save_for_backward(given, weight, carried, *before, *kept)
        return states[0][tree.sizes[0] :]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_outputs: Tensor) -> tuple[Any, ...]:
        """Return the gradients by the products, the weight and the bias."""
        gates, tree, inputs = ctx.gated
        given, weight, carried, *parts = ctx.saved_tensors
        before = parts[: ctx.num_parts]
        factors = gates.factors(carried, parts[ctx.num_parts :], before)
        by_states = [part.new_zeros(tree.sizes[0] + len(part), part.shape[1]) for part in before]
        by_states[0][tree.sizes[0] :] = by_outputs
        by_carried = torch.empty_like(carried)
        by_given = by_carried if gates.adds else torch.empty_like(carried)
        last = len(inputs)
        for size in reversed(tree.sizes):
            first = last - size
            by = [part[tree.sizes[0] + first : tree.sizes[0] + last] for part in by_states]
            of_step = [part[first:last] for part in factors]
            by_before = gates.back(of_step, by, by_given[first:last], by_carried[first:last])
            if first:
                shorter = tree.shorter[first:last]
                by_states[0].index_add_(0, shorter, torch.addmm(by_before[0], by_carried[first:last], weight))
                for part, value in zip(by_states[1:], by_before[1:], strict=True):
                    part.index_add_(0, shorter, value)
            last = first
        by_weight = by_carried.t() @ before[0]
        by_bias = by_carried.sum(dim=0) if ctx.has_bias else None
        by_products = torch.zeros_like(given).index_add_(0, inputs, by_given)
        return None, by_products, by_weight, by_bias, *[None] * ctx.num_parts
