"""Optimisers by name, and their step as a function of tensors: PyTorch's own Adam and RMSprop, for every executor."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim.adam import adam
from torch.optim.rmsprop import rmsprop

OPTIMISERS = ("adam", "rmsprop")

MOMENTS = {torch.optim.Adam: ("exp_avg", "exp_avg_sq"), torch.optim.RMSprop: ("square_avg",)}
"""What an optimiser keeps of each parameter beside the number of its steps."""


def make_optimiser(name: str, parameters: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """Return the optimiser of a name in `OPTIMISERS`, with PyTorch's defaults."""
    if name == "rmsprop":
        return torch.optim.RMSprop(parameters, lr=learning_rate)
    return torch.optim.Adam(parameters, lr=learning_rate, fused=True)


class Parts(NamedTuple):
    """What a step of Adam or RMSprop reads and updates.

    Compiled code that read the optimiser itself would be bound to that one; by its parts it serves all of its kind.
    """

    is_adam: bool
    settings: dict[str, Any]
    parameters: list[Tensor]
    state: list[dict[str, Tensor]]
    """Of each parameter: the optimiser's own, so a state dict is the same as after ``optimiser.step()``."""


def has_parts(optimiser: torch.optim.Optimizer) -> bool:
    """Return whether an optimiser is one of which `Parts` say all: Adam or RMSprop in their usual form."""
    [group, *others] = optimiser.param_groups
    unusual = any(group.get(key) for key in ("amsgrad", "momentum", "centered", "differentiable"))
    return type(optimiser) in MOMENTS and not others and not unusual


def parts_of(optimiser: torch.optim.Optimizer) -> Parts | torch.optim.Optimizer:
    """Return the parts of an optimiser, which has its state from then on; of another kind the optimiser itself."""
    if not has_parts(optimiser):
        return optimiser
    [group] = optimiser.param_groups
    parameters: list[Tensor] = list(group["params"])
    state = [_state_of(optimiser, parameter, bool(group.get("fused"))) for parameter in parameters]
    settings = {key: value for key, value in group.items() if key != "params"}
    return Parts(type(optimiser) is torch.optim.Adam, settings, parameters, state)


def _state_of(optimiser: torch.optim.Optimizer, parameter: Tensor, fused: bool) -> dict[str, Tensor]:
    """Return the state of a parameter, as PyTorch makes it; on a GPU the number of steps is there for CUDA graphs."""
    state = optimiser.state[parameter]
    if not state:
        device = parameter.device if fused or parameter.is_cuda else "cpu"
        state["step"] = torch.zeros((), dtype=torch.float32, device=device)
        for name in MOMENTS[type(optimiser)]:
            state[name] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
    elif parameter.is_cuda:
        state["step"] = state["step"].to(parameter.device)
    return state


def step(optimiser: Parts | torch.optim.Optimizer, gradients: Sequence[Tensor]) -> None:
    """Update an optimiser's parameters and state in place; one that has no `Parts` takes a step by itself."""
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
