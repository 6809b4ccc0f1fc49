"""A collective: learners learn a curriculum each, in lock-step, and exchange messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, at_least_one, require, require_all, takes_numbers
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.learn.lifelong import OfferCheckpoint
from ctgraph_rl.learn.loop import Alone, Lockstep, Progress, SavedState, run_loop, saved_state_fits
from ctgraph_rl.learn.messages import DELAYED, DELIVERED, DROPPED, SENT, Mail, Message
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Curriculum


class Help(NamedTuple):
    """What a learner took over from another."""

    sender: int
    receiver: int
    values: Mapping[str, float]
    """To log by name, such as the sender's return."""


class ExchangeLike(Protocol):
    """The messages of a collective's learners, such as `baselines.exchanges.l2d2c.L2D2C`.

    It does not draw from torch's global generator.
    """

    num_members: int
    every: int
    """Batches between two exchanges; the first is after the first batch."""

    drop_prob: float
    delay_prob: float
    kinds: Sequence[str]
    """The kinds of messages in the order in which they are sent within an exchange."""

    def settings_of(self, member: int) -> ReadOnlyValues:
        """Return this member's special settings, such as ``{"agent.learning_rate": 0.01}``."""
        ...

    def connect(self, agents: Sequence[Agent]) -> None:
        """Take the agents of all members, before they learn.

        Raises:
            ValueError: if they cannot exchange messages.
        """
        ...

    def observe(self, member: int, batch: TensorDictBase, episode_return: float) -> None:
        """Take a batch that a member has learned from, and the mean return of its finished episodes."""
        ...

    def send(self, kind: str, member: int, received: Sequence[Message]) -> Sequence[Message]:
        """Return a member's messages of a kind, given those it received of the kind before."""
        ...

    def receive(self, member: int, received: Sequence[Message]) -> Sequence[Help]:
        """Let a member use the messages of the last kind; return what it took over."""
        ...

    def state_dict(self) -> NamedValues:
        """Return what a resumed run needs, as tensors and plain values."""
        ...

    def load_state_dict(self, state: ReadOnlyValues) -> None:
        """Restore what `state_dict` returned."""
        ...


@dataclass(eq=False)
class Member:
    """A learner of a collective.

    Args:
        random: its state of torch's global generator; default: the present one, so make a member right after its agent.
    """

    curriculum: Curriculum
    agent: Agent
    seed: int = 0
    log: RunLog = field(default_factory=RunLog)
    random: Tensor = field(default_factory=torch.get_rng_state)
    log_units: bool | str = False


@takes_numbers
def learn_collective(
    members: Sequence[Member],
    exchange: ExchangeLike,
    seed: int = 0,
    log: RunLog | None = None,
    progress: Progress | None = None,
    *,
    device: torch.device | str = "cpu",
    saved: ReadOnlyValues | None = None,
    checkpoint: OfferCheckpoint | None = None,
) -> RunLog:
    """Let members learn in lock-step, a batch each in turn, with messages between batches.

    A member that takes over nothing has the bits of `learn_curriculum`. One that has finished its curriculum still
    answers, and takes over nothing.

    Args:
        log: of the collective: lines ``exchange`` for messages and ``help`` for what members took over. The members'
            own logs also have the latter. Default: a new one in memory.
        progress: updated after each round with the frames of all members and their mean return.
        saved: a state that ``checkpoint`` was given, to resume with the same bits. Members are built the same way, and
            their logs hold what they held then.
        checkpoint: is offered the state after each round.

    Returns:
        The log of the collective.

    Raises:
        ValueError: before any work, if members are not ``exchange.num_members``, share an agent or a log, or cannot
            learn their curriculum; names the member, from 0.
        FloatingPointError: if a loss or weight is not finite; names the member, block and frames.
    """
    members = require_all(Member, "members", members)
    log = RunLog() if log is None else log
    _check(members, exchange)
    exchange.connect([member.agent for member in members])
    collective = _Collective(members, exchange, Mail(exchange.drop_prob, exchange.delay_prob, seed), log)
    with closing(collective):
        collective.start(checked_device(device), saved)
        run_loop(collective, progress, checkpoint)
    return log


def _check(members: Sequence[Member], exchange: ExchangeLike) -> None:
    count = len(members)
    agents = {id(each.agent) for each in members}
    logs = {id(each.log) for each in members}
    other = f"num_members must be the number of members, {count}, got {exchange.num_members!r}"
    require(
        (exchange.num_members == count, other),
        (len(agents) == count, "members must have an agent each, some share one; build one with each seed"),
        (len(logs) == count, "members must have a log each, some share one; leave it out for new ones"),
        *at_least_one(every=exchange.every),
    )


class _Learner:
    def __init__(self, number: int, member: Member, device: torch.device, saved: SavedState | None) -> None:
        self.number = number
        self.member = member
        self.device = device
        self.saved = saved
        self.random = member.random
        if device.type == "cuda":
            self.random_cuda = torch.Generator(device=device).manual_seed(member.seed).get_state()
        self.is_done = saved is not None and saved["done"]
        self.has_learned = False
        states = None if saved is None or self.is_done else [saved]
        try:
            with self.drawing():
                group = Alone(member.agent)
                self.steps = Lockstep(
                    member.curriculum,
                    group,
                    [member.seed],
                    [member.log],
                    device=device,
                    saved=states,
                    log_units=member.log_units,
                )
        except ValueError as error:
            raise ValueError(f"member {number}: {error}") from error
        if self.is_done:
            with saved_state_fits():
                member.agent.load_state_dict(saved["agent"])  # type: ignore[index]
                self.steps.frames = saved["frames"]  # type: ignore[index]

    @contextmanager
    def drawing(self) -> Iterator[None]:
        cuda = [self.device] if self.device.type == "cuda" else []
        with torch.random.fork_rng(cuda):
            torch.set_rng_state(self.random)
            for device in cuda:
                torch.cuda.set_rng_state(self.random_cuda, device)
            try:
                yield
            finally:
                self.random = torch.get_rng_state()
                for device in cuda:
                    self.random_cuda = torch.cuda.get_rng_state(device)

    def advance(self) -> bool:
        if self.is_done:
            return False
        with self.drawing():
            self.is_done = not self.steps.advance()
        for error in self.steps.failed.values():
            raise FloatingPointError(f"member {self.number}: {error}")
        self.has_learned = self.has_learned or not self.is_done
        return not self.is_done

    def state(self) -> NamedValues:
        """Return all that the rest of this member's run depends on; only a collective can resume it."""
        if self.has_learned:
            with self.drawing():
                [state] = self.steps.state()
            return {**state, "done": self.is_done}
        return {**(self.saved or {}), "agent": self.member.agent.state_dict(), "log": self.member.log.position()}


class _Collective:
    def __init__(self, members: Sequence[Member], exchange: ExchangeLike, mail: Mail, log: RunLog) -> None:
        self.members = members
        self.exchange = exchange
        self.mail = mail
        self.log = log
        self.rounds = 0
        self.learners: list[_Learner] = []
        self.advanced: list[_Learner] = []

    def start(self, device: torch.device, saved: ReadOnlyValues | None) -> None:
        states: Sequence[Any] = [None] * len(self.members) if saved is None else saved["members"]
        count = f"the saved state has {len(states)} members, there are {len(self.members)}; start again"
        require((len(states) == len(self.members), count))
        for number, (member, state) in enumerate(zip(self.members, states, strict=True)):
            self.learners.append(_Learner(number, member, device, state))
        if saved is not None:
            self.rounds = saved["rounds"]
            self.mail.load_state_dict(saved["mail"])
            with saved_state_fits():
                self.exchange.load_state_dict(saved["exchange"])

    def close(self) -> None:
        for learner in self.learners:
            learner.steps.close()

    @property
    def frames(self) -> int:
        return sum(learner.steps.frames for learner in self.learners)

    @property
    def block(self) -> int:
        return max(learner.steps.block for learner in self.advanced)

    @property
    def returns(self) -> list[float]:
        return [learner.steps.returns[0] for learner in self.advanced]

    @property
    def is_at_block_end(self) -> bool:
        return any(learner.steps.is_at_block_end for learner in self.advanced)

    @property
    def can_resume(self) -> bool:
        return all(learner.steps.can_resume for learner in self.learners)

    def advance(self) -> bool:
        self.advanced = [learner for learner in self.learners if learner.advance()]
        for learner in self.advanced:
            self.exchange.observe(learner.number, learner.steps.batch, learner.steps.returns[0])
        if self.advanced and self.rounds % self.exchange.every == 0:
            self._exchange()
        self.rounds += 1
        return bool(self.advanced)

    def _exchange(self) -> None:
        self.mail.begin()
        received: dict[int, list[Message]] = {number: [] for number in range(len(self.members))}
        for kind in self.exchange.kinds:
            for number, messages in received.items():
                for message in self.exchange.send(kind, number, messages):
                    others = set(range(len(self.members))) - {message.sender}
                    wrong = f"goes from learner {message.sender} to {message.receiver}, which is no other member"
                    require(
                        (message.receiver in others, f"a {message.kind} {wrong}"),
                        (message.kind == kind, f"a {message.kind} is sent in place of a {kind}"),
                    )
                    self.mail.post(message)
            received = {number: self.mail.take(number, kind) for number in received}
        for number, messages in received.items():
            if self.learners[number].is_done:
                continue
            for given in self.exchange.receive(number, messages):
                frames = self.learners[given.receiver].steps.frames
                member = self.members[given.receiver]
                block = member.curriculum.block_at(frames)
                member.log.append("help", block=block, frames=frames, sender=given.sender, **given.values)
                self.log.append(
                    "help",
                    round=self.rounds,
                    block=block,
                    frames=frames,
                    receiver=given.receiver,
                    sender=given.sender,
                    **given.values,
                )
        for kind in sorted({of for of, _ in self.mail.counts}):
            counts = {what: self.mail.counts[kind, what] for what in (SENT, DELIVERED, DROPPED, DELAYED)}
            self.log.append(
                "exchange",
                round=self.rounds,
                frames=self.frames,
                message=kind,
                **counts,
                bytes=self.mail.bytes[kind],
            )

    def state(self) -> NamedValues:
        return {
            "frames": self.frames,
            "rounds": self.rounds,
            "members": [learner.state() for learner in self.learners],
            "exchange": self.exchange.state_dict(),
            "mail": self.mail.state_dict(),
            "log": self.log.position(),
        }
