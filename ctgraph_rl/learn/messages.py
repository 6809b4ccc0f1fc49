"""Messages between learners: their contents are checked, and a separate random stream loses or delays some.

A message holds tensors and numbers by name. A receiver refuses and counts one whose kind, names, shapes or values its
exchange does not state.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.checks import LARGEST_INT, NamedValues, ReadOnlyValues, fraction, is_int, is_real, require

BYTES_OF_A_NUMBER = 8

SENT, DROPPED, DELAYED, DELIVERED, REFUSED = "sent", "dropped", "delayed", "delivered", "refused"
"""What is counted by kind of message; a delayed one is later also delivered or refused."""


@dataclass(frozen=True)
class Message:
    """What one learner sends to another.

    Args:
        kind: such as ``query``.
        sender: number of a learner, from 0.
        receiver: number of another.
        content: tensors and numbers by name.
    """

    kind: str
    sender: int
    receiver: int
    content: ReadOnlyValues

    @property
    def num_bytes(self) -> int:
        """Bytes of the content: those of tensors, and eight for each number."""
        return sum(
            value.numel() * value.element_size() if isinstance(value, Tensor) else BYTES_OF_A_NUMBER
            for value in self.content.values()
        )


class Number(NamedTuple):
    """A finite number in [low, high]."""

    low: float = -math.inf
    high: float = math.inf
    whole: bool = False

    def why_not(self, value: Any) -> str | None:
        """Return what is wrong with a value, if anything."""
        is_number = is_int if self.whole else is_real
        if not is_number(value):
            return f"no finite {'integer' if self.whole else 'number'}"
        return None if self.low <= value <= self.high else f"not in [{self.low}, {self.high}]"


class Array(NamedTuple):
    """A tensor of this shape and type whose elements are finite."""

    shape: tuple[int, ...]
    dtype: torch.dtype = torch.float32

    def why_not(self, value: Any) -> str | None:
        """Return what is wrong with a value, if anything."""
        if not isinstance(value, Tensor):
            return "no tensor"
        if tuple(value.shape) != self.shape or value.dtype != self.dtype:
            return f"{value.dtype} {list(value.shape)} instead of {self.dtype} {list(self.shape)}"
        return None if bool(value.isfinite().all()) else "not finite"


Fields = Mapping[str, Number | Array]
"""What the content of a kind of message must be, by name."""

TASK_ID = Number(0, LARGEST_INT, whole=True)


def why_refused(message: Message, kinds: Mapping[str, Fields]) -> str | None:
    """Return why a message must not be used; None if it may.

    Args:
        message: what was received.
        kinds: the fields of each kind that the receiver knows.
    """
    fields = kinds.get(message.kind)
    if fields is None:
        return f"unknown kind {message.kind!r:.40}"
    if message.content.keys() != fields.keys():
        return f"a {message.kind} with other fields than {', '.join(fields)}"
    for name, field in fields.items():
        why = field.why_not(message.content[name])
        if why is not None:
            return f"{name} of a {message.kind}: {why}"
    return None


class Mail:
    """Takes messages to their receivers; each is independently lost or late with a stated probability.

    A late message arrives at the next exchange. Each message makes two draws, whatever the probabilities.

    Args:
        drop_prob: probability that a message is lost.
        delay_prob: probability that one which is not lost is late.
        seed: of the draws.

    Raises:
        ValueError: for probabilities outside [0, 1].
    """

    def __init__(self, drop_prob: float = 0.0, delay_prob: float = 0.0, seed: int = 0) -> None:
        require(*fraction(drop_prob=drop_prob, delay_prob=delay_prob))
        self.drop_prob = drop_prob
        self.delay_prob = delay_prob
        self.generator = torch.Generator(device="cpu").manual_seed(seed)
        self.here: list[Message] = []
        self.late: list[Message] = []
        self.counts: Counter[tuple[str, str]] = Counter()
        """Messages by kind and by what happened to them, since the last `begin`."""

        self.bytes: Counter[str] = Counter()
        """Bytes sent by kind of message, since the last `begin`."""

    def begin(self) -> None:
        """Begin an exchange: late messages of the last one arrive, and counts start at zero."""
        self.here = [*self.here, *self.late]
        self.late = []
        self.counts.clear()
        self.bytes.clear()

    def post(self, message: Message) -> None:
        """Send a message."""
        lost, late = torch.rand(2, generator=self.generator, dtype=torch.float32, device="cpu").tolist()
        self.counts[message.kind, SENT] += 1
        self.bytes[message.kind] += message.num_bytes
        if lost < self.drop_prob:
            self.counts[message.kind, DROPPED] += 1
        elif late < self.delay_prob:
            self.counts[message.kind, DELAYED] += 1
            self.late.append(message)
        else:
            self.here.append(message)

    def take(
        self, receiver: int, kind: str, kinds: Mapping[str, Fields]
    ) -> tuple[list[Message], list[tuple[Message, str]]]:
        """Return the messages that a receiver may use, and those that it refuses, with the reason.

        Args:
            receiver: number of a learner.
            kind: messages of this kind, and of unknown kinds.
            kinds: the fields of each known kind.
        """
        good = []
        refused = []
        others = []
        for each in self.here:
            if each.receiver != receiver or (each.kind != kind and each.kind in kinds):
                others.append(each)
                continue
            reason = why_refused(each, kinds)
            self.counts[each.kind, DELIVERED if reason is None else REFUSED] += 1
            if reason is None:
                good.append(each)
            else:
                refused.append((each, reason))
        self.here = others
        return good, refused

    def state_dict(self) -> NamedValues:
        """Return the random stream and the late messages."""
        return {"random": self.generator.get_state(), "late": list(map(_as_plain, self.late))}

    def load_state_dict(self, state: ReadOnlyValues) -> None:
        """Restore what `state_dict` returned."""
        self.generator.set_state(state["random"])
        self.late = [Message(**message) for message in state["late"]]


def _as_plain(message: Message) -> NamedValues:
    return {**vars(message), "content": dict(message.content)}


def to_all(kind: str, sender: int, num_members: int, content: ReadOnlyValues) -> list[Message]:
    """Return a message to every other learner."""
    return [Message(kind, sender, other, content) for other in range(num_members) if other != sender]
