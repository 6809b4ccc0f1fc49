"""Network parts that agents share: encoder, memory, heads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torchrl.data import Composite, TensorSpec
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import ProbabilisticActor, ValueOperator, recurrent_mode

from baselines.cells.cell import REWARD, Cell, CellState, MakeCell, Units, linear_layer, reset
from ctgraph_rl.batch.specs import TASK_NUMBER
from ctgraph_rl.checks import one_of, require, require_memory
from ctgraph_rl.learn import histories
from ctgraph_rl.learn.collect import PREVIOUS_ACTION, UNSTORED
from ctgraph_rl.learn.guide import GUIDED_ACTION
from ctgraph_rl.learn.histories import can_branch, distinct, renumber

Data = Mapping[Any, Tensor]
"""Tensors by key, in a dictionary or a TensorDict."""

Items = dict[Any, Tensor]
"""Tensors by key, whose first dimension is a batch's."""

TensorsByName = dict[str, Tensor]
"""Such as losses, outputs and weights."""

INPUT = "input_number"
"""Key of frames' numbers, int64, the same for the same inputs."""

FEWEST_ROWS = 128

MOST_ROWS = 0.25
"""Share of different histories up to which acting computes each once."""

HISTORY = "history_number"
"""Key of frames' numbers, int64, the same for the same history; without memory, for the same inputs."""


ENCODERS = ("mlp", "cnn")
TILE = 4
NUM_CHANNELS = 16


class Convolutions(nn.Module):
    """Two convolutions with ReLU: of 4 x 4 pixels at a stride of 4, then of 3 x 3 with zeros around.

    Each is a linear layer over patches, so methods and stacks treat it as one.

    Args:
        shape: channels, rows and columns of an image; rows and columns are multiples of 4.
    """

    def __init__(self, shape: torch.Size) -> None:
        super().__init__()
        whole = len(shape) == 3 and all(side % TILE == 0 for side in shape[1:])
        rule = f"encoder must be mlp for observations of shape {tuple(shape)}"
        require((whole, f"{rule}: cnn reads images whose sides are multiples of {TILE} pixels"))
        self.shape = shape
        self.first = linear_layer(shape[0] * TILE**2, NUM_CHANNELS)
        self.second = linear_layer(9 * NUM_CHANNELS, NUM_CHANNELS)
        self.first_relu = nn.ReLU()
        self.second_relu = nn.ReLU()
        self.num_features = NUM_CHANNELS * shape[1:].numel() // TILE**2

    def forward(self, flat: Tensor) -> Tensor:
        """Map flat images, [..., pixels], to [..., num_features]."""
        channels, rows, columns = self.shape
        tiled = flat.unflatten(-1, (channels, rows // TILE, TILE, columns // TILE, TILE))
        tiles = tiled.movedim((-4, -2), (-5, -4)).flatten(-3)
        found = nn.functional.pad(self.first_relu(self.first(tiles)), (0, 0, 1, 1, 1, 1))
        patches = []
        for i in range(3):
            for j in range(3):
                patches.append(found[..., i : i + rows // TILE, j : j + columns // TILE, :])
        return self.second_relu(self.second(torch.cat(patches, dim=-1))).flatten(-3)


class IdLinear(nn.Linear):
    """A linear layer whose inputs may hold a task's id, which it reads as a number by gathering a column.

    Args:
        num_inputs: width of the inputs before the id.
        num_ids: number of task ids, of which a number is read as a one-hot vector would be; 0: none is read.
        num_extra: width of the inputs behind the id.
    """

    def __init__(self, num_inputs: int, num_ids: int, num_extra: int, num_outputs: int) -> None:
        super().__init__(num_inputs + num_ids + num_extra, num_outputs, dtype=torch.float32, device="cpu")
        self.num_inputs = num_inputs
        self.num_ids = num_ids
        self.live_ids: Tensor | None = None  # those whose columns the weight has, see `baselines.parts.live_ids`

    def forward(self, inputs: Tensor, *extra: Tensor) -> Tensor:
        """Map inputs, a task's number where ids are read, and further inputs.

        Args:
            inputs: [..., num_inputs] of the weights' dtype.
            extra: int64 [..., 1], -1 for none, where ids are read; and further inputs, [..., n] each.
        """
        others = [values.to(self.weight.dtype) for values in extra[bool(self.num_ids) :]]
        inputs = joined(inputs, *others)
        if not self.num_ids:
            return super().forward(inputs)
        num_columns = self.num_ids if self.live_ids is None else len(self.live_ids)
        of_inputs, of_ids, of_others = self.weight.tensor_split([self.num_inputs, self.num_inputs + num_columns], dim=1)
        weight = torch.cat([of_inputs, of_others], dim=1) if others else of_inputs
        number = extra[0].squeeze(-1)
        column = number.clamp(min=0).flatten()
        if self.live_ids is not None:
            column = torch.searchsorted(self.live_ids, column)
        of_number = of_ids.t().index_select(0, column).view(*number.shape, -1)
        return nn.functional.linear(inputs, weight, self.bias) + of_number * (extra[0] >= 0)


class Encoder(nn.Module):
    """Observations to features: scale uint8 to [0, 1], flatten, linear layers with ReLU.

    Args:
        shape: shape of one observation.
        high: largest value of an observation.
        num_features: width of every layer.
        num_ids: number of task ids, as in `IdLinear`.
        kind: ``mlp``, or ``cnn`` with `Convolutions` before the linear layers.
    """

    def __init__(
        self,
        shape: torch.Size,
        high: float,
        num_features: int,
        num_layers: int = 1,
        num_extra: int = 0,
        num_ids: int = 0,
        kind: str = "mlp",
    ) -> None:
        super().__init__()
        require(*one_of(ENCODERS, encoder=kind))
        self.event_dims = len(shape)
        self.scale = 1 / high
        self.convolutions = Convolutions(shape) if kind == "cnn" else None
        num_inputs = shape.numel() if self.convolutions is None else self.convolutions.num_features
        self.linear = IdLinear(num_inputs, num_ids, num_extra, num_features)
        self.relu = nn.ReLU()
        self.further = nn.Sequential()
        for _ in range(num_layers - 1):
            self.further.extend([linear_layer(num_features, num_features), nn.ReLU()])

    def hidden_layers(self) -> list[Units]:
        """Return its layers; the units of a convolution are its channels."""
        found = []
        if self.convolutions is not None:
            found.append(Units("convolution.1", self.convolutions.first, self.convolutions.first_relu))
            found.append(Units("convolution.2", self.convolutions.second, self.convolutions.second_relu))
        found.append(Units("encoder.1", self.linear, self.relu))
        for number, layer in enumerate(self.further):
            if isinstance(layer, nn.Linear):
                found.append(Units(f"encoder.{number // 2 + 2}", layer, self.further[number + 1]))
        return found

    def forward(self, observation: Tensor, *extra: Tensor) -> Tensor:
        """Map uint8 [..., *shape], a task's number where ids are read, and further inputs to features.

        Args:
            observation: uint8 [..., *shape].
            extra: int64 [..., 1], -1 for none, where ids are read; and further inputs, [..., n] each.

        Returns:
            [..., num_features] of the weights' dtype.
        """
        dtype = self.linear.weight.dtype
        inputs = observation.flatten(-self.event_dims).to(dtype) * self.scale
        if self.convolutions is not None:
            inputs = self.convolutions(inputs)
        return self.further(self.relu(self.linear(inputs, *extra)))


class EncoderModule(TensorDictModule):
    """A trunk without memory: an `Encoder` and its keys; writes ``features``."""

    def act(self, data: Data) -> Items:
        """Return ``features`` for one step of all rows."""
        return {"features": self.over_time(data)}

    def over_time(self, data: Data) -> Tensor:
        """Return the features of any number of steps."""
        return self.module(*(data[key] for key in self.in_keys))

    def number_histories(self, data: Data) -> Items:
        """Number the inputs of frames from 0, int64 [rows, steps]."""
        inputs = [data[key] for key in self.in_keys]
        _, groups = distinct([value.flatten(0, 1) for value in inputs])
        return {HISTORY: groups.view(inputs[0].shape[:2])}

    def of_histories(self, data: Data) -> tuple[Tensor, Tensor]:
        """Return features of different frames, [n, num_features], and the number of each, int64 [num_frames]."""
        examples, groups = renumber(data[HISTORY])
        features = self.module(*(data[key].index_select(0, examples) for key in self.in_keys))
        return features, groups


class RecurrentModule(TensorDictModuleBase):
    """An encoder and a cell; writes ``memory``, and the cell's state under the cell's keys.

    `act` is one step of all rows, `over_time` all steps of sequences.
    """

    def __init__(self, encoder: EncoderModule, cell: Cell) -> None:
        super().__init__()
        self.module = nn.ModuleList([encoder, cell])
        self.state_keys = cell.state_keys
        self.own_keys = cell.own_keys
        self.in_keys = [*encoder.in_keys, *self.state_keys, "is_init", *self.own_keys]
        self.out_keys = ["memory", *(("next", key) for key in self.state_keys)]

    @property
    def encoder(self) -> EncoderModule:
        """What writes the features."""
        return cast(EncoderModule, self.module[0])

    @property
    def cell(self) -> Cell:
        """What remembers."""
        return cast(Cell, self.module[1])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``memory`` and the next state of a step; in TorchRL's ``recurrent_mode``, ``memory`` of sequences."""
        written = {"memory": self.over_time(tensordict)} if recurrent_mode() else self.act(tensordict)
        return tensordict.update(written)

    def act(self, data: Data) -> Items:
        """Return ``memory`` and the next state for one step, computed once for rows with the same history."""
        seen = [data[key] for key in self.encoder.in_keys]
        own = self._own(data)
        state = reset([data[key] for key in self.state_keys], data["is_init"].squeeze(-1))
        num_rows = len(seen[0])
        if num_rows >= FEWEST_ROWS and self.cell.merges_rows:
            examples, groups = distinct([*seen, *own, *state], most=MOST_ROWS)
            if len(examples) < num_rows:
                seen = [value.index_select(0, examples) for value in seen]
                own = [value.index_select(0, examples) for value in own]
                state = tuple(value.index_select(0, examples) for value in state)
        memory, state = self.cell.step(joined(self.encoder.module(*seen), *own), state)
        written: Items = {"memory": memory}
        for key, value in zip(self.state_keys, state, strict=True):
            written["next", key] = value
        if len(memory) < num_rows:
            written = {key: value.index_select(0, groups) for key, value in written.items()}
        return written

    def over_time(self, data: Data) -> Tensor:
        """Return ``memory`` at all steps of [rows, steps], from the state at the first; reset at ``is_init``."""
        inputs, groups, starts, state = self._sequences(data)
        cell = self.cell
        faster = cell.sequence if can_branch(starts) else partial(Cell.sequence, cell)
        return faster(inputs, groups, starts, state)

    def of_histories(self, data: Data) -> tuple[Tensor, Tensor]:
        """Return ``memory`` of different histories, [n, num_outputs], and each frame's number, [rows * steps]."""
        inputs, groups, starts, state = self._sequences(data)
        found = histories.tree(data[HISTORY], starts)
        of_last = groups.flatten().index_select(0, found.frames)
        return self.cell.over_tree(found, inputs, of_last, found.initial(starts, state)), found.of_frames

    def number_histories(self, data: Data) -> Items:
        """Number the inputs and the histories of frames from 0; int64 [rows, steps] each."""
        starts = data["is_init"].squeeze(-1)
        inputs = self.input_groups(data).view_as(starts)
        state = [data[key][:, 0] for key in self.state_keys]
        return {INPUT: inputs, HISTORY: histories.number_histories(inputs, starts, state)}

    def input_groups(self, data: Data) -> Tensor:
        """Return the number of each frame's inputs, of which the encoder reads different ones once, [rows * steps]."""
        return self._read(data)[3]

    def _read(self, data: Data) -> tuple[list[Tensor], list[Tensor], Tensor, Tensor]:
        seen = [data[key].flatten(0, 1) for key in self.encoder.in_keys]
        own = [value.flatten(0, 1) for value in self._own(data)]
        examples, groups = renumber(data[INPUT].flatten()) if INPUT in data else distinct([*seen, *own])
        return seen, own, examples, groups

    def _sequences(self, data: Data) -> tuple[Tensor, Tensor, Tensor, CellState]:
        starts = data["is_init"].squeeze(-1)
        seen, own, examples, groups = self._read(data)
        features = self.encoder.module(*(value.index_select(0, examples) for value in seen))
        inputs = joined(features, *(value.index_select(0, examples) for value in own))
        state = reset([data[key][:, 0] for key in self.state_keys], starts[:, 0])
        return inputs, groups.view_as(starts), starts, state

    def zero_state(self, num_envs: int) -> TensorDict:
        """Return the state before the first step: zeros, without last action or reward."""
        state = dict(zip(self.state_keys, self.cell.zeros(num_envs), strict=True))
        device = next(self.parameters()).device
        zeros = {
            PREVIOUS_ACTION: torch.zeros(num_envs, dtype=torch.int64, device=device),
            REWARD: torch.zeros(num_envs, 1, device=device, dtype=torch.float32),
        }
        return TensorDict(state | {key: zeros[key] for key in self.own_keys}, batch_size=[num_envs])

    def _own(self, data: Data) -> list[Tensor]:
        found = []
        for key in self.own_keys:
            value = one_hot(data[key], self.cell.num_actions).float() if key == PREVIOUS_ACTION else data[key]
            found.append(value * ~data["is_init"])
        return found


def trunk_of(policy: object) -> Any:
    """Return a policy's part before its output layers, with ``over_time`` and ``in_keys``, or None."""
    parts = policy.modules() if isinstance(policy, nn.Module) else ()
    return next((part for part in parts if hasattr(part, "over_time")), None)


def joined(features: Tensor, *others: Tensor) -> Tensor:
    """Concatenate features with further inputs, [..., n] each."""
    return torch.cat([features, *others], dim=-1) if others else features


def sequences_of(batch: Data, keys: Sequence[str], states: Sequence[str] = ()) -> TensorsByName:
    """Return inputs of a batch, [rows, steps, ...] each; only the first step's of ``states`` and unstored keys."""
    return {key: batch[key][:, :1] if key.startswith(UNSTORED) or key in states else batch[key] for key in keys}


def require_weights(
    observation_spec: Composite, hidden_size: int, num_layers: int = 1, num_outputs: int = 1, memory: bool = False
) -> None:
    """Refuse networks whose weights, gradients and moments of Adam exceed the memory.

    Raises:
        ValueError: names the layers and the bytes.
    """
    num_inputs = observation_spec["observation"].shape.numel()
    if "task_id" in observation_spec.keys():  # noqa: SIM118, no dict
        num_inputs += observation_spec["task_id"].shape.numel()
    squares = num_layers - 1 + (8 if memory else 0)
    count = hidden_size * (num_inputs + squares * hidden_size + num_outputs)
    require_memory(f"weights of hidden_size={hidden_size} in num_layers={num_layers}", 16 * count, "or smaller layers")


def num_actions_of(action_spec: TensorSpec) -> int:
    """Return the number of actions.

    Raises:
        ValueError: for continuous actions.
    """
    count = getattr(action_spec, "n", None)
    shape = list(action_spec.shape)
    dtype = str(action_spec.dtype).removeprefix("torch.")
    fix = "take a learner of your own, measured by Recorder, or the wrapper gymnasium.wrappers:DiscretizeAction"
    require((count is not None, f"agents of baselines choose from discrete actions, these are {dtype} {shape}: {fix}"))
    return count  # type: ignore[return-value]


def highest(spec: TensorSpec) -> float:
    """Return the divisor of observations: their largest value, or 1 for vectors of floats."""
    return 1.0 if spec.dtype.is_floating_point else spec.space.high.max().item()


def encoder(
    observation_spec: Composite, num_features: int, num_layers: int = 1, kind: str = "mlp", **extra: int
) -> EncoderModule:
    """Build an encoder that reads ``observation`` and the task's id, if the environment shows it; writes ``features``.

    Args:
        observation_spec: the environment's, without batch dimensions.
        kind: ``mlp`` or ``cnn``.
        extra: further keys to read, with their widths.
    """
    spec = observation_spec["observation"]
    shown = observation_spec.keys()
    length = observation_spec["task_id"].shape.numel() if "task_id" in shown else 0
    reads_number = TASK_NUMBER in shown
    if length and not reads_number:
        extra = {"task_id": length, **extra}
    module = Encoder(
        spec.shape,
        highest(spec),
        num_features,
        num_layers,
        num_extra=sum(extra.values()),
        num_ids=length if reads_number else 0,
        kind=kind,
    )
    return EncoderModule(module, in_keys=["observation", *[TASK_NUMBER] * reads_number, *extra], out_keys=["features"])


def recurrent(
    observation_spec: Composite,
    num_features: int,
    num_layers: int,
    num_actions: int,
    make_cell: MakeCell,
    kind: str = "mlp",
    **extra: int,
) -> RecurrentModule:
    """Build an `encoder` with a cell of the same width; it writes ``memory`` and the cell's state."""
    cell = make_cell(num_features, num_features, num_actions)  # first, as the order decides the weights of a seed
    return RecurrentModule(encoder(observation_spec, num_features, num_layers, kind=kind, **extra), cell)


def make_orthogonal(trunk: nn.Module, *heads: nn.Module) -> None:
    """Initialise linear layers with orthogonal weights, a thousand times smaller in heads, and biases of 0.

    As in the code of Ben-Iwhiwhu et al. 2023.
    """
    for part in (trunk, *heads):
        for layer in part.modules():
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, gain=1.0 if part is trunk else 0.001)
                nn.init.zeros_(layer.bias)


def actor(in_key: str, num_features: int, action_spec: TensorSpec) -> ProbabilisticActor:
    """Build a categorical policy of features; writes ``action`` and ``action_log_prob``."""
    return ProbabilisticActor(
        TensorDictModule(linear_layer(num_features, num_actions_of(action_spec)), [in_key], ["logits"]),
        spec=action_spec,
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )


def critic(in_key: str, num_features: int) -> ValueOperator:
    """Build a linear critic of features; writes ``state_value``."""
    return ValueOperator(linear_layer(num_features, 1), in_keys=[in_key])


class ActorCritic(TensorDictSequential):
    """A policy of trunk, `actor` and `critic`, which computes TorchRL's results in plain tensors."""

    capturable = True
    """Whether it acts without a branch on data, as `ctgraph_rl.learn.collect.CapturedAct` needs."""

    def __init__(self, trunk: TensorDictModuleBase, actor: ProbabilisticActor, critic: ValueOperator) -> None:
        super().__init__(trunk, actor, critic)
        self.out_keys = ["action", "action_log_prob", "state_value", *state_written(trunk)]
        self._parts = trunk, trunk.out_keys[0], actor.module[0].module, critic.module
        """What acting needs of the modules; looking it up takes 30 µs."""

    def outputs(self, data: Data) -> TensorsByName:
        """Return ``log_probs`` of all actions and ``state_value`` at any number of steps, [..., n] each."""
        return self.heads(self._parts[0].over_time(data))

    def one_step(self, data: Data) -> Items:
        """Return `outputs` for one step of all rows, and with memory the next state under ``("next", key)``."""
        trunk, key, _, _ = self._parts
        written = trunk.act(data)
        features = written.pop(key)
        return {**written, **self.heads(features)}

    def heads(self, features: Tensor) -> TensorsByName:
        """Return `outputs` from the trunk's features."""
        _, _, logits, value = self._parts
        return {"log_probs": log_probabilities(logits(features)), "state_value": value(features)}

    def forward(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        """Write ``action``, ``action_log_prob``, ``state_value`` and the trunk's next state."""
        for key, value in self.act_on_tensors(tensordict).items():
            tensordict.set(key, value)
        return tensordict

    def action_probs(self, data: Data) -> tuple[Tensor, Items]:
        """Return action probabilities and the trunk's next state, as `ctgraph_rl.agent.Agent`."""
        written = self.one_step(data)
        chances = written.pop("log_probs").softmax(dim=-1)
        return most_likely(chances) if is_greedy() else chances, written

    def act_on_tensors(self, data: Data) -> Items:
        """Return what `forward` writes, for `ctgraph_rl.learn.collect.act`."""
        written = self.one_step(data)
        log_probs = written.pop("log_probs")
        chances = log_probs.softmax(dim=-1)
        action = chances.argmax(dim=-1) if is_greedy() else draw(chances)
        action = guided(data, action)
        written["action"] = action
        written["action_log_prob"] = log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1)
        if PREVIOUS_ACTION in self.in_keys:
            written["next", PREVIOUS_ACTION] = action
        return written


def state_written(trunk: TensorDictModuleBase) -> list[Any]:
    """Return the keys that a policy on a trunk writes of the next step: the state, and the action if it reads that."""
    return [*trunk.out_keys[1:], *[("next", PREVIOUS_ACTION)] * (PREVIOUS_ACTION in trunk.in_keys)]


def guided(data: Data, action: Tensor) -> Tensor:
    """Return a guide's actions, int64 [num_envs], or the policy's where it gave none."""
    given = data.get(GUIDED_ACTION, None)
    return action if given is None else torch.where(given < 0, action, given)


def is_greedy() -> bool:
    """Return whether TorchRL's exploration type asks for best actions."""
    return exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE)


def most_likely(values: Tensor) -> Tensor:
    """Return probabilities of 1 for the largest of values, [..., n]."""
    return one_hot(values.argmax(dim=-1), values.shape[-1]).to(values.dtype)


def draw(chances: Tensor) -> Tensor:
    """Draw from categorical distributions, [..., n], int64 [...].

    Draws as `torch.multinomial` without checks: a fifth of the time, and no wait for a GPU.
    """
    return (chances / torch.empty_like(chances).exponential_()).argmax(dim=-1)


def log_probabilities(logits: Tensor) -> Tensor:
    """Return logarithms of categorical probabilities, [..., n]."""
    return logits - logits.logsumexp(dim=-1, keepdim=True)


def entropy(log_probs: Tensor) -> Tensor:
    """Return the entropy of categorical distributions, [...]."""
    least = torch.finfo(log_probs.dtype).min  # so that a probability of 0 counts as 0
    return -(log_probs.clamp(min=least) * log_probs.softmax(dim=-1)).sum(dim=-1)
