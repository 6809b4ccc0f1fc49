"""One update: from weights, other tensors, optimiser state and a batch to new weights and measurements.

The step of PyTorch's Adam and RMSprop is a function of tensors, for every executor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.optim.adam import adam
from torch.optim.rmsprop import rmsprop

from baselines.parts.hooks import Hooks
from baselines.parts.networks import Data, TensorsByName
from ctgraph_rl.core.device import captures
from ctgraph_rl.core.dynamics import beside
from ctgraph_rl.core.region import Region

if TYPE_CHECKING:
    from baselines.parts.learner import Learner

OPTIMISERS = ("adam", "rmsprop")

MOMENTS = {torch.optim.Adam: ("exp_avg", "exp_avg_sq"), torch.optim.RMSprop: ("square_avg",)}
"""What an optimiser keeps of each parameter beside its step count."""


def make_optimiser(name: str, parameters: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """Return the optimiser of a name in `OPTIMISERS`, with PyTorch's defaults."""
    if name == "rmsprop":
        return torch.optim.RMSprop(parameters, lr=learning_rate)
    return torch.optim.Adam(parameters, lr=learning_rate, fused=True)


class Parts(NamedTuple):
    """What a step of Adam or RMSprop reads and updates.

    Compiled code that read the optimiser would be bound to it; by its parts it serves all of its kind.
    """

    is_adam: bool
    settings: dict[str, Any]
    parameters: list[Tensor]
    state: list[TensorsByName]
    """The optimiser's state of each parameter, so a state dict is that after ``optimiser.step()``."""


class UpdateState(NamedTuple):
    """What an update reads and writes in place: tensors of one learner, or of several seeds."""

    weights: Sequence[Tensor]
    """By which the losses are differentiated."""

    optimiser: Parts | torch.optim.Optimizer

    tensors: Mapping[str, Tensor] | None = None
    """Of several seeds, all parameters and buffers by name, [seeds, ...] each; None: the learner's."""

    names: Sequence[str] = ()
    """Names of the weights among these tensors."""

    turned: Sequence[str] = ()
    """Names of matrices kept as [seeds, inputs, outputs], as the backward pass returns their gradients."""

    others: Mapping[str, Tensor] = {}
    """From `Learner.other_weights`, of several seeds [seeds, ...] each."""


def update(learner: Learner, state: UpdateState, batch: Data) -> TensorsByName:
    """Minimise the sum of the losses of a batch by one step; return losses and gradient norm.

    It has no branch on data and depends only on its arguments. With several seeds minibatches are [seeds, items, ...]
    and results [seeds].

    Args:
        learner: gives losses and method; with several seeds any of them.
        state: changed in place.
    """
    losses = losses_of(learner, state, batch)
    total = total_loss(losses)
    value = total if state.tensors is None else total.sum()
    gradients = torch.autograd.grad(value, state.weights, materialize_grads=True)  # 0 for what too few steps read
    norm = with_tensors(learner, state, _descend, state, gradients)
    return {**{key: value.detach() for key, value in losses.items()}, "grad_norm": norm}


def losses_of(learner: Learner, state: UpdateState, batch: Data) -> TensorsByName:
    """Return the agent's losses and the method's penalties, of each seed if there are several."""
    if state.tensors is None:
        return learner.losses(state.weights, batch, state.others)
    return over_seeds(learner, type(learner).losses, state, batch, state.others)


def over_seeds(learner: Learner, function: Callable[..., Any], state: UpdateState, *given: Any) -> Any:
    """Return a function of a learner, its weights and further tensors for each seed."""

    def of_one(tensors: TensorsByName, *its: Any) -> Any:
        return _with(learner, tensors, function, state, *its)

    return vmap(of_one)(_seen(state), *given)


def with_tensors(learner: Learner, state: UpdateState, function: Callable[..., Any], *given: Any) -> Any:
    """Return a function of a learner with a state's tensors, those of all seeds at once, and its weights."""
    if state.tensors is None:
        return function(learner, state.weights, *given)
    return _with(learner, _seen(state), function, state, *given)


def _with(
    learner: Learner, tensors: TensorsByName, function: Callable[..., Any], state: UpdateState, *given: Any
) -> Any:
    weights = [tensors[name] for name in state.names]
    return functional_call(learner, tensors, (function, weights, *given), tie_weights=False)


def _seen(state: UpdateState) -> TensorsByName:
    tensors = state.tensors or {}
    return {name: value.mT if name in state.turned else value for name, value in tensors.items()}


def _descend(learner: Learner, weights: Sequence[Tensor], state: UpdateState, gradients: Sequence[Tensor]) -> Tensor:
    is_stacked = state.tensors is not None
    if is_stacked:
        gradients = [unstacked(gradient) for gradient in gradients]
    gradients = transform_gradients(learner, weights, state, gradients)
    if is_stacked:
        gradients = [unstacked(gradient).contiguous() for gradient in gradients]
    norm = norm_of(gradients, num_leading=int(is_stacked))
    scale = (learner.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    with torch.no_grad():
        step(state.optimiser, [gradient * (beside(scale, gradient) if is_stacked else scale) for gradient in gradients])
    if is_stacked and learner.method.of_one_seed:
        over_seeds(learner, _after_step, state)
    else:
        _after_step(learner, weights)
    return norm


def transform_gradients(
    learner: Learner, weights: Sequence[Tensor], state: UpdateState, gradients: Sequence[Tensor]
) -> Sequence[Tensor]:
    """Return the gradients of what is trained, given those of the weights."""
    if state.tensors is not None and learner.method.of_one_seed:
        return over_seeds(learner, _transform_gradients, state, gradients)
    return _transform_gradients(learner, weights, gradients)


def _transform_gradients(learner: Learner, weights: Sequence[Tensor], gradients: Sequence[Tensor]) -> Sequence[Tensor]:
    return learner.method.transform_gradients(gradients, weights)


def _after_step(learner: Learner, weights: Sequence[Tensor]) -> tuple[()]:
    learner.method.after_step(weights)
    return ()  # seeds are vectorised over what returns tensors, or none of them


def norm_of(gradients: Sequence[Tensor], num_leading: int = 0) -> Tensor:
    """Return the norm of all gradients for each of the leading dimensions, in a form that fuses."""
    parts = [gradient.unsqueeze(-1) if gradient.ndim == num_leading else gradient for gradient in gradients]
    if torch.compiler.is_compiling():
        squares = [part.square().sum(dim=tuple(range(num_leading, part.ndim))) for part in parts]
        return torch.stack(squares).sum(dim=0).sqrt()
    norms = [torch.linalg.vector_norm(part, dim=tuple(range(num_leading, part.ndim))) for part in parts]
    return torch.linalg.vector_norm(torch.stack(norms), dim=0)


def total_loss(losses: Mapping[str, Tensor]) -> Tensor:
    """Return the sum of the losses named ``loss_*``, which is minimised."""
    return sum(
        (value for key, value in losses.items() if key.startswith("loss_")),
        start=torch.zeros((), dtype=torch.float32, device="cpu"),
    )


def stacked(tensors: Sequence[Tensor]) -> Tensor:
    """Stack the parameters of several seeds, matrices as [seeds, inputs, outputs]."""
    return torch.stack([tensor.mT if tensor.ndim == 2 else tensor for tensor in tensors])


def unstacked(tensor: Tensor) -> Tensor:
    """Return the parameters of several seeds, [seeds, ...], as a view of a result of `stacked`."""
    return tensor.mT if tensor.ndim == 3 else tensor


def has_parts(optimiser: torch.optim.Optimizer) -> bool:
    """Return whether an optimiser is Adam or RMSprop in its usual form."""
    [group, *others] = optimiser.param_groups
    unusual = any(group.get(key) for key in ("amsgrad", "momentum", "centered", "differentiable"))
    return type(optimiser) in MOMENTS and not others and not unusual


def parts_of(optimiser: torch.optim.Optimizer) -> Parts | torch.optim.Optimizer:
    """Return the parts of an optimiser, which has its state from then on; of another kind the optimiser."""
    if not has_parts(optimiser):
        return optimiser
    [group] = optimiser.param_groups
    parameters: list[Tensor] = list(group["params"])
    states = []
    for parameter in parameters:
        state = optimiser.state[parameter]
        if not state:
            device = parameter.device if group.get("fused") or parameter.is_cuda else "cpu"
            state["step"] = torch.zeros((), dtype=torch.float32, device=device)
            for name in MOMENTS[type(optimiser)]:
                state[name] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        elif parameter.is_cuda:
            state["step"] = state["step"].to(parameter.device)
        states.append(state)
    settings = {key: value for key, value in group.items() if key != "params"}
    return Parts(type(optimiser) is torch.optim.Adam, settings, parameters, states)


def minimise(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
    """Take a step on a loss that all parameters of an optimiser change."""
    gradients = torch.autograd.grad(loss, optimiser.param_groups[0]["params"])
    with torch.no_grad():
        step(parts_of(optimiser), gradients)


def step(optimiser: Parts | torch.optim.Optimizer, gradients: Sequence[Tensor]) -> None:
    """Update an optimiser's parameters and state in place; without `Parts` it takes a step itself."""
    if not isinstance(optimiser, Parts):
        for parameter, gradient in zip(optimiser.param_groups[0]["params"], gradients, strict=True):
            parameter.grad = gradient
        optimiser.step()
        return
    how = optimiser.settings
    parameters = optimiser.parameters
    state = {key: [each[key] for each in optimiser.state] for key in optimiser.state[0]}
    traced = torch.compiler.is_compiling()  # a compiler fuses the operations of each parameter by itself
    foreach = False if traced else how["foreach"]
    given = (parameters, list(gradients))  # compiled, PyTorch's functions need all lists by position
    if optimiser.is_adam:
        adam(
            *given,
            *(state["exp_avg"], state["exp_avg_sq"], []),
            state["step"],
            foreach=foreach,
            fused=False if traced else how["fused"],
            capturable=parameters[0].is_cuda,
            amsgrad=False,
            beta1=how["betas"][0],
            beta2=how["betas"][1],
            lr=how["lr"],
            weight_decay=how["weight_decay"],
            eps=how["eps"],
            maximize=how["maximize"],
        )
    else:
        rmsprop(
            *given,
            *(state["square_avg"], [], []),
            state["step"],
            foreach=foreach,
            capturable=parameters[0].is_cuda,
            lr=how["lr"],
            alpha=how["alpha"],
            eps=how["eps"],
            weight_decay=how["weight_decay"],
            momentum=0.0,
            centered=False,
            maximize=how["maximize"],
        )


def take_step(learner: Learner, batch: Data) -> TensorsByName:
    """Take a step; the first one and unusual sizes run `update` as written."""
    is_first = not learner.optimiser.state
    state = update_state(learner)
    if is_first or len(batch["action"]) != learner.minibatch_size:
        return update(learner, state, batch)
    if not is_captured(learner):
        return usual_update(learner, state, batch)
    learner.region = learner.region or Region(partial(usual_update, learner, state))
    if not learner.region.takes(batch):
        return update(learner, state, batch)
    return learner.region.copies(batch)


def usual_update(learner: Learner, state: UpdateState, batch: Data) -> TensorsByName:
    """Take the step, compiled where the agent is."""
    return (learner.compiled_step or update)(learner, state, batch)


def update_state(learner: Learner) -> UpdateState:
    """Return what an update of a learner changes."""
    return UpdateState(learner.weights, parts_of(learner.optimiser), others=learner.other_weights())


def is_captured(learner: Learner) -> bool:
    """Return whether steps are CUDA graphs: on GPUs, without a method."""
    on_gpu = captures(learner.trainable[0].device)
    return on_gpu and learner.capturable and type(learner.method) is Hooks and has_parts(learner.optimiser)
