"""Network parts that agents share."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Composite


class Encoder(nn.Module):
    """uint8 observations to features: scale to [0, 1], flatten, one linear layer, ReLU.

    Args:
        shape: shape of one observation.
        high: largest value of an observation.
        num_features: width of the output.
    """

    def __init__(self, shape: torch.Size, high: float, num_features: int) -> None:
        super().__init__()
        self.event_dims, self.scale = len(shape), 1 / high
        self.linear = nn.Linear(shape.numel(), num_features)

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., *shape] to float32 [..., num_features]."""
        flat = observation.flatten(-self.event_dims)
        return self.linear(flat.float() * self.scale).relu()


def encoder(observation_spec: Composite, num_features: int) -> TensorDictModule:
    """An `Encoder` that reads ``observation`` and writes ``features``.

    Args:
        observation_spec: the environment's, without batch dimensions.
        num_features: width of the features.
    """
    spec = observation_spec["observation"]
    module = Encoder(spec.shape, spec.space.high.max().item(), num_features)
    return TensorDictModule(module, in_keys=["observation"], out_keys=["features"])
