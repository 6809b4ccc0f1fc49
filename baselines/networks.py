"""Network parts that agents share: encoder, memory, heads."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import LSTMModule, ProbabilisticActor, ValueOperator

STATE_KEYS = ("recurrent_state_h", "recurrent_state_c")
"""Where a recurrent policy keeps its state."""


class Encoder(nn.Module):
    """uint8 observations to features: scale to [0, 1], flatten, linear layers with ReLU.

    Args:
        shape: shape of one observation.
        high: largest value of an observation.
        num_features: width of every layer.
        num_layers: linear layers, at least 1.
        num_extra: numbers that are joined to the flat observation, such as a one-hot task id.
    """

    def __init__(
        self, shape: torch.Size, high: float, num_features: int, num_layers: int = 1, num_extra: int = 0
    ) -> None:
        super().__init__()
        self.event_dims, self.scale = len(shape), 1 / high
        self.linear = nn.Linear(shape.numel() + num_extra, num_features)
        layers = [layer for _ in range(num_layers - 1) for layer in (nn.Linear(num_features, num_features), nn.ReLU())]
        self.further = nn.Sequential(*layers)

    def forward(self, observation: Tensor, *extra: Tensor) -> Tensor:
        """uint8 [..., *shape] and [..., n] each to float32 [..., num_features]."""
        flat = observation.flatten(-self.event_dims).float() * self.scale
        flat = torch.cat([flat, *(values.float() for values in extra)], dim=-1) if extra else flat
        return self.further(self.linear(flat).relu())


def encoder(observation_spec: Composite, num_features: int, num_layers: int = 1, **extra: int) -> TensorDictModule:
    """An `Encoder` that reads ``observation`` and, where the environment gives it, ``task_id``; writes ``features``.

    Args:
        observation_spec: the environment's, without batch dimensions.
        num_features: width of the features.
        num_layers: linear layers.
        extra: further keys to read, with their widths.
    """
    spec = observation_spec["observation"]
    if "task_id" in observation_spec.keys():  # noqa: SIM118, a Composite is no dict
        extra = {"task_id": observation_spec["task_id"].shape.numel(), **extra}
    module = Encoder(spec.shape, spec.space.high.max().item(), num_features, num_layers, sum(extra.values()))
    return TensorDictModule(module, in_keys=["observation", *extra], out_keys=["features"])


def recurrent(observation_spec: Composite, num_features: int, num_layers: int, **extra: int) -> TensorDictSequential:
    """An `encoder` with an LSTM of the same width behind it; writes ``memory``, and its state under `STATE_KEYS`."""
    lstm = LSTMModule(num_features, num_features, in_key="features", out_key="memory")
    return TensorDictSequential(encoder(observation_spec, num_features, num_layers, **extra), lstm)


def zero_state(trunk: TensorDictSequential, num_envs: int) -> TensorDict:
    """Zeros, float32 [num_envs, 1, num_features] for both parts of the state of a `recurrent` trunk."""
    lstm = trunk[-1].lstm
    zeros = torch.zeros(num_envs, lstm.num_layers, lstm.hidden_size, device=lstm.weight_hh_l0.device)
    return TensorDict({key: zeros.clone() for key in STATE_KEYS}, batch_size=[num_envs])


def linear(in_key: str, num_features: int, out_key: str, num_outputs: int) -> TensorDictModule:
    """One linear layer from ``in_key`` to ``out_key``."""
    return TensorDictModule(nn.Linear(num_features, num_outputs), in_keys=[in_key], out_keys=[out_key])


def actor(in_key: str, num_features: int, action_spec: TensorSpec) -> ProbabilisticActor:
    """A categorical policy that reads features and writes ``action`` and ``action_log_prob``."""
    return ProbabilisticActor(
        linear(in_key, num_features, "logits", action_spec.space.n),
        spec=action_spec,
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )


def critic(in_key: str, num_features: int) -> ValueOperator:
    """A value of features, ``state_value``."""
    return ValueOperator(nn.Linear(num_features, 1), in_keys=[in_key])
