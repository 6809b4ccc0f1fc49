"""One update: weights, what losses read beside them, optimiser state and a batch to new weights and measurements."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.func import functional_call, vmap

from baselines.parts.networks import Data, TensorsByName
from baselines.update.optimiser import Parts, step

if TYPE_CHECKING:
    from baselines.parts.learner import Learner


class UpdateState(NamedTuple):
    """What an update reads and writes in place: the tensors of one learner, or those of several seeds."""

    weights: Sequence[Tensor]
    """By which the losses are differentiated."""

    optimiser: Parts | torch.optim.Optimizer

    tensors: Mapping[str, Tensor] | None = None
    """Of several seeds all parameters and buffers by name, [seeds, ...] each; None: those that one learner has."""

    names: Sequence[str] = ()
    """Those of the weights among these tensors."""

    turned: Sequence[str] = ()
    """The names of matrices, which are kept as [seeds, inputs, outputs]: so their gradients come out of the backward
    pass."""

    others: Mapping[str, Tensor] = {}
    """Of several seeds what `Learner.other_weights` returns, [seeds, ...] each."""


Update = Callable[["Learner", UpdateState, Data], TensorsByName]


def update(learner: Learner, state: UpdateState, batch: Data) -> TensorsByName:
    """Minimise the sum of the losses of a batch by one step; return losses and gradient norm.

    It has no branch on data and depends only on its arguments. With several seeds these are minibatches [seeds, items,
    ...], and results are [seeds].

    Args:
        learner: whose losses and method are meant; with several seeds any of them.
        state: is changed in place.
        batch: a minibatch.
    """
    losses = losses_of(learner, state, batch)
    total = total_loss(losses)
    gradients = torch.autograd.grad(total if state.tensors is None else total.sum(), state.weights)
    norm = with_tensors(learner, state, _descend, state, gradients)
    return {**{key: value.detach() for key, value in losses.items()}, "grad_norm": norm}


def losses_of(learner: Learner, state: UpdateState, batch: Data) -> TensorsByName:
    """Compute the agent's losses and the method's penalties, of each seed where there are several."""
    if state.tensors is None:
        return learner.losses(batch, state.weights)
    return over_seeds(learner, _losses, state, batch, state.others)


def over_seeds(learner: Learner, function: Callable[..., Any], state: UpdateState, *given: Any) -> Any:
    """Compute a function of a learner, its weights and further tensors for each seed."""

    def of_one(tensors: TensorsByName, *its: Any) -> Any:
        return _with(learner, tensors, function, state, *its)

    return vmap(of_one)(_seen(state), *given)


def with_tensors(learner: Learner, state: UpdateState, function: Callable[..., Any], *given: Any) -> Any:
    """Compute a function of a learner that has the tensors of a state, those of all seeds at once, and its weights."""
    if state.tensors is None:
        return function(learner, state.weights, *given)
    return _with(learner, _seen(state), function, state, *given)


def _with(
    learner: Learner, tensors: TensorsByName, function: Callable[..., Any], state: UpdateState, *given: Any
) -> Any:
    weights = [tensors[name] for name in state.names]
    return functional_call(learner, tensors, (function, weights, *given), tie_weights=False)


def _losses(learner: Learner, weights: Sequence[Tensor], batch: Data, others: Data) -> TensorsByName:
    return learner.losses(batch, weights, others)


def _seen(state: UpdateState) -> TensorsByName:
    """Return the tensors of several seeds as the networks see them."""
    tensors = state.tensors or {}
    return {name: value.mT if name in state.turned else value for name, value in tensors.items()}


def _descend(learner: Learner, weights: Sequence[Tensor], state: UpdateState, gradients: Sequence[Tensor]) -> Tensor:
    """Take the optimiser's step; return the norm of the gradients, of each seed where there are several."""
    is_stacked = state.tensors is not None
    if is_stacked:
        gradients = [unstacked(gradient) for gradient in gradients]
    gradients = learner.method.transform_gradients(gradients, weights)
    if is_stacked:
        gradients = [unstacked(gradient).contiguous() for gradient in gradients]
    norm = norm_of(gradients, num_leading=int(is_stacked))
    scale = (learner.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    with torch.no_grad():
        step(state.optimiser, [gradient * _beside(scale, gradient) for gradient in gradients])
    learner.method.after_step(weights)
    return norm


def norm_of(gradients: Sequence[Tensor], num_leading: int = 0) -> Tensor:
    """Return the norm of all gradients, of each of the leading dimensions; compiled in a form that fuses."""
    parts = [gradient.unsqueeze(-1) if gradient.ndim == num_leading else gradient for gradient in gradients]
    if torch.compiler.is_compiling():
        squares = [part.square().sum(dim=tuple(range(num_leading, part.ndim))) for part in parts]
        return torch.stack(squares).sum(dim=0).sqrt()
    norms = [torch.linalg.vector_norm(part, dim=tuple(range(num_leading, part.ndim))) for part in parts]
    return torch.linalg.vector_norm(torch.stack(norms), dim=0)


def _beside(scale: Tensor, gradient: Tensor) -> Tensor:
    """Return a scale, or that of each seed, in the form that multiplies a gradient."""
    return scale.view(-1, *[1] * (gradient.ndim - 1)) if scale.ndim else scale


def total_loss(losses: Mapping[str, Tensor]) -> Tensor:
    """Return the sum of the losses named ``loss_*``, which is what is minimised."""
    return sum(
        (value for key, value in losses.items() if key.startswith("loss_")),
        start=torch.zeros((), dtype=torch.float32, device="cpu"),
    )


def stacked(tensors: Sequence[Tensor]) -> Tensor:
    """Stack the parameters of several seeds, matrices as [seeds, inputs, outputs]."""
    return torch.stack([tensor.mT if tensor.ndim == 2 else tensor for tensor in tensors])


def unstacked(tensor: Tensor) -> Tensor:
    """Return the parameters of several seeds without a copy, [seeds, ...]: a view of what `stacked` returned."""
    return tensor.mT if tensor.ndim == 3 else tensor
