"""Network parts that agents share: encoder, memory, heads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.nn.utils.rnn import PackedSequence
from torchrl.data import Composite, TensorSpec
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import LSTMModule, ProbabilisticActor, ValueOperator

from ctgraph_rl.checks import require_memory

Data = Mapping[Any, Tensor]
"""Tensors by key, in a dictionary or a TensorDict."""

STATE_KEYS = ("recurrent_state_h", "recurrent_state_c")
"""The keys of a recurrent policy's state."""


class Encoder(nn.Module):
    """uint8 observations to features: scale to [0, 1], flatten, linear layers with ReLU.

    Args:
        shape: shape of one observation.
        high: largest value of an observation.
        num_features: width of every layer.
        num_layers: linear layers, at least 1.
        num_extra: width of further inputs, such as a one-hot task id.
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
        """Map uint8 [..., *shape] and further inputs, [..., n] each, to [..., num_features] of the weights' dtype."""
        dtype = self.linear.weight.dtype
        flat = observation.flatten(-self.event_dims).to(dtype) * self.scale
        flat = torch.cat([flat, *(values.to(dtype) for values in extra)], dim=-1) if extra else flat
        return self.further(self.linear(flat).relu())


class EncoderModule(TensorDictModule):
    """A trunk without memory: an `Encoder` and the keys that it reads; writes ``features``."""

    def act(self, data: Data) -> dict[Any, Tensor]:
        """Compute ``features`` for one step of all rows."""
        return {"features": self.over_time(data)}

    def over_time(self, data: Data) -> Tensor:
        """Compute the features of any number of steps."""
        return self.module(*(data[key] for key in self.in_keys))


class RecurrentModule(TensorDictSequential):
    """An encoder with an `LSTMModule` behind it; writes ``memory``, and its state under `STATE_KEYS`.

    `act` and `over_time` are TorchRL's sequential and recurrent mode in plain tensors.
    """

    def act(self, data: Data) -> dict[Any, Tensor]:
        """Compute ``memory`` and the next state for one step of all rows."""
        encoder, lstm = self.module[0], self.module[1].lstm
        fresh = data["is_init"].unsqueeze(-1)
        state = (torch.where(fresh, 0.0, data[key]).transpose(0, 1).contiguous() for key in STATE_KEYS)
        memory, state = lstm(encoder.over_time(data).unsqueeze(1), tuple(state))
        following = {("next", key): value.transpose(0, 1) for key, value in zip(STATE_KEYS, state, strict=True)}
        return {"memory": memory.squeeze(1), **following}

    def over_time(self, data: Data) -> Tensor:
        """Compute ``memory`` at all steps of [rows, steps], from the stored initial state; reset at ``is_init``.

        Each segment between two resets is a sequence of its own, and the LSTM runs over all of them at once. Features
        are computed once for frames with the same inputs.
        """
        encoder, lstm = self.module[0], self.module[1].lstm
        inputs = [data[key].flatten(0, 1) for key in encoder.in_keys]
        examples, groups = distinct(inputs)
        features = encoder.module(*(value.index_select(0, examples) for value in inputs))
        starts = data["is_init"].squeeze(-1).clone()
        if not starts[:, 1:].any():
            state = (data[key][:, 0].transpose(0, 1).contiguous() for key in STATE_KEYS)
            return lstm(features.index_select(0, groups).unflatten(0, starts.shape), tuple(state))[0]
        starts[:, 0] = True
        first = starts.flatten().nonzero().squeeze(-1)
        lengths, order = first.diff(append=first.new_tensor([starts.numel()])).sort(descending=True)
        first, time = first[order], torch.arange(int(lengths[0]), device=first.device).unsqueeze(-1)
        within = time < lengths
        places = (first + time)[within]
        state = (data[key].flatten(0, 1)[first].transpose(0, 1).contiguous() for key in STATE_KEYS)
        memory = packed_lstm(lstm, features, groups[places], within.sum(dim=1).cpu(), *state)
        back = torch.empty_like(places).scatter_(0, places, torch.arange(len(places), device=places.device))
        return memory.index_select(0, back).unflatten(0, starts.shape)


def distinct(inputs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Group frames with the same inputs: in a task without noise, thousands show a few images.

    Args:
        inputs: tensors, [num_frames, ...] each.

    Returns:
        One frame of each group, int64 [num_groups], and the group of each frame, int64 [num_frames].
    """
    flat = [value.flatten(1) for value in inputs]
    frames = torch.arange(len(flat[0]), device=flat[0].device)
    if not frames.is_cpu:  # a GPU would have to wait for the search
        return frames, frames
    widths = [value.shape[1] for value in flat]
    weights = torch.randn(sum(widths), generator=torch.Generator().manual_seed(0)).split(widths)
    sums = torch.stack([value.float() @ part for value, part in zip(flat, weights, strict=True)]).sum(dim=0)
    different, groups = sums.unique(return_inverse=True)
    examples = frames.new_empty(len(different)).scatter_(0, groups, frames)
    same = examples[groups]
    differ = any((value != value.index_select(0, same)).any() for value in flat)  # despite equal sums
    return (frames, frames) if differ else (examples, groups)


def packed_lstm(lstm: nn.LSTM, features: Tensor, groups: Tensor, sizes: Tensor, h: Tensor, c: Tensor) -> Tensor:
    """Run an LSTM of one layer over packed sequences, with one product of features and weights for each group.

    PyTorch's own backward pass writes a tensor of all frames at each step.

    Args:
        lstm: the LSTM.
        features: of each group, [num_groups, num_features].
        groups: of each frame in packed order, int64 [num_frames].
        sizes: number of sequences at each step, int64 [num_steps] on the CPU.
        h: the initial hidden states of the sequences, [1, num_sequences, hidden_size].
        c: the initial cell states likewise.

    Returns:
        The hidden states at all frames in packed order, [num_frames, hidden_size].
    """
    if features.is_cuda:
        return lstm(PackedSequence(features.index_select(0, groups), sizes), (h, c))[0].data
    of_features, of_h, bias, other_bias = lstm.all_weights[0]
    given = nn.functional.linear(features, of_features, bias + other_bias)
    h, c, memory = h[0], c[0], []
    for step in given.index_select(0, groups).split(sizes.tolist()):
        left = len(step)
        i, f, g, o = torch.addmm(step, h[:left], of_h.t()).chunk(4, dim=1)
        c = torch.addcmul(f.sigmoid() * c[:left], i.sigmoid(), g.tanh())
        h = o.sigmoid() * c.tanh()
        memory.append(h)
    return torch.cat(memory)


def require_weights(
    observation_spec: Composite, hidden_size: int, num_layers: int = 1, num_outputs: int = 1, memory: bool = False
) -> None:
    """Refuse networks whose weights, gradients and moments of Adam the machine cannot hold.

    Raises:
        ValueError: names the layers and the bytes.
    """
    num_inputs = observation_spec["observation"].shape.numel()
    squares = num_layers - 1 + (8 if memory else 0)
    count = hidden_size * (num_inputs + squares * hidden_size + num_outputs)
    require_memory(f"weights of hidden_size={hidden_size} in num_layers={num_layers}", 16 * count, "or smaller layers")


def encoder(observation_spec: Composite, num_features: int, num_layers: int = 1, **extra: int) -> EncoderModule:
    """Build an encoder that reads ``observation`` and, if the environment has it, ``task_id``; it writes ``features``.

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
    return EncoderModule(module, in_keys=["observation", *extra], out_keys=["features"])


def recurrent(observation_spec: Composite, num_features: int, num_layers: int, **extra: int) -> RecurrentModule:
    """Build an `encoder` with an LSTM of the same width; it writes ``memory``, and its state under `STATE_KEYS`."""
    lstm = LSTMModule(num_features, num_features, in_key="features", out_key="memory")
    return RecurrentModule(encoder(observation_spec, num_features, num_layers, **extra), lstm)


def zero_state(trunk: TensorDictSequential, num_envs: int) -> TensorDict:
    """Return zeros, float32 [num_envs, 1, num_features], for both parts of the state of a `recurrent` trunk."""
    lstm = trunk[-1].lstm
    zeros = torch.zeros(num_envs, lstm.num_layers, lstm.hidden_size, device=lstm.weight_hh_l0.device)
    return TensorDict({key: zeros.clone() for key in STATE_KEYS}, batch_size=[num_envs])


def linear(in_key: str, num_features: int, out_key: str, num_outputs: int) -> TensorDictModule:
    """Build a linear layer from ``in_key`` to ``out_key``."""
    return TensorDictModule(nn.Linear(num_features, num_outputs), in_keys=[in_key], out_keys=[out_key])


def make_orthogonal(module: nn.Module, gain: float = 1.0) -> None:
    """Initialise all linear layers with orthogonal weights times a gain, and biases of 0."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)


def actor(in_key: str, num_features: int, action_spec: TensorSpec) -> ProbabilisticActor:
    """Build a categorical policy that reads features and writes ``action`` and ``action_log_prob``."""
    return ProbabilisticActor(
        linear(in_key, num_features, "logits", action_spec.space.n),
        spec=action_spec,
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )


def critic(in_key: str, num_features: int) -> ValueOperator:
    """Build a linear critic of features, which writes ``state_value``."""
    return ValueOperator(nn.Linear(num_features, 1), in_keys=[in_key])


class ActorCritic(TensorDictSequential):
    """A policy of a trunk, an `actor` and a `critic`; computes what TorchRL's modules do, in plain tensors.

    Further modules are called as they are.
    """

    def forward(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        """Write ``action``, ``action_log_prob``, ``state_value`` and the trunk's next state."""
        trunk, actor, critic, *others = self.module
        written = trunk.act(tensordict)
        features = written.pop(actor.in_keys[0])
        log_probs = log_probabilities(actor, features)
        chances = log_probs.softmax(dim=-1)
        if exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE):
            action = chances.argmax(dim=-1)
        else:
            action = chances.flatten(0, -2).multinomial(1, replacement=True).view(chances.shape[:-1])
        written["action"] = action
        written["action_log_prob"] = log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1)
        written["state_value"] = critic.module(features)
        for key, value in written.items():
            tensordict.set(key, value)
        for module in others:
            module(tensordict)
        return tensordict


def log_probabilities(actor: ProbabilisticActor, features: Tensor) -> Tensor:
    """Compute the logarithms of an `actor`'s probabilities, [..., num_actions]."""
    logits = actor.module[0].module(features)
    return logits - logits.logsumexp(dim=-1, keepdim=True)


def entropy(log_probs: Tensor) -> Tensor:
    """Compute the entropy of categorical distributions, [...]."""
    least = torch.finfo(log_probs.dtype).min  # so that a probability of 0 counts as 0
    return -(log_probs.clamp(min=least) * log_probs.softmax(dim=-1)).sum(dim=-1)
