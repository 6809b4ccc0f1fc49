"""MOSAIC: learners find similar tasks by embeddings, and combine masks of those who do better.

Nath et al. 2025 (arXiv 2506.05577), repository DMIU-ShELL/MOSAIC, where each member has one task. Its detection of task
changes is not here: a new task begins without an embedding. We chose to query first after the first batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import cosine_similarity
from typing_extensions import override

from baselines.exchanges.exchange import MaskExchange
from baselines.methods.mask_shared import MaskShared
from baselines.methods.parts.masks import Masks
from baselines.methods.parts.weights import flat
from baselines.parts.embedding import linear_wasserstein, reference_points, sampled_points, with_last
from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import (
    LARGEST_INT,
    NamedValues,
    ReadOnlyValues,
    at_least_one,
    is_int,
    is_real,
    require,
    true_or_false,
)
from ctgraph_rl.learn.collective import Help
from ctgraph_rl.learn.messages import Message, to_all

LARGEST_RETURN = 0.9999
"""Of a return that decides the own share, so that the others keep one."""


class Mosaic(MaskExchange):
    """Each member sends its task's embedding to all others, and combines masks of similar ones with a higher return.

    After each batch a member's z becomes (z + e) / 2, at first e / 2. e is the linear Wasserstein embedding of
    ``num_samples`` of the last ``buffer_size`` transitions. Its last mean return is r. A peer offers its mask if the
    cosine of both z is at least ``threshold`` and its return is above r. The member requests the ``top_n`` most similar
    ones. Its own scores become its present combination, with an initial share of 0.5 + 0.5 r, r clipped to [0, 0.9999],
    or ``own_share``; the c received share the rest equally (`MaskShared.receive`).

    Args:
        threshold: least cosine, in [-1, 1].
        top_n: most masks that are requested.
        num_samples: N. **More than** ``buffer_size`` **means that no embedding is ever made and no message sent**, as
            with the 256 of the published default.
        buffer_size: the last transitions that samples are drawn from.
        num_references: reference points of the embedding.
        use_similarity: False ignores the tasks.
        use_return: False ignores the returns.
        own_share: fixed initial share of the own scores, in (0, 1); None: by the return.
        seed: decides the samples.
        common: arguments of `Exchange`.
    """

    method = "mask_shared"

    def __init__(
        self,
        threshold: float,
        top_n: int,
        num_samples: int,
        buffer_size: int,
        num_references: int,
        use_similarity: bool,
        use_return: bool,
        own_share: float | None,
        seed: int,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        share_rule = f"own_share must be a number in (0, 1) or null, got {own_share!r}"
        require(
            (is_real(threshold, -1, 1), f"threshold must be in [-1, 1], got {threshold!r}"),
            (own_share is None or (is_real(own_share, 0, 1) and own_share not in (0, 1)), share_rule),
            (is_int(seed, 0, LARGEST_INT), f"seed must be an integer in [0, 2**63), got {seed!r}"),
            *at_least_one(top_n=top_n, num_samples=num_samples, buffer_size=buffer_size, num_references=num_references),
            *true_or_false(use_similarity=use_similarity, use_return=use_return),
        )
        self.threshold = threshold
        self.top_n = top_n
        self.own_share = own_share
        self.num_samples = num_samples
        self.buffer_size = buffer_size
        self.num_references = num_references
        self.use_similarity = use_similarity
        self.use_return = use_return
        self.generator = torch.Generator(device="cpu").manual_seed(seed)

    @override
    def takes(self, method: Masks) -> bool:
        return isinstance(method, MaskShared)

    @override
    def connect(self, agents: Sequence[Agent]) -> None:
        super().connect(agents)
        room = min(method.max_received for method in self.methods)
        require((self.top_n <= room, f"top_n must be at most method.max_received={room}, got {self.top_n}"))
        self.num_actions = max(method.num_actions for method in self.methods)
        self.known: list[KnownMask] = [KnownMask() for _ in agents]

    def observe(self, member: int, batch: TensorDictBase, episode_return: float) -> None:
        """Keep the batch's last transitions and its mean return, and update the embedding."""
        super().observe(member, batch, episode_return)
        task = self.task_of(member)
        known = self.known[member]
        if known.task != task:
            known = self.known[member] = KnownMask(task)
        known.recent = with_last(known.recent, batch.transpose(0, 1), self.buffer_size)
        if len(known.recent["action"]) < self.num_samples:
            return
        points = sampled_points(known.recent, self.num_samples, self.num_actions, self.generator)
        new = linear_wasserstein(points, reference_points(self.num_references, points.shape[1]))
        known.embedding = (new if known.embedding is None else known.embedding + new) / 2

    def send(self, kind: str, member: int, received: Sequence[Message]) -> Sequence[Message]:
        """Send queries, none without an embedding, and answer what was received."""
        if kind == "query":
            embedding = self.known[member].embedding
            if embedding is None:
                return []
            content = {"task": self.task_of(member), "reward": self._own_return(member), "embedding": embedding}
            return to_all(kind, member, self.num_members, content)
        if kind == "offer":
            offers: list[Message] = []
            for query in received:
                offers += self._offers(member, query)
            return offers
        if kind == "request":
            best = self._best(member, received)
            return [Message(kind, member, each.sender, _of(each, "task", "similarity")) for each in best]
        own = {
            "reward": self._own_return(member),
            "scores": flat(self.methods[member].current_scores()).detach().clone(),
        }
        return [Message(kind, member, each.sender, {**_of(each, "task", "similarity"), **own}) for each in received]

    @override
    def receive(self, member: int, received: Sequence[Message]) -> Sequence[Help]:
        best = self._best(member, received)
        own = self._own_return(member)
        if not best:
            return []
        share = self.own_share
        if share is None:
            share = 0.5 + 0.5 * min(max(own, 0.0), LARGEST_RETURN)
        self.methods[member].receive(torch.stack([each.content["scores"] for each in best]), share)
        helps = []
        for each in best:
            values = {
                "task_id": self.task_of(member),
                "return_before": own,
                "own_share": share,
                "return_of_sender": each.content["reward"],
                "similarity": each.content["similarity"],
            }
            helps.append(Help(each.sender, member, values))
        return helps

    def _offers(self, member: int, query: Message) -> list[Message]:
        embedding = self.known[member].embedding
        own = self._own_return(member)
        if embedding is None or (self.use_return and own <= query.content["reward"]):
            return []
        similarity = cosine_similarity(embedding, query.content["embedding"], dim=0).item()
        if self.use_similarity and similarity < self.threshold:
            return []
        content = {"task": query.content["task"], "reward": own, "similarity": similarity}
        return [Message("offer", member, query.sender, content)]

    def _own_return(self, member: int) -> float:
        return self.return_of(member, self.task_of(member))

    def _best(self, member: int, received: Sequence[Message]) -> list[Message]:
        task = self.task_of(member)
        newest = {each.sender: each for each in received if each.content["task"] == task}
        return sorted(newest.values(), key=lambda each: (-each.content["similarity"], each.sender))[: self.top_n]

    @override
    def state_dict(self) -> NamedValues:
        known = [dict(vars(each)) for each in self.known]
        return {**super().state_dict(), "known": known, "random": self.generator.get_state()}

    @override
    def load_state_dict(self, state: ReadOnlyValues) -> None:
        super().load_state_dict(state)
        self.known = [KnownMask(**each) for each in state["known"]]
        self.generator.set_state(state["random"])


@dataclass
class KnownMask:
    """What a member knows of its task: the id, the embedding z and the last transitions, oldest first."""

    task: int | None = None
    embedding: Tensor | None = None
    recent: dict[str, Tensor] = field(default_factory=dict)


def _of(message: Message, *names: str) -> NamedValues:
    return {name: message.content[name] for name in names}
