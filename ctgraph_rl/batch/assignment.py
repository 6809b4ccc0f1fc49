"""The task of each row, and when it changes to another; `Rows` keeps it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.checks import are_ints, is_int, plain, require
from ctgraph_rl.core import philox
from ctgraph_rl.tasks.protocol import MOST_IDS
from ctgraph_rl.tasks.switch import Switch


def require_num_ids(task_ids: Mapping[Any, int] | None, num_task_ids: int | None) -> int:
    """Return the length of ``task_id``, 0 for none; arguments and errors as in `ctgraph_rl.CTGraphEnv`."""
    if task_ids is None:
        require((num_task_ids is None, f"num_task_ids={num_task_ids!r} needs task_ids"))
        return 0
    ids = plain(list(task_ids.values())) if isinstance(task_ids, Mapping) else [task_ids]
    by_task = isinstance(task_ids, Mapping) and bool(ids) and are_ints(ids, 0, MOST_IDS - 1)
    require((by_task, f"task_ids must give tasks their ids, integers in 0..{MOST_IDS - 1}, got {ids[:5]!r}"))
    needed = max(ids) + 1
    room = needed if num_task_ids is None else num_task_ids
    rule = f"num_task_ids must be an integer in {needed}..{MOST_IDS}, from the largest id + 1, got {room!r}"
    require((is_int(room, needed, MOST_IDS), rule))
    return room


def one_hot_ids(ids: Tensor, length: int) -> Tensor:
    """Return ids, int64 [N], as one-hot uint8 [N, length]; zeros for -1."""
    return (ids.unsqueeze(-1) == torch.arange(length, device=ids.device)).to(torch.uint8)


EpisodePlace = tuple[Tensor, Tensor, Tensor]
"""The rows' seeds, numbers and ticks, which decide their draws."""


class Assignment(NamedTuple):
    """The task of each row, and the choices for its next episodes; tasks are numbers in a pool, int64."""

    task: Tensor  # [N]: the task that the row has
    choice: Tensor  # [N]: place of the task of its next episode among the choices
    episodes: Tensor  # [N]: episodes begun since the choices were made
    choices: Tensor  # [C]: the tasks that rows change between; without a switch the whole pool
    switch: Switch | None  # changes the choice from episode to episode

    @property
    def chosen(self) -> Tensor:
        """The task of each row's choice, [N]."""
        return self.choices.index_select(0, self.choice)

    @property
    def may_change(self) -> bool:
        """Whether rows may change tasks when they start an episode."""
        return self.switch is not None or bool((self.task != self.chosen).any())

    @property
    def in_use(self) -> Tensor:
        """The tasks that rows have or may change to, ascending."""
        return torch.cat([self.task, self.chosen if self.switch is None else self.choices]).unique()

    def restarted(self) -> Assignment:
        """Return the assignment before the first episodes with these choices; rows get their tasks at once."""
        choice = self.choice if self.switch is None else torch.zeros_like(self.choice)
        return self._replace(
            task=self.choices.index_select(0, choice), choice=choice, episodes=torch.zeros_like(choice)
        )

    def begin(self, mask: Tensor, place: EpisodePlace) -> Assignment:
        """Return the assignment when the rows of a mask, bool [N], start an episode."""
        following = self._replace(episodes=self.episodes + mask)
        if self.switch is not None:
            if self.switch.together:
                clock, past = ((n.sum() // len(n) - 1).expand_as(n) for n in (following.episodes, self.episodes))
                seed, row, tick = place
                place = seed[:1], row[:1], tick.amax(0, keepdim=True)
            else:
                clock = following.episodes - 1
                past = self.episodes - 1
            words = philox.draw(*place, philox.STREAM_TASK)
            drawn = self.switch.next_task(self.choice, clock.clamp_min(1), len(self.choices), words)
            following = following._replace(choice=torch.where((clock > past) & (clock > 0), drawn, self.choice))
        return following._replace(task=torch.where(mask, following.chosen, self.task))
