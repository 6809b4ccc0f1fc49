"""The base class of Q-learning agents: epsilon-greedy exploration, replay, a target network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Composite, LazyTensorStorage, TensorDictReplayBuffer, TensorSpec
from torchrl.data.postprocs import MultiStep
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import EGreedyModule
from typing_extensions import override

from baselines.parts.learner import MOST_PASSES, Learner
from baselines.parts.networks import Data, Items, TensorsByName, guided, is_greedy, most_likely, num_actions_of
from baselines.parts.prioritized import PrioritySampler
from baselines.update.measured import table_of
from baselines.update.update import make_optimiser
from ctgraph_rl.batch.specs import TASK_NUMBER
from ctgraph_rl.checks import (
    NamedValues,
    at_least_one,
    at_most,
    fraction,
    make_fields_plain,
    one_of,
    positive,
    require,
    require_memory,
)
from ctgraph_rl.core.device import torchs_defaults
from ctgraph_rl.learn.collect import PREVIOUS_ACTION

LONGEST_TARGET = 10**4


def require_replay(observation_spec: Composite, buffer_size: int, batch_size: int, size: int = 1) -> None:
    """Refuse a replay buffer and minibatches that exceed the memory.

    Args:
        observation_spec: the environment's, without batch dimensions.
        size: numbers of an item beside its observations.

    Raises:
        ValueError: names the sizes and the bytes.
    """
    observation = observation_spec["observation"].shape.numel()
    require(*at_least_one(buffer_size=buffer_size, batch_size=batch_size))
    require_memory(f"replay of buffer_size={buffer_size} steps", buffer_size * observation, "steps")
    require_memory(f"minibatches of batch_size={batch_size}", batch_size * (observation + 4 * size), "items")


class Exploration(EGreedyModule):
    """TorchRL's epsilon-greedy exploration for whole numbers."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replace some actions by random ones, unless actions are greedy."""
        if exploration_type() in (ExplorationType.RANDOM, None):
            action = tensordict["action"]
            explores = torch.rand(action.shape, dtype=torch.float32, device=self.eps.device) < self.eps
            drawn = self.spec["action"].rand(action.shape).to(action.device)
            tensordict.set("action", torch.where(explores, drawn, action))
        return tensordict


class EpsilonGreedy(TensorDictSequential):
    """A `QValueActor` of trunk, head and exploration, which computes TorchRL's results in plain tensors."""

    @override
    def forward(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        values, written = self._act(tensordict)
        written["action"] = values.argmax(dim=-1)
        for key, value in written.items():
            tensordict.set(key, value)
        self.module[1](tensordict)
        action = guided(tensordict, tensordict["action"])
        if PREVIOUS_ACTION in self.in_keys:
            tensordict.set(("next", PREVIOUS_ACTION), action)
        return tensordict.set("action", action)

    def action_probs(self, data: Data) -> tuple[Tensor, Items]:
        """Return action probabilities and the trunk's next state, as `ctgraph_rl.agent.Agent`."""
        values, written = self._act(data)
        greedy = most_likely(values)
        if is_greedy():
            return greedy, written
        eps = self.module[1].eps
        return (1 - eps) * greedy + eps / values.shape[-1], written

    def _act(self, data: Data) -> tuple[Tensor, Items]:
        trunk, head = self.module[0].module[0].module
        written = trunk.act(data)
        values = head.module(written.pop(head.in_keys[0]))
        return values[0] if isinstance(values, tuple) else values, written


@dataclass(frozen=True, kw_only=True)
class QLearnerSettings:
    """The settings of `QLearner`, which agents extend."""

    num_envs: int  # environments that it learns from
    num_steps: int  # steps of each environment between two rounds of updates
    hidden_size: int  # width of the layers
    learning_rate: float  # of the optimiser
    gamma: float  # discount factor
    n_steps: int  # steps of a multi-step target (uncorrected)
    buffer_size: int  # steps that the replay buffer keeps
    batch_size: int  # items that a gradient step learns from
    num_updates: int  # gradient steps after each batch of data
    target_update_interval: int  # gradient steps between two copies to the target network
    eps_init: float  # exploration at the start of a task
    eps_end: float  # exploration after annealing_num_steps
    annealing_num_steps: int  # frames of a task over which exploration falls linearly
    max_grad_norm: float  # gradients are scaled down to this norm
    replay_on_task_change: str  # clear or keep the replay buffer where a task change is announced
    compile: bool = False  # run gradient steps through torch.compile; only without memory
    encoder: str = "mlp"  # mlp, or cnn with two convolutions before the first layer, for images

    def __post_init__(self) -> None:
        make_fields_plain(self)
        require(
            *at_least_one(num_steps=self.num_steps, hidden_size=self.hidden_size, buffer_size=self.buffer_size),
            *at_least_one(n_steps=self.n_steps, batch_size=self.batch_size, num_updates=self.num_updates),
            *at_least_one(target_update_interval=self.target_update_interval),
            *at_least_one(annealing_num_steps=self.annealing_num_steps),
            *at_most(MOST_PASSES, num_updates=self.num_updates),
            *at_most(LONGEST_TARGET, n_steps=self.n_steps),
            *positive(learning_rate=self.learning_rate, gamma=self.gamma),
            *fraction(gamma=self.gamma, eps_init=self.eps_init, eps_end=self.eps_end),
            *one_of(("clear", "keep"), replay_on_task_change=self.replay_on_task_change),
        )
        falls = f"eps_end must be <= eps_init={self.eps_init!r}, got {self.eps_end!r}"
        require((self.eps_end <= self.eps_init, falls))


class QLearner(Learner):
    """Learns action values from replay; explores by random actions, less and less within a task.

    Subclasses call `set_networks` and define `require_room`, `experience` and the loss. A loss that takes ``others``
    gets the target network's weights.
    """

    Settings: ClassVar[Any] = QLearnerSettings
    settings: Any
    output_keys = ("action_value",)

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        self.settings = given = self.Settings(**settings)
        super().__init__(given.num_envs, given.num_steps, given.max_grad_norm, given.compile)
        self.require_room(observation_spec, num_actions_of(action_spec))
        self.minibatch_size = given.batch_size
        self.annealing_batches = max(1, given.annealing_num_steps // (given.num_envs * given.num_steps))
        with torchs_defaults():  # TorchRL's table of discounts names no device
            self.multi_step = MultiStep(given.gamma, given.n_steps)
        self.multi_step.done_keys = ()  # so that the end of an episode is known where the target reaches it
        size = self.num_items(given.buffer_size)
        sampler = self.make_sampler(size)
        self.prioritized = isinstance(sampler, PrioritySampler)
        storage = LazyTensorStorage(size)
        self.replay = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=given.batch_size)

    def require_room(self, observation_spec: Composite, num_actions: int) -> None:
        """Refuse networks and replay that exceed the memory."""
        raise NotImplementedError

    def make_sampler(self, size: int) -> Any:
        """Return what draws from a replay buffer of so many items."""
        return RandomSampler()

    def num_items(self, num_steps: int) -> int:
        """Return how many items of the replay buffer hold so many steps."""
        return num_steps

    def set_networks(
        self,
        greedy: TensorDictModuleBase,
        action_spec: TensorSpec,
        state: Sequence[Any] = (),
    ) -> None:
        """Set the acting network, its target network and the exploration.

        Args:
            greedy: writes the best ``action``.
            state: from `state_written`.
        """
        eps = float(self.settings.eps_init), float(self.settings.eps_end)
        with torchs_defaults():
            self.exploration = Exploration(action_spec, *eps, self.annealing_batches)
        self.policy = EpsilonGreedy(greedy, self.exploration)
        self.policy.out_keys = ["action", *state]
        self.greedy = greedy
        self.network_changed()
        self.optimiser = make_optimiser("adam", greedy.parameters(), self.settings.learning_rate)

    @override
    def start_task(self, task: int | None = None) -> None:
        self.exploration.eps.copy_(self.exploration.eps_init)
        if self.settings.replay_on_task_change == "clear":
            self.replay.empty()

    @override
    def other_weights(self) -> TensorsByName:
        return {f"greedy.{name}": value for name, value in self.target.named_parameters()}

    @override
    def network_changed(self) -> None:
        self.target = deepcopy(self.greedy).requires_grad_(False)
        self.target_age = 0

    @override
    def weights_changed(self) -> None:
        self.target.load_state_dict(self.greedy.state_dict())
        self.target_age = 0

    def values(self, data: Data) -> Tensor:
        """Return the network's action values, [..., num_actions]."""
        raise NotImplementedError

    def outputs(self, data: Data) -> TensorsByName:
        """Return the action values, and the log-probabilities of their softmax."""
        values = self.values(data)
        return {"log_probs": values.log_softmax(dim=-1), "action_value": values}

    def with_targets(self, batch: TensorDictBase) -> TensorDictBase:
        """Return a batch with multi-step rewards, what follows them, and the steps that they span."""
        read = "task_id" in self.policy.in_keys  # else it is long and would only be copied
        used = batch if read else batch.exclude("task_id", ("next", "task_id"))
        with torchs_defaults():  # TorchRL's powers of the discount have torch's default dtype
            return self.multi_step(used)

    def experience(self, batch: TensorDictBase) -> TensorDictBase:
        """Return what the replay buffer stores of a batch with multi-step rewards, [items]."""
        raise NotImplementedError

    def minibatches(self, batch: TensorDictBase) -> Iterator[Items]:
        """Store a batch, and yield replayed minibatches, as ``replay.sample()`` in plain tensors."""
        self.replay.extend(self.experience(self.with_targets(batch)))
        storage = self.replay.storage
        device = next(self.parameters()).device
        for _ in range(self.settings.num_updates):
            self.replayed, more = self.replay.sampler.sample(storage, self.minibatch_size)
            stored = storage._storage.items(True, True)  # the buffer stays on the CPU
            items = {key: value.index_select(0, self.replayed).to(device) for key, value in stored}
            for key, value in more.items():
                items[key] = value.to(device)
            yield items

    @override
    def shown_ids(self, batch: TensorDictBase) -> Tensor | None:
        shown = super().shown_ids(batch)
        if shown is None or not len(self.replay):
            return shown
        stored = self.replay.storage._storage[: len(self.replay)]
        columns = [value.flatten() for key, value in stored.items(True, True) if TASK_NUMBER in key]
        return torch.cat([shown, *columns])

    def after_update(self, measured: TensorsByName) -> TensorsByName:
        """Set the priorities of replayed items, and copy the weights to the target network if due."""
        squared = measured.pop("td_error", None)
        if self.prioritized and squared is not None:
            self.means(list(measured), table_of([measured]))  # raises before a priority becomes NaN
            self.replay.update_priority(self.replayed, squared.cpu().sqrt())
        self.target_age += 1
        if self.target_age == self.settings.target_update_interval:
            self.weights_changed()
        return measured

    @override
    def after_batch(self, measurements: dict[str, float]) -> dict[str, float]:
        self.exploration.step()
        return {**measurements, "exploration": self.exploration.eps.item()}

    @property
    def needs_weights(self) -> bool:
        """Whether the target network is due after the next gradient step."""
        return self.prioritized or self.target_age == self.settings.target_update_interval - 1

    @override
    def get_extra_state(self) -> NamedValues:
        replay = self.replay.state_dict()
        for items in replay["_storage"]["_storage"].values():
            if isinstance(items, Tensor):  # unused places hold anything; equal agents have equal states
                items[replay["_storage"]["_len"] :] = 0
        return {**super().get_extra_state(), "replay": replay, "target_age": self.target_age}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        super().set_extra_state(state)
        self.replay.load_state_dict(state["replay"])
        self.target_age = state["target_age"]
