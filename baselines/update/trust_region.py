"""A step of TRPO (Schulman et al. 2015, arXiv 1502.05477) for discrete actions, in plain tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.func import grad, jvp, vjp

CONJUGATE_STEPS = 10
DAMPING = 1e-5
LINE_SEARCH_STEPS = 15
SHRINKAGE = 0.8


@torch.no_grad()
def trust_region_step(
    weights: Sequence[tuple[str, nn.Parameter]],
    logits_of: Callable[[dict[str, Tensor]], Tensor],
    loss_of: Callable[[Tensor], Tensor],
    *,
    weight: Tensor,
    max_kl: float,
) -> dict[str, Tensor]:
    """Minimise a loss within a trust region, in place: the largest of some steps that lower it within ``max_kl``.

    The direction solves F x = -g by conjugate gradients, where F is the Hessian of the mean divergence from the present
    policy. There it is exactly the Gauss-Newton matrix J' (diag(p) - p p') J of the logits' Jacobian J.

    Args:
        logits_of: computes logits, [..., num_actions], from weights by name.
        loss_of: computes the loss, a scalar, from logits.
        weight: of each step in the mean divergence, [...]; its sum is 1.

    Returns:
        ``loss_policy`` before the step, ``grad_norm``, ``kl`` of the step and ``step_scale``, 0 where none was taken.
    """
    sizes = [value.numel() for _, value in weights]
    present = torch.cat([value.flatten() for _, value in weights])

    def logits_at(vector: Tensor) -> Tensor:
        parts = vector.split(sizes)
        return logits_of({name: part.view_as(value) for (name, value), part in zip(weights, parts, strict=True)})

    at_present = vjp(logits_at, present)
    logits = at_present[0]
    pull = at_present[1]
    chances = logits.softmax(dim=-1)
    gradient = pull(grad(loss_of)(logits))[0]

    def curvature(vector: Tensor) -> Tensor:
        pushed = jvp(logits_at, (present,), (vector,))[1]
        scaled = chances * pushed
        change = scaled - chances * scaled.sum(dim=-1, keepdim=True)
        return pull(weight.unsqueeze(-1) * change)[0] + DAMPING * vector

    direction = conjugate_gradients(curvature, -gradient)
    length = (2 * max_kl / (direction @ curvature(direction))).sqrt()
    before = loss_of(logits)
    scale = kl = torch.zeros_like(before)
    for trial in range(LINE_SEARCH_STEPS):
        candidate = present + SHRINKAGE**trial * length * direction
        found = logits_at(candidate)
        divergence = (weight * kl_divergence(logits, found)).sum()
        if loss_of(found) < before and divergence < max_kl:
            scale = torch.full_like(before, SHRINKAGE**trial)
            kl = divergence
            for (_, value), part in zip(weights, candidate.split(sizes), strict=True):
                value.copy_(part.view_as(value))
            break
    return {"loss_policy": before, "grad_norm": gradient.norm(), "kl": kl, "step_scale": scale}


def kl_divergence(logits: Tensor, others: Tensor) -> Tensor:
    """Return the divergence of categorical distributions from others, [...], from logits [..., num_actions]."""
    log_chances = logits.log_softmax(dim=-1)
    return (log_chances.exp() * (log_chances - others.log_softmax(dim=-1))).sum(dim=-1)


def conjugate_gradients(product: Callable[[Tensor], Tensor], target: Tensor) -> Tensor:
    """Solve F x = b approximately, from x = 0.

    Args:
        product: computes F v.
        target: b.
    """
    solution = torch.zeros_like(target)
    residual = target.clone()
    direction = target.clone()
    square = residual @ residual
    for _ in range(CONJUGATE_STEPS):
        if square < 1e-10:
            break
        image = product(direction)
        step = square / (direction @ image)
        solution += step * direction
        residual -= step * image
        last = square
        square = residual @ residual
        direction = residual + square / last * direction
    return solution
