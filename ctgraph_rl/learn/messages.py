"""Messages between learners: tensors and numbers by name. Some are lost or late, by a separate random stream."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, fraction, require

BYTES_OF_A_NUMBER = 8

SENT, DROPPED, DELAYED, DELIVERED = "sent", "dropped", "delayed", "delivered"
"""What is counted of the messages of a kind; a delayed one is also delivered, later."""


@dataclass(frozen=True)
class Message:
    """What one learner sends to another.

    Args:
        kind: such as ``query``.
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


class Mail:
    """Takes messages to their receivers; each is independently lost or late with a stated probability.

    A late message arrives at the next exchange. Each message makes two draws, whatever the probabilities.

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

    def take(self, receiver: int, kind: str) -> list[Message]:
        """Return what a receiver has got of a kind."""
        taken = []
        others = []
        for each in self.here:
            if (each.receiver, each.kind) == (receiver, kind):
                taken.append(each)
            else:
                others.append(each)
        self.here = others
        if taken:
            self.counts[kind, DELIVERED] += len(taken)
        return taken

    def state_dict(self) -> NamedValues:
        """Return the random stream and the late messages, as tensors and plain values."""
        late = [{**vars(message), "content": dict(message.content)} for message in self.late]
        return {"random": self.generator.get_state(), "late": late}

    def load_state_dict(self, state: ReadOnlyValues) -> None:
        """Restore what `state_dict` returned."""
        self.generator.set_state(state["random"])
        self.late = [Message(**message) for message in state["late"]]


def to_all(kind: str, sender: int, num_members: int, content: ReadOnlyValues) -> list[Message]:
    """Return a message to every other learner."""
    return [Message(kind, sender, other, content) for other in range(num_members) if other != sender]
