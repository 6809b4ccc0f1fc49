"""A plain module as a policy: it maps observations to logits."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from inspect import Parameter, signature
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torchrl.envs.utils import ExplorationType, exploration_type

from ctgraph_rl.checks import require
from ctgraph_rl.learn.collect import Policy, Step


class LogitsPolicy:
    """A plain module that maps observations to logits: greedy, or sampling where exploration is on.

    The module gets observations unscaled, 0 to 255 for images, in the type and on the device of its first parameter. It
    acts in evaluation mode. One-hot task ids, if the protocol shows them, are the second argument of a ``forward`` that
    needs two or names the second ``task_id``.

    Args:
        module: maps float [n, 1, r, r] or [n, K] to float [n, num_actions].
    """

    def __init__(self, module: nn.Module, num_actions: int) -> None:
        self.module = module
        self.num_actions = num_actions
        self._takes_ids = _takes_ids(module.forward)

    def __call__(self, data: TensorDictBase) -> TensorDictBase:
        """Write ``action``, int64 [n]."""
        logits = self._logits(data)
        greedy = exploration_type() == ExplorationType.DETERMINISTIC
        action = logits.argmax(-1) if greedy else torch.distributions.Categorical(logits=logits).sample()
        return data.set("action", action.to(data.device or "cpu"))

    def action_probs(self, data: Step) -> tuple[Tensor, Step]:
        """Return action probabilities, float [n, num_actions], and no state, as `ctgraph_rl.agent.Agent`."""
        logits = self._logits(data)
        if exploration_type() == ExplorationType.DETERMINISTIC:
            return one_hot(logits.argmax(-1), self.num_actions).to(logits.dtype), {}
        return logits.softmax(-1), {}

    def _logits(self, data: TensorDictBase | Step) -> Tensor:
        name = type(self.module).__name__
        shape = list(data["observation"].shape)
        fix = "write one that does, or a function of a TensorDict that sets 'action', or a TensorDictModule"
        like = next(self.module.parameters(), torch.zeros((), dtype=torch.float32, device="cpu"))
        keys = ["observation", "task_id"] if self._takes_ids and "task_id" in data.keys() else ["observation"]  # noqa: SIM118
        read = [f"{key}, float {list(data[key].shape)}" for key in keys]
        wanted = f"a plain module must map {' and '.join(read)}, to logits, float [{shape[0]}, {self.num_actions}]"
        try:
            with _evaluation_mode(self.module):
                logits = self.module(*(data[key].to(like.device, like.dtype) for key in keys))
        except (RuntimeError, TypeError, IndexError, KeyError, AttributeError) as error:
            raise ValueError(
                f"{wanted}; {name} fails with {type(error).__name__}: {str(error)[:200]}. Fix: {fix}"
            ) from error
        is_tensor = isinstance(logits, Tensor)
        fits = is_tensor and logits.is_floating_point() and list(logits.shape) == [shape[0], self.num_actions]
        got = f"{str(logits.dtype).removeprefix('torch.')} {list(logits.shape)}" if is_tensor else type(logits).__name__
        require((fits, f"{wanted}; {name} gives {got}. Fix: {fix}"))
        require((not logits.isnan().any(), f"{name} gives logits that are nan: its weights left the range of floats"))
        return logits


def _takes_ids(function: Any) -> bool:
    try:
        places = positional_parameters(function)
    except ValueError:  # of a traced module, which has none
        return False
    return sum(p.default is p.empty for p in places) == 2 or [p.name for p in places[1:2]] == ["task_id"]


def positional_parameters(function: Any) -> list[Parameter]:
    """Return the positional parameters of a function."""
    kinds = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
    return [parameter for parameter in signature(function).parameters.values() if parameter.kind in kinds]


@contextmanager
def _evaluation_mode(module: nn.Module) -> Iterator[None]:
    training = [each for each in module.modules() if each.training]
    module.eval()
    try:
        yield
    finally:
        for each in training:
            each.training = True


def as_policy(policy: Policy | nn.Module, num_actions: int | None) -> Policy:
    """Return a plain module as a policy of TensorDicts, and a policy unchanged."""
    plain = isinstance(policy, nn.Module) and not isinstance(policy, TensorDictModuleBase)
    if not plain:
        return policy
    require((num_actions is not None, "a plain module gives logits, and actions are continuous: give a function"))
    return LogitsPolicy(policy, num_actions)  # type: ignore[arg-type]
