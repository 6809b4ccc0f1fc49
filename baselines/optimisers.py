"""Optimisers by name, and their step as a function of tensors, which ``torch.compile`` can trace."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.adam import adam
from torch.optim.rmsprop import rmsprop

OPTIMISERS = ("adam", "rmsprop")


def make_optimiser(name: str, parameters: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """Return the optimiser of a name in `OPTIMISERS`, with PyTorch's defaults."""
    if name == "rmsprop":
        return torch.optim.RMSprop(parameters, lr=learning_rate)
    return torch.optim.Adam(parameters, lr=learning_rate, fused=True)


def functional_step(optimiser: torch.optim.Optimizer, gradients: list[Tensor]) -> None:
    """Update an optimiser's parameters in place by PyTorch's own functions on the optimiser's own state.

    A state dict is the same as after ``optimiser.step()``.
    """
    group = optimiser.param_groups[0]
    parameters: list[Tensor] = list(group["params"])
    state: dict[str, list[Tensor]] = {
        key: [optimiser.state[parameter][key] for parameter in parameters] for key in optimiser.state[parameters[0]]
    }
    settings: dict[str, Any] = {key: group[key] for key in ("lr", "eps", "weight_decay", "maximize")}
    settings |= {"foreach": False, "capturable": parameters[0].is_cuda}
    if isinstance(optimiser, torch.optim.Adam):  # compiled, PyTorch's functions need all lists by position
        moments: tuple[list[Tensor], list, list] = (state["exp_avg"], state["exp_avg_sq"], [])
        beta1, beta2 = group["betas"]
        settings |= {"amsgrad": group["amsgrad"], "beta1": beta1, "beta2": beta2}
        adam(parameters, gradients, *moments, state["step"], **settings)
    else:
        averages: tuple[list[Tensor], list, list] = (state["square_avg"], [], [])
        settings |= {key: group[key] for key in ("alpha", "momentum", "centered")}
        rmsprop(parameters, gradients, *averages, state["step"], **settings)
