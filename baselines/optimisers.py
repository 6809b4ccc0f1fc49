"""Optimisers by name, and their step as a function of tensors, which ``torch.compile`` can trace."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim.adam import adam
from torch.optim.rmsprop import rmsprop

OPTIMISERS = ("adam", "rmsprop")

LATE = 1e9
"""A step of Adam so late that its moments need no correction."""


def make_optimiser(name: str, parameters: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """Return the optimiser of a name in `OPTIMISERS`, with PyTorch's defaults."""
    if name == "rmsprop":
        return torch.optim.RMSprop(parameters, lr=learning_rate)
    return torch.optim.Adam(parameters, lr=learning_rate, fused=True)


@contextmanager
def capturable(optimiser: torch.optim.Optimizer) -> Iterator[None]:
    """Let an optimiser's steps be captured as a CUDA graph, which PyTorch refuses without this setting."""
    [group], on_gpu = optimiser.param_groups, optimiser.param_groups[0]["params"][0].is_cuda
    for parameter in group["params"] if on_gpu else ():
        state = optimiser.state[parameter]
        state["step"] = state["step"].to(parameter.device)
    before, group["capturable"] = group["capturable"], on_gpu
    try:
        yield
    finally:
        group["capturable"] = before


class OptimiserParts(NamedTuple):
    """What a step of an optimiser reads and updates.

    Compiled code that read the optimiser itself would be bound to that one; by its parts it serves all of its kind.
    """

    is_adam: bool
    settings: dict[str, Any]
    parameters: list[Tensor]
    state: list[dict[str, Tensor]]
    """Of each parameter."""


def parts_of(optimiser: torch.optim.Optimizer) -> OptimiserParts:
    """Return the parts of an optimiser that has its state; tensors are the optimiser's own, not copies."""
    [group], is_adam = optimiser.param_groups, isinstance(optimiser, torch.optim.Adam)
    names = ("betas", "amsgrad") if is_adam else ("alpha", "momentum", "centered")
    settings = {key: group[key] for key in ("lr", "eps", "weight_decay", "maximize", *names)}
    parameters: list[Tensor] = list(group["params"])
    return OptimiserParts(is_adam, settings, parameters, [optimiser.state[parameter] for parameter in parameters])


def functional_step(parts: OptimiserParts, gradients: list[Tensor]) -> None:
    """Update an optimiser's parameters in place by PyTorch's own functions on the optimiser's own state.

    A state dict is the same as after ``optimiser.step()``.
    """
    parameters = parts.parameters
    state: dict[str, list[Tensor]] = {key: [each[key] for each in parts.state] for key in parts.state[0]}
    settings: dict[str, Any] = {**parts.settings, "foreach": False, "capturable": parameters[0].is_cuda}
    if parts.is_adam:  # compiled, PyTorch's functions need all lists by position
        moments: tuple[list[Tensor], list[Tensor], list[Tensor]] = (state["exp_avg"], state["exp_avg_sq"], [])
        settings["beta1"], settings["beta2"] = settings.pop("betas")
        adam(parameters, gradients, *moments, state["step"], **settings)
    else:
        averages: tuple[list[Tensor], list[Tensor], list[Tensor]] = (state["square_avg"], [], [])
        rmsprop(parameters, gradients, *averages, state["step"], **settings)


def is_stackable(optimiser: torch.optim.Optimizer) -> bool:
    """Return whether `StackedOptimiser` takes the steps of an optimiser: of one that `make_optimiser` returns."""
    name = {torch.optim.Adam: "adam", torch.optim.RMSprop: "rmsprop"}.get(type(optimiser))
    if name is None or len(optimiser.param_groups) != 1:
        return False
    usual = make_optimiser(name, [nn.Parameter(torch.zeros(1))], optimiser.defaults["lr"])
    return optimiser.defaults == usual.defaults


class StackedOptimiser:
    """The steps of equal optimisers of several seeds in one operation, PyTorch's fused Adam.

    RMSprop is Adam without a first moment, beta1 = 0, whose second moment needs no correction: that of a late step.

    Args:
        optimisers: of each seed; their state is read, and written by `write`.
        parameters: for each parameter of an optimiser those of all seeds, `stacked`.
    """

    def __init__(self, optimisers: Sequence[torch.optim.Optimizer], parameters: Sequence[Tensor]) -> None:
        self.optimisers, self.parameters, self.num_steps = optimisers, parameters, 0
        self.own = list(zip(*(optimiser.param_groups[0]["params"] for optimiser in optimisers), strict=True))
        settings, self.is_adam = optimisers[0].defaults, isinstance(optimisers[0], torch.optim.Adam)
        betas = settings["betas"] if self.is_adam else (0.0, settings["alpha"])
        self.adam = torch.optim.Adam(parameters, settings["lr"], betas, settings["eps"], fused=True)
        self.state = [self._read(parameter, own) for parameter, own in zip(parameters, self.own, strict=True)]
        self.adam.state.update(zip(parameters, self.state, strict=True))
        self.steps_before = [state["step"].item() for state in self.state]
        self.corrections: Tensor | None = None

    @property
    def moments(self) -> dict[str, str]:
        """The moments in Adam's state, and as the optimisers name them."""
        return {"exp_avg": "exp_avg", "exp_avg_sq": "exp_avg_sq"} if self.is_adam else {"exp_avg_sq": "square_avg"}

    def _read(self, parameter: Tensor, own: Sequence[Tensor]) -> dict[str, Tensor]:
        """Return Adam's state of a parameter of all seeds; the optimisers have none before the first step."""
        states = [optimiser.state.get(each, {}) for optimiser, each in zip(self.optimisers, own, strict=True)]
        state = {key: torch.zeros_like(parameter) for key in ("exp_avg", "exp_avg_sq")}
        state["step"] = torch.full((), 0.0 if self.is_adam else LATE, device=parameter.device)
        if states[0]:
            state |= {key: stacked([each[name] for each in states]) for key, name in self.moments.items()}
            if self.is_adam:
                state["step"] = torch.stack([each["step"] for each in states]).amax(dim=0)  # a seed that failed has 0
        return state

    def step(self, gradients: Iterable[Tensor], max_norm: float) -> Tensor:
        """Scale the gradients of each seed down to a norm, and take a step; return the norms before, [seeds]."""
        gradients = [gradient.contiguous() for gradient in gradients]  # as the fused step needs them
        norms = [torch.linalg.vector_norm(each, dim=tuple(range(1, each.ndim))) for each in gradients]
        norm = torch.linalg.vector_norm(torch.stack(norms), dim=0)
        scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
        gradients = [gradient * scale.view(-1, *[1] * (gradient.ndim - 1)) for gradient in gradients]
        if self.corrections is not None:
            how = {key: self.adam.defaults[key] for key in ("betas", "eps")}
            adam_step(self.parameters, gradients, self.state, self.corrections, **how)
            return norm
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient
        self.adam.step()
        self.num_steps += 1
        return norm

    @property
    def tensors(self) -> list[Tensor]:
        """The tensors beside parameters that a step by functions alone needs: moments, and the next step's corrections.

        These are, of each parameter, the learning rate over the correction of the first moment, and one over the root
        of the second's.
        """
        moments = [state[key] for key in ("exp_avg", "exp_avg_sq") for state in self.state]
        (beta1, beta2), rate = self.adam.defaults["betas"], self.adam.defaults["lr"]
        numbers = [before + self.num_steps + 1 for before in self.steps_before]
        corrections = [(rate / (1 - beta1**number), (1 - beta2**number) ** -0.5) for number in numbers]
        return [*moments, torch.tensor(corrections, dtype=moments[0].dtype, device=moments[0].device)]

    def functional(self, parameters: Sequence[Tensor], tensors: Sequence[Tensor]) -> StackedOptimiser:
        """Return a copy that updates other parameters and `tensors` in place, by functions that can be traced."""
        other, count = copy(self), len(parameters)
        first, second, other.corrections = tensors[:count], tensors[count : 2 * count], tensors[-1]
        pairs = zip(first, second, strict=True)
        other.parameters = parameters
        other.state = [{"exp_avg": one, "exp_avg_sq": two} for one, two in pairs]
        return other

    @torch.no_grad()
    def write(self) -> None:
        """Write the state to the optimisers of the seeds."""
        for of_all, own in zip(self.state, self.own, strict=True):
            moments = {name: unstacked(of_all[key]) for key, name in self.moments.items()}
            for number, (optimiser, each) in enumerate(zip(self.optimisers, own, strict=True)):
                state = optimiser.state[each]
                if not state:
                    zeros = {name: torch.zeros_like(each) for name in moments}
                    state |= {"step": torch.zeros((), device=each.device), **zeros}
                state["step"].add_(self.num_steps)
                for name, value in moments.items():
                    state[name].copy_(value[number])
        self.num_steps = 0


@torch.no_grad()
def adam_step(
    parameters: Iterable[Tensor],
    gradients: Iterable[Tensor],
    states: Iterable[dict[str, Tensor]],
    corrections: Tensor,
    *,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Take a step of Adam in place, by functions that compile to one pass over each parameter.

    Args:
        parameters: of the network.
        gradients: of each.
        states: the moments of each.
        corrections: of each the learning rate over the correction of the first moment, and one over the root of the
            second's; [parameters, 2]..
        betas: decay of both moments.
        eps: is added to the root of the second moment.
    """
    given = zip(parameters, gradients, states, corrections.unbind(), strict=True)
    for parameter, gradient, state, (rate, inverse) in given:
        first = state["exp_avg"].lerp_(gradient, 1 - betas[0]) if betas[0] else gradient
        second = state["exp_avg_sq"].mul_(betas[1]).addcmul_(gradient, gradient, value=1 - betas[1])
        parameter.sub_(rate * first / (second.sqrt() * inverse + eps))


def stacked(tensors: Sequence[Tensor]) -> Tensor:
    """Stack the parameters of several seeds, matrices as [seeds, inputs, outputs].

    In this order in memory their gradients come out of the backward pass.
    """
    return torch.stack([tensor.mT if tensor.ndim == 2 else tensor for tensor in tensors])


def unstacked(tensor: Tensor) -> Tensor:
    """Return the parameters of several seeds as they are, [seeds, ...]: a view of what `stacked` returned."""
    return tensor.mT if tensor.ndim == 3 else tensor
