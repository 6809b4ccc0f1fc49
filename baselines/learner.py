"""What all learners share: an optimiser, the gradient step, and a state dict with both."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from baselines.compiled import compiled_step, total
from baselines.methods.method import Method
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

    output_keys: ClassVar[tuple[str, ...]]
    """What `outputs` gives that the network itself makes."""

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
        self.method = Method()
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

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch; see `ctgraph_rl.agent.Agent`."""
        raise NotImplementedError

    def num_learnt(self, batch: TensorDictBase) -> int:
        """Frames of a batch that one pass learns from."""
        return batch.numel()

    def outputs(self, data: Data) -> dict[str, Tensor]:
        """What the network says of any number of steps, [..., n] each.

        ``log_probs`` of all actions; and those of `output_keys`: ``state_value`` or ``action_value``.
        """
        raise NotImplementedError

    @cached_property
    def weights(self) -> list[nn.Parameter]:
        """What the losses are differentiated by."""
        return list(self.live)

    @property
    def live(self) -> list[nn.Parameter]:
        """What the optimiser changes: the weights, unless a method has put something else in their place."""
        return self.optimiser.param_groups[0]["params"]

    def optimise(self, parameters: Sequence[nn.Parameter]) -> None:
        """Let a new optimiser of the same kind change these parameters."""
        self.optimiser = type(self.optimiser)(parameters, **self.optimiser.defaults)
        if self.compiled_step is not None:
            self.compiled_step = compiled_step()

    def forget(self, parameters: Iterable[nn.Parameter]) -> None:
        """Let the optimiser forget what it knows of parameters."""
        for parameter in parameters:
            for value in self.optimiser.state.get(parameter, {}).values():
                value.zero_()

    def draw_weights(self) -> None:
        """Draw all weights anew, in the way in which the agent began; layers need ``reset_parameters``."""
        self.policy.apply(_draw)

    def weights_changed(self) -> None:
        """Called where the weights were changed other than by learning; nothing else depends on them."""

    def losses(self, batch: Data) -> dict[str, Tensor]:
        """The agent's losses and the method's."""
        return {**self.loss(batch), **self.method.loss(batch)}

    def gradient_step(self, batch: Data) -> dict[str, Tensor]:
        """Minimise the sum of the losses of a batch by one step; returns losses and gradient norm."""
        batch = self.method.mixed(batch)
        weights = self.weights  # also for the compiled step: a cached property that is not there yet cannot be traced
        usual = len(batch["action"]) == self.minibatch_size and self.optimiser.state
        if self.compiled_step is not None and usual:
            return self.compiled_step(self, batch)
        losses = self.losses(batch)
        gradients = torch.autograd.grad(total(losses), weights)
        for parameter, gradient in zip(self.live, self.method.gradients(gradients), strict=True):
            parameter.grad = gradient
        norm = nn.utils.clip_grad_norm_(self.live, self.max_grad_norm)
        self.optimiser.step()
        self.method.settle()
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


def _draw(module: nn.Module) -> None:
    """Draw the weights of a layer, as PyTorch does at its construction."""
    if list(module.parameters(recurse=False)):
        module.reset_parameters()  # type: ignore[operator]


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
