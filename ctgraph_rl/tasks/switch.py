"""Changes of the task within a block: by the episode, at random times, or by drift, without any boundary.

A switch decides which of a block's tasks an episode has. Its clock counts the row's completed episodes in the block or,
for rows ``together``, the rows' mean, rounded down. Changes happen where an episode starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ctgraph_rl.checks import Rule, is_int, is_real, make_fields_plain, require, true_or_false
from ctgraph_rl.core.philox import randint

MOST_EPISODES = 2**31
"""Drifts draw 32-bit words."""


class Switch(Protocol):
    """A rule for the next task; a user's own is a frozen dataclass with these members."""

    @property
    def together(self) -> bool:
        """All rows share one clock and one draw."""
        ...

    def next_task(self, task: Tensor, clock: Tensor, num_tasks: int, words: tuple[Tensor, ...]) -> Tensor:
        """The tasks of the episodes that start now, as positions in the block; tensors of one shape.

        Args:
            task: int64, the last episode's task.
            clock: int64, episodes completed, at least 1.
            num_tasks: tasks of the block.
            words: at least two random words in [0, 2**32) each.
        """
        ...


class _ForEpisodes:
    episodes: int
    together: bool

    def __post_init__(self) -> None:
        make_fields_plain(self)
        holds = is_int(self.episodes, 1, MOST_EPISODES)
        rule = holds, f"episodes must be an integer in 1..2**31, got {self.episodes!r}"
        require(rule, *true_or_false(together=self.together))


@dataclass(frozen=True)
class ByEpisode(_ForEpisodes):
    """The tasks take turns.

    Args:
        episodes: episodes of a turn.
        together: all rows change at once.
    """

    episodes: int = 1
    together: bool = False

    def next_task(self, task: Tensor, clock: Tensor, num_tasks: int, words: tuple[Tensor, ...]) -> Tensor:
        """Return the task whose turn it is."""
        return clock // self.episodes % num_tasks


@dataclass(frozen=True)
class AtRandom:
    """At each start of an episode the task changes with a probability, to any other of the block.

    Args:
        prob: in (0, 1]; a task lasts 1 / ``prob`` episodes on average. Below 2**-32 it never changes.
        together: all rows change at once.
    """

    prob: float
    together: bool = False

    def __post_init__(self) -> None:
        make_fields_plain(self)
        holds = is_real(self.prob, 0, 1) and self.prob > 0
        require((holds, f"prob must be in (0, 1], got {self.prob!r}"), *true_or_false(together=self.together))
        object.__setattr__(self, "prob", float(self.prob))

    def next_task(self, task: Tensor, clock: Tensor, num_tasks: int, words: tuple[Tensor, ...]) -> Tensor:
        """Return the same task, or by chance another."""
        other = (task + 1 + randint(words[1], num_tasks - 1)) % num_tasks
        return torch.where(words[0] < int(self.prob * 2**32), other, task)


@dataclass(frozen=True)
class Drift(_ForEpisodes):
    """The probability of the next task rises linearly: from 0 at the start to 1 after ``episodes`` episodes.

    The drift goes from each task to the next, and stays at the last.

    Args:
        episodes: episodes from one task to the next.
        together: all rows draw at once.
    """

    episodes: int
    together: bool = False

    def next_task(self, task: Tensor, clock: Tensor, num_tasks: int, words: tuple[Tensor, ...]) -> Tensor:
        """Return the clock's task or, by chance, the next."""
        is_next = randint(words[0], self.episodes) < clock % self.episodes
        return (clock // self.episodes + is_next).clamp_max(num_tasks - 1)


SWITCHES = (ByEpisode, AtRandom, Drift)
"""Every switch of this package."""


def switch_rule(switch: object) -> Rule:
    """The rule that a value is a switch."""
    holds = callable(getattr(switch, "next_task", None)) and not isinstance(switch, type)
    return holds, f"switch must be one such as Drift(100), got {switch!r}"
