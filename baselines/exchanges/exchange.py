"""The base classes of exchanges between the learners of a collective; see `ctgraph_rl.learn.collective`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from typing_extensions import override

from baselines.methods.parts.masks import Masks
from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, TakesNumbers, at_least_one, fraction, require
from ctgraph_rl.learn.collective import Help
from ctgraph_rl.learn.messages import Message


class Exchange(TakesNumbers):
    """An exchange without messages, the base of others.

    Args:
        num_members: learners of the collective.
        every: batches between two exchanges; the first is after the first batch.
        drop_prob: probability that a message is lost.
        delay_prob: probability that a message which is not lost arrives at the next exchange.
    """

    kinds: Sequence[str] = ()

    def __init__(self, num_members: int, every: int, drop_prob: float, delay_prob: float) -> None:
        require(
            *at_least_one(num_members=num_members, every=every),
            *fraction(drop_prob=drop_prob, delay_prob=delay_prob),
        )
        self.num_members = num_members
        self.every = every
        self.drop_prob = drop_prob
        self.delay_prob = delay_prob

    def settings_of(self, member: int) -> ReadOnlyValues:
        """Return none; methods as in `ctgraph_rl.learn.collective.ExchangeLike`."""
        return {}

    def connect(self, agents: Sequence[Agent]) -> None:
        """Do nothing."""

    def observe(self, member: int, batch: TensorDictBase, episode_return: float) -> None:
        """Do nothing."""

    def send(self, kind: str, member: int, received: Sequence[Message]) -> Sequence[Message]:
        """Send nothing."""
        return []

    def receive(self, member: int, received: Sequence[Message]) -> Sequence[Help]:
        """Take over nothing."""
        return []

    def state_dict(self) -> NamedValues:
        """Return nothing."""
        return {}

    def load_state_dict(self, state: ReadOnlyValues) -> None:
        """Restore nothing."""


class MaskExchange(Exchange):
    """An exchange of masks, which knows each member's last mean return in each of its tasks.

    All members have the same network behind their masks.
    """

    kinds = ("query", "offer", "request", "mask")
    method = "mask_ri"

    def connect(self, agents: Sequence[Agent]) -> None:
        """Take the members' methods.

        Raises:
            ValueError: if a member has other masks or another network than this exchange needs.
        """
        self.methods: list[Any] = [getattr(agent, "method", None) for agent in agents]
        name = type(self).__name__
        lack = []
        for number, method in enumerate(self.methods):
            if not (isinstance(method, Masks) and self.takes(method)):
                lack.append(f"member {number} has {type(method).__name__}: take method={self.method}")
        needs = f"{name} needs masks, which {len(lack)} of {len(agents)} members lack"
        require((not lack, "; ".join([needs, *lack[:1]])))
        first = self.methods[0].constant
        others = sum(not torch.equal(first, method.constant) for method in self.methods)
        needs = f"{name} needs one network behind all masks"
        have = f"{others} of {len(self.methods)} members have another than member 0"
        require((not others, f"{needs}, and {have}: set method.backbone_seed"))
        self.returns: list[dict[int, float]] = [{} for _ in agents]

    def takes(self, method: Masks) -> bool:
        """Return whether it can exchange a method's masks."""
        return True

    def task_of(self, member: int) -> int:
        """Return the id of a member's present task."""
        method = self.methods[member]
        return method.started[method.slot]

    def observe(self, member: int, batch: TensorDictBase, episode_return: float) -> None:
        """Keep the mean return of the batch, if an episode ended in it."""
        if not math.isnan(episode_return):
            self.returns[member][self.task_of(member)] = episode_return

    def return_of(self, member: int, task: int) -> float:
        """Return a member's last mean return in a task, or 0."""
        return self.returns[member].get(task, 0.0)

    @override
    def state_dict(self) -> NamedValues:
        return {"returns": [dict(each) for each in self.returns]}

    @override
    def load_state_dict(self, state: ReadOnlyValues) -> None:
        self.returns = [dict(each) for each in state["returns"]]
