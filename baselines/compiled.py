"""The gradient step as one function of tensors, for ``torch.compile``: losses, gradients, clipping and optimiser.

With small networks and minibatches nearly all time is spent between operations; compiled, the step has no such gaps.
The optimisers are PyTorch's own functions over PyTorch's own state, so state dicts do not tell how a step was taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import FunctionType
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.optim.adam import adam
from torch.optim.rmsprop import rmsprop

from baselines.networks import Data

if TYPE_CHECKING:
    from baselines.learner import Learner

Step = Callable[["Learner", Data], dict[str, Tensor]]


def compiled_step() -> Step:
    """`whole_step`, compiled for one agent and one size of minibatches.

    Each call gives code of its own, as the number of compilations of one is limited. Between its operations are no
    checks of sizes and, on machines without a GPU, no Python.
    """
    torch._dynamo.config.trace_autograd_ops = True  # so that gradients are in the graph; a patch costs 0.07 ms a step
    code = whole_step.__code__.replace()
    options: dict[str, Any] = {"size_asserts": False, "cpp_wrapper": not torch.cuda.is_available()}
    return torch.compile(FunctionType(code, whole_step.__globals__), fullgraph=True, dynamic=False, options=options)


def whole_step(learner: Learner, batch: Data) -> dict[str, Tensor]:
    """What `Learner.gradient_step` does, without a branch on data; the optimiser must have its state."""
    losses, parameters = learner.losses(batch), learner.live
    gradients = learner.method.gradients(torch.autograd.grad(total(losses), learner.weights))
    norm = torch.stack([gradient.square().sum() for gradient in gradients]).sum().sqrt()  # fuses; PyTorch's does not
    scale = (learner.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    with torch.no_grad():
        _update(learner.optimiser, parameters, [gradient * scale for gradient in gradients])
    learner.method.settle()
    return {**{key: value.detach() for key, value in losses.items()}, "grad_norm": norm}


def total(losses: dict[str, Tensor]) -> Tensor:
    """What is minimised: the sum of the losses named ``loss_*``."""
    return sum((value for key, value in losses.items() if key.startswith("loss_")), start=torch.zeros(()))


def _update(optimiser: torch.optim.Optimizer, parameters: Sequence[Tensor], gradients: list[Tensor]) -> None:
    """One step of the optimiser in place."""
    group = optimiser.param_groups[0]
    state: dict[str, list[Tensor]] = {
        key: [optimiser.state[parameter][key] for parameter in parameters] for key in optimiser.state[parameters[0]]
    }
    same: dict[str, Any] = {key: group[key] for key in ("lr", "eps", "weight_decay", "maximize")}
    same |= {"foreach": False, "capturable": parameters[0].is_cuda}
    if isinstance(optimiser, torch.optim.Adam):
        moments = state["exp_avg"], state["exp_avg_sq"]
        (beta1, beta2), amsgrad = group["betas"], group["amsgrad"]
        adam(
            list(parameters), gradients, *moments, [], state["step"], amsgrad=amsgrad, beta1=beta1, beta2=beta2, **same
        )
    else:
        more = {key: group[key] for key in ("alpha", "momentum", "centered")}
        rmsprop(list(parameters), gradients, state["square_avg"], [], [], state["step"], **more, **same)
