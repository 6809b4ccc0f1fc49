"""CLEAR: replay from a reservoir of all earlier steps, at which policy and values are cloned.

Rolnick et al. 2019 (NeurIPS, arXiv 1811.11682), the cloning losses of section 3.2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from typing_extensions import override

from baselines.methods.method import Method
from baselines.parts.networks import Data, Items, TensorsByName, sequences_of
from ctgraph_rl.checks import NamedValues, at_least_one, not_negative, require, require_memory


class Reservoir:
    """A uniform random sample of all items that were offered.

    Vitter 1985, Algorithm R: item n takes a random one of n places, if the reservoir has it.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.offered = 0
        self.items: Items = {}

    def __len__(self) -> int:
        return min(self.offered, self.capacity)

    def offer(self, items: Mapping[Any, Tensor]) -> None:
        """Put items, [n, ...] each, at random places that the reservoir has; later ones replace earlier ones."""
        if not self.items:
            self.items = {key: value.new_zeros(self.capacity, *value.shape[1:]) for key, value in items.items()}
        number = next(iter(items.values())).shape[0]
        order = torch.arange(self.offered, self.offered + number, device="cpu")
        share = torch.rand(number, dtype=torch.float64, device="cpu")
        drawn = (share * (order + 1)).long()
        place = torch.where(order < self.capacity, order, drawn)
        taken = (place < self.capacity).nonzero().squeeze(-1)
        none = torch.full([self.capacity], -1, dtype=torch.int64, device="cpu")
        last = none.scatter_reduce(0, place[taken], taken, "amax")
        places = (last >= 0).nonzero().squeeze(-1)
        for key, value in items.items():
            chosen = value.index_select(0, last[places].to(value.device))
            self.items[key][places.to(value.device)] = chosen
        self.offered += number

    def sample(self, number: int) -> Items:
        """Draw items with replacement."""
        places = torch.randint(len(self), [number], device="cpu")
        return {key: value.index_select(0, places.to(value.device)) for key, value in self.items.items()}


class CLEAR(Method):
    """Adds cloning losses for earlier behaviour, on as many replayed steps as a minibatch has new ones.

    L = policy_coeff KL(mu || pi) + value_coeff |V_mu - V|^2, where mu and V_mu are the network's outputs when the step
    was taken; for a Q-learner value_coeff |Q_mu - Q|^2, the mean over actions. The paper's off-policy policy gradient
    (V-trace) on replayed steps is left out. It needs no task ids and no boundaries.

    Stored are ``buffer_size`` steps with the network's inputs and outputs, whatever the number of tasks; with memory
    whole rows of full batches.

    Args:
        buffer_size: stored steps.
        policy_coeff: weight of the policy's cloning loss.
        value_coeff: weight of the values' cloning loss.
    """

    acts_on_batches = stackable = True
    needs_boundaries = False
    agent_members = (*Method.agent_members, "memory", "outputs", "output_keys")

    def __init__(self, buffer_size: int, policy_coeff: float, value_coeff: float) -> None:
        super().__init__()
        require(
            *at_least_one(buffer_size=buffer_size),
            *not_negative(policy_coeff=policy_coeff, value_coeff=value_coeff),
        )
        self.buffer_size = buffer_size
        self.policy_coeff = policy_coeff
        self.value_coeff = value_coeff

    @override
    def setup(self) -> None:
        steps = self.agent.num_steps if self.agent.memory else 1
        message = f"buffer_size must be at least the {steps} steps of a row, got {self.buffer_size}"
        require((self.buffer_size >= steps, message))
        state = sum(each.nbytes for each in self.agent.initial_state(1).values())
        size = math.prod(self.curriculum.tasks[0].observation_shape) + state
        require_memory(f"replay of buffer_size={self.buffer_size} steps", self.buffer_size * size, "steps")
        self.reservoir = Reservoir(self.buffer_size // steps)

    @torch.no_grad()
    @override
    def on_batch(self, batch: TensorDictBase) -> None:
        agent = self.agent
        if agent.memory and batch.shape[1] != agent.num_steps:
            return
        keys = [key for key in agent.policy.in_keys if key in batch.keys()]  # noqa: SIM118, rows otherwise
        inputs = sequences_of(batch, keys)
        outputs = agent.outputs(inputs)
        items = dict(inputs)
        for key in agent.output_keys:
            items[key] = outputs[key]
        if not agent.memory:
            items = {key: value.flatten(0, 1) for key, value in items.items()}
        self.reservoir.offer(items)

    @override
    def transform_minibatch(self, batch: Data) -> Data:
        if not len(self.reservoir):
            return batch
        replayed = self.reservoir.sample(len(batch["action"]))
        replay = {("replay", key): value for key, value in replayed.items()}
        return {**batch, **replay}

    @override
    def penalties(self, batch: Data, weights: Sequence[Tensor]) -> TensorsByName:
        replayed = {key[1]: value for key, value in batch.items() if key[0] == "replay"}
        if not replayed:
            return {}
        now = self.agent.outputs(replayed)
        losses = {}
        for key in self.agent.output_keys:
            if key == "log_probs":
                then = replayed[key]
                kl = (then.exp() * (then - now[key])).sum(dim=-1)
                losses["loss_policy_cloning"] = self.policy_coeff * kl.mean()
            else:
                losses["loss_value_cloning"] = self.value_coeff * (replayed[key] - now[key]).square().mean()
        return losses

    @override
    def get_extra_state(self) -> NamedValues:
        items = {key: value[: len(self.reservoir)].clone() for key, value in self.reservoir.items.items()}
        return {"offered": self.reservoir.offered, "items": items}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        self.reservoir = Reservoir(self.reservoir.capacity)
        self.reservoir.offered = state["offered"]
        for key, value in state["items"].items():
            room = value.new_zeros(self.reservoir.capacity, *value.shape[1:], device=self.weights.device)
            room[: len(value)] = value
            self.reservoir.items[key] = room
