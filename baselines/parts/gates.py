"""A network whose layers may be modulated by gates (Ben-Iwhiwhu et al. 2022, Neural Networks, arXiv 2111.00134).

A layer is y = relu((W x + b) g) with the gate g = tanh(s), s = W_o relu(W_n x + b_n) + b_o; ``hard`` takes the sign of
s, 1 at 0, and ``none`` no gate. A hard gate has no gradient: it stays random, as in the paper's code.
``hard_straight_through`` has the values of ``hard`` and the gradient of s.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from baselines.cells.cell import linear_layer
from baselines.parts.networks import IdLinear, highest, require_weights
from ctgraph_rl.batch.specs import TASK_NUMBER
from ctgraph_rl.checks import require_memory

GATES = ("none", "soft", "hard", "hard_straight_through")


class GatedLayer(nn.Module):
    """A linear layer with ReLU, and its gate.

    Args:
        num_ids: of task ids among the inputs, as ``num_extra`` in `IdLinear`.
        gate: one of `GATES`.
        gate_size: width of W_n x.
    """

    def __init__(
        self, num_inputs: int, num_outputs: int, gate: str, gate_size: int, num_ids: int = 0, num_extra: int = 0
    ) -> None:
        super().__init__()
        self.gate = gate
        self.linear = IdLinear(num_inputs, num_ids, num_extra, num_outputs)
        self.modulator = nn.Sequential()
        if gate != "none":
            first = IdLinear(num_inputs, num_ids, num_extra, gate_size)
            self.modulator.extend([first, nn.ReLU(), linear_layer(gate_size, num_outputs)])

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map what `IdLinear` reads to [..., num_outputs]."""
        outputs = self.linear(*inputs)
        return outputs.relu() if self.gate == "none" else (outputs * self.gates(*inputs)).relu()

    def gates(self, *inputs: Tensor) -> Tensor:
        """Return g, [..., num_outputs]."""
        first, relu, last = self.modulator
        drive = last(relu(first(*inputs)))
        if self.gate == "soft":
            return drive.tanh()
        sign = torch.where(drive >= 0, 1.0, -1.0).to(drive.dtype)
        return sign + 0 * drive if self.gate == "hard" else sign + drive - drive.detach()


class GatedNetwork(nn.Module):
    """Layers from observations to logits; weights as in Glorot & Bengio 2010, biases 0.

    Args:
        specs: of what it sees, from `shown_specs`.
        num_extra: width of further inputs.
        hidden_size: width of each layer.
        num_layers: layers before the output, which has no gate.
        gate: one of `GATES`.
        gate_size: as in `GatedLayer`.
    """

    def __init__(
        self,
        specs: dict[str, TensorSpec],
        num_extra: int,
        num_outputs: int,
        *,
        hidden_size: int,
        num_layers: int,
        gate: str,
        gate_size: int,
    ) -> None:
        super().__init__()
        observation = specs["observation"]
        self.event_dims = len(observation.shape)
        self.scale = 1 / highest(observation)
        num_ids = 0
        if TASK_NUMBER in specs:
            num_ids = int(specs[TASK_NUMBER].space.high) + 1
        elif "task_id" in specs:
            num_extra += specs["task_id"].shape.numel()
        first = GatedLayer(
            observation.shape.numel(), hidden_size, gate, gate_size, num_ids=num_ids, num_extra=num_extra
        )
        self.layers = nn.ModuleList([first])
        for _ in range(num_layers - 1):
            self.layers.append(GatedLayer(hidden_size, hidden_size, gate, gate_size))
        self.output = linear_layer(hidden_size, num_outputs)
        for name, parameter in self.named_parameters():
            if name.endswith("weight"):
                nn.init.xavier_uniform_(parameter)
            else:
                nn.init.zeros_(parameter)

    def forward(self, observation: Tensor, *extra: Tensor) -> Tensor:
        """Map observations [..., *shape], and what `IdLinear` reads beside them, to [..., num_outputs]."""
        hidden = self.flat(observation)
        for layer in self.layers:
            hidden = layer(hidden, *extra)
            extra = ()
        return self.output(hidden)

    def flat(self, observation: Tensor) -> Tensor:
        """Return observations as vectors in [0, 1]."""
        return observation.flatten(-self.event_dims).to(self.output.weight.dtype) * self.scale


def shown_specs(observation_spec: Composite) -> dict[str, TensorSpec]:
    """Return the specs of what a network sees: the observation and the task's id, as a number where there is one."""
    found = {"observation": observation_spec["observation"]}
    for key in (TASK_NUMBER, "task_id"):
        if len(found) == 1 and key in observation_spec.keys():  # noqa: SIM118, no dict
            found[key] = observation_spec[key]
    return found


def require_gated_weights(
    observation_spec: Composite, hidden_size: int, num_layers: int, *, num_context: int, gate_size: int
) -> None:
    """Refuse networks whose weights, gradients and moments of Adam exceed the memory.

    Raises:
        ValueError: names the layers and the bytes.
    """
    require_weights(observation_spec, hidden_size, num_layers)
    parts = f"weights of num_context={num_context} and gate_size={gate_size}"
    require_memory(parts, 16 * hidden_size * (num_context + 2 * num_layers * gate_size), "or smaller ones")
