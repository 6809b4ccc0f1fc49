"""What all learners share: an optimiser, the gradient step, and a state dict with both."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, ClassVar

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from baselines.compiled import compiled_step, total
from baselines.networks import Data
from ctgraph_rl.checks import at_least_one, positive, require

LARGEST_WEIGHT = 1e12
"""Beyond this a network has diverged, and its outputs soon overflow."""

OPTIMISERS = ("adam", "rmsprop")


class Learner(nn.Module):
    """A module with an optimiser. Agents derive from it; the defaults are those of an agent without memory.

    Args:
        num_envs: rows that it learns from.
        num_steps: steps of each row in a batch.
        max_grad_norm: gradients are scaled down to this norm.
        compile: run gradient steps of the usual size through ``torch.compile``: faster where networks and minibatches
            are small, after seconds of compiling. An agent with ``memory`` refuses it: its LSTM gains nothing.
    """

    memory: ClassVar[bool] = False
    """Whether what it did and saw earlier in an episode can change what it does."""

    solves: ClassVar[str]
    """What it can solve in principle, in a few words."""

    policy: TensorDictModuleBase
    optimiser: torch.optim.Optimizer

    minibatch_size: int
    """Items that a gradient step learns from, unless a batch was shortened."""

    def __init__(self, num_envs: int, num_steps: int, max_grad_norm: float, compile: bool = False) -> None:
        super().__init__()
        require(
            *at_least_one(num_envs=num_envs, num_steps=num_steps),
            *positive(max_grad_norm=max_grad_norm),
            *true_or_false(compile=compile),
        )
        require((not (compile and self.memory), "compile must be false for an agent with an LSTM, which gains nothing"))
        self.compiled_step = compiled_step() if compile else None
        self.num_envs, self.num_steps, self.max_grad_norm = num_envs, num_steps, max_grad_norm

    def initial_state(self, num_envs: int) -> TensorDict:
        """No recurrent state."""
        return TensorDict(batch_size=[num_envs])

    def policy_for(self, task: int) -> TensorDictModuleBase:
        """The policy that acts in a task; the same for all."""
        return self.policy

    def start_task(self, task: int | None = None) -> None:
        """Nothing to do."""

    def end_task(self) -> None:
        """Nothing to do."""

    def loss(self, batch: Data) -> dict[str, Tensor]:
        """The losses of a batch; see `ctgraph_rl.agent.Agent`."""
        raise NotImplementedError

    def gradient_step(self, batch: Data) -> dict[str, Tensor]:
        """Minimise the sum of the losses of a batch by one step; returns losses and gradient norm."""
        usual = len(batch["action"]) == self.minibatch_size and self.optimiser.state
        if self.compiled_step is not None and usual:
            return self.compiled_step(self, batch)
        losses = self.loss(batch)
        self.optimiser.zero_grad()
        total(losses).backward()
        norm = nn.utils.clip_grad_norm_(self.parameters(), self.max_grad_norm)
        self.optimiser.step()
        return {**{key: value.detach() for key, value in losses.items()}, "grad_norm": norm}

    def measured(self, steps: list[dict[str, Tensor]]) -> dict[str, float]:
        """The mean of each measurement over gradient steps, none of which may have gone wrong.

        Raises:
            FloatingPointError: names the first number that is not finite, or the largest weight.
        """
        table = torch.stack([torch.stack(list(step.values())) for step in steps], dim=1)
        for wrong in (~table.isfinite()).any(dim=0).nonzero()[:1, 0]:
            for name, value in zip(steps[0], table[:, wrong], strict=True):
                require_finite(name, value)
        largest = torch.stack(torch._foreach_norm(list(self.parameters()), torch.inf)).max()
        require_finite("the largest weight", largest, LARGEST_WEIGHT)
        return dict(zip(steps[0], table.mean(dim=1).tolist(), strict=True))

    def get_extra_state(self) -> dict[str, Any]:
        """The optimiser's state, so that `state_dict` is complete."""
        return {"optimiser": self.optimiser.state_dict()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` gave."""
        self.optimiser.load_state_dict(state["optimiser"])


def make_optimiser(name: str, parameters: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """The optimiser of a name in `OPTIMISERS`, otherwise as PyTorch sets it."""
    if name == "rmsprop":
        return torch.optim.RMSprop(parameters, lr=learning_rate)
    return torch.optim.Adam(parameters, lr=learning_rate, fused=True)


def one_of(choices: tuple[str, ...], **values: object) -> list[tuple[bool, str]]:
    """Rules that each named value is one of the choices."""
    return [
        (value in choices, f"{name} must be one of {', '.join(choices)}, got {value!r}")
        for name, value in values.items()
    ]


def true_or_false(**values: object) -> list[tuple[bool, str]]:
    """Rules that each named value is a bool."""
    return [(isinstance(value, bool), f"{name} must be true or false, got {value!r}") for name, value in values.items()]


def require_finite(name: str, value: Tensor, most: float = math.inf) -> None:
    """Stop learning where a number is NaN, infinite or larger than ``most``.

    Raises:
        FloatingPointError: names the number.
    """
    if not (value.isfinite() and value.abs() <= most):
        raise FloatingPointError(f"{name} is {value.item():g}")
