"""The weights of an agent's network as one vector."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn

from ctgraph_rl.checks import require


class Weights:
    """The parameters that an agent learns, P numbers in all.

    Args:
        policy: the acting module, which has all of the parameters.
        parameters: those by which the agent's losses are differentiated.

    Raises:
        ValueError: if the policy lacks a parameter.
    """

    def __init__(self, policy: TensorDictModuleBase, parameters: Sequence[nn.Parameter]) -> None:
        self.sizes = [parameter.numel() for parameter in parameters]
        names = {id(parameter): name for name, parameter in policy.named_parameters()}
        within = {id(parameter) for parameter in parameters} <= names.keys()
        require((within, "the weights of an agent must all be parameters of its policy"))
        self.names = [names[id(parameter)] for parameter in parameters]
        self.parameters = list(parameters)
        self.head_names = head_names(policy)

    def __len__(self) -> int:
        return sum(self.sizes)

    @property
    def named(self) -> list[tuple[str, nn.Parameter]]:
        """Name and parameter of each."""
        return list(zip(self.names, self.parameters, strict=True))

    @property
    def device(self) -> torch.device:
        """The parameters' device."""
        return self.parameters[0].device

    def zeros(self, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return zeros, [P], on the CPU."""
        return torch.zeros(len(self), dtype=dtype, device="cpu")

    def vector(self) -> Tensor:
        """Return all values, float32 [P]; gradients flow back to the parameters."""
        return flat(self.parameters)

    def write(self, vector: Tensor) -> None:
        """Set the parameters to a vector, [P]."""
        write_flat(vector, self.parameters)

    def split(self, vector: Tensor) -> Sequence[Tensor]:
        """Split a vector [..., P] into the parts of each parameter."""
        return vector.split(self.sizes, dim=-1)

    def mask_of(self, names: Collection[str]) -> Tensor:
        """Return where the parameters with these names are, bool [P]."""
        return flat([torch.full_like(value, name in names, dtype=torch.bool) for name, value in self.named])

    @property
    def in_heads(self) -> Tensor:
        """Where the output layers are, bool [P]."""
        return self.mask_of(self.head_names)

    @property
    def in_head_parameters(self) -> list[nn.Parameter]:
        """The parameters of the output layers."""
        return [parameter for name, parameter in self.named if name in self.head_names]

    @property
    def in_matrices(self) -> Tensor:
        """Where weight matrices are, not biases, bool [P]."""
        return self.mask_of([name for name, value in self.named if value.ndim > 1])

    def write_to(self, policy: TensorDictModuleBase, vector: Tensor) -> None:
        """Set the weights of a copy of the policy to a vector, [P]."""
        parameters = dict(policy.named_parameters())
        write_flat(vector, [parameters[name] for name in self.names])


def require_drawn(policy: nn.Module, name: str) -> None:
    """Require layers whose weights can be drawn again, for a method of this name."""
    fixed = []
    for path, layer in policy.named_modules():
        if list(layer.parameters(recurse=False)) and not hasattr(layer, "reset_parameters"):
            fixed.append(path or type(layer).__name__)
    require((not fixed, f"{name} draws weights again by reset_parameters, which {', '.join(fixed)} lack: add it"))


def flat(tensors: Sequence[Tensor]) -> Tensor:
    """Concatenate tensors to one vector."""
    return torch.cat([tensor.flatten() for tensor in tensors])


@torch.no_grad()
def write_flat(vector: Tensor, tensors: Sequence[Tensor]) -> None:
    """Set tensors to the values of a vector made by `flat`."""
    for tensor, part in zip(tensors, vector.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(part.view_as(tensor))


def head_names(policy: TensorDictModuleBase, without: str | None = None) -> list[str]:
    """Return the names of the parameters of a policy's output layers, the last linear layers behind the trunk.

    Args:
        without: a key; leave out the modules that write it.
    """
    names = []
    for place, module in policy.named_modules():
        behind = isinstance(module, TensorDictModule) and isinstance(module.module, nn.Module)
        if behind and "observation" not in module.in_keys and without not in module.out_keys:
            layers = [name for name, layer in module.named_modules(prefix=place) if isinstance(layer, nn.Linear)]
            if layers:
                names += [f"{layers[-1]}.weight", f"{layers[-1]}.bias"]
    return names
