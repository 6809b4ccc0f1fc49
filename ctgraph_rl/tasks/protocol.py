"""The parts of a curriculum: blocks, the protocol of what the learner is given, and the evaluation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import TypeVar

from ctgraph_rl.checks import (
    ReadOnlyValues,
    Rule,
    are_ints,
    at_least_one,
    did_you_mean,
    is_int,
    make_fields_plain,
    one_of,
    require,
    true_or_false,
)
from ctgraph_rl.tasks.kinds.task_like import TaskLike, are_tasks
from ctgraph_rl.tasks.switch import Switch, switch_rule

ProtocolPart = TypeVar("ProtocolPart", "Evaluation", "Protocol")

TASK_IDS = ("hidden", "one_hot", "at_boundaries")
BOUNDARIES = ("announced", "hidden")
EPISODES = ("shown", "hidden")
EVALUATED = ("all", "seen")
MOST_IDS = 2**20
"""One-hot ids are held for every row."""

MOST_ROWS = 2**24
"""Rows of an evaluation; they take 10 GB."""

MOST_TASKS = 10_000
"""Tasks of a curriculum that is no stream; each takes 0.4 ms to make and to write."""


def count_rule(count: int) -> Rule:
    """Return the rule that tasks are few enough to be made at once."""
    fix = "curriculum.goals=random or a list takes fewer, and curriculum=stream makes each when it is needed"
    return count <= MOST_TASKS, f"a curriculum has at most {MOST_TASKS:,} tasks, here are more: {fix}"


@dataclass(frozen=True)
class Block:
    """One stay on one task, or on several.

    Several tasks share the rows equally. With a ``switch`` every row changes between them from episode to episode,
    beginning with the first.

    Args:
        tasks: a task, or several.
        num_frames: frames to learn from; a frame is one row for one step.
        switch: how rows change between the tasks, such as ``Drift(episodes=100)`` of `ctgraph_rl.tasks.switch`.

    Raises:
        ValueError: for no tasks, a budget below 1, or a switch with one task.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> Block(ct_su_b1(), num_frames=1024).num_frames
        1024
    """

    tasks: tuple[TaskLike, ...]
    num_frames: int
    switch: Switch | None = None

    def __post_init__(self) -> None:
        make_fields_plain(self)
        tasks = (self.tasks,) if is_dataclass(self.tasks) else self.tasks
        object.__setattr__(self, "tasks", tasks)
        only_tasks = "a block needs at least one Task and nothing else"
        switches = self.switch is None or (is_dataclass(self.switch) and switch_rule(self.switch)[0])
        require(
            (tasks != (), f"{only_tasks}, got ()"),
            *are_tasks(only_tasks, tasks),
            *at_least_one(num_frames=self.num_frames),
            (switches, f"switch must be a frozen dataclass such as Drift(100), or None, got {self.switch!r}"),
        )
        enough = self.switch is None or len(self.tasks) > 1
        require((enough, "a block with a switch needs at least two tasks, got one; leave the switch out"))

    def rows(self, num_envs: int) -> list[TaskLike]:
        """The first task of each row; several tasks without a switch take turns.

        Raises:
            ValueError: if the tasks cannot share the rows equally.
        """
        if self.switch is not None:
            return [self.tasks[0]] * num_envs
        count = len(self.tasks)
        require((num_envs % count == 0, f"num_envs={num_envs} must be a multiple of the block's {count} tasks"))
        return list(self.tasks) * (num_envs // count)

    def frame_rule(self, num_envs: int, name: str) -> Rule:
        """Return the rule that frames are whole steps of ``num_envs`` rows; ``name`` names the block."""
        below = self.num_frames - self.num_frames % num_envs
        near = f"{below} or {below + num_envs}" if below else f"{num_envs}"
        message = f"num_frames={self.num_frames} of {name} must be a multiple of num_envs={num_envs}; nearest: {near}"
        return self.num_frames % num_envs == 0, message


@dataclass(frozen=True)
class Evaluation:
    """When and how tasks are evaluated. Training's random numbers are unaffected.

    Args:
        num_episodes: episodes per task.
        greedy: take the most likely action; False samples as in training.
        episodes_per_row: episodes that a row plays in turn; a divisor of ``num_episodes``.
        before: evaluate before any training.
        every: evaluate when the run's frames are a multiple of this; 0: not.
        at_block_ends: evaluate at the end of every block.
        tasks: ``all`` of the curriculum, or those ``seen`` up to the present block.
        held_out: further tasks, evaluated each time and never trained.
        adapt_episodes: episodes before a row's ``episodes_per_row``, in which the agent may adapt to its task. Means
            leave them out; the log also has the means of each episode of a row.
        exact: compute the means over all possible episodes and play none, where `ctgraph_rl.learn.exact` can;
            ``num_episodes`` and ``episodes_per_row`` have no effect.

    Raises:
        ValueError: for values out of range.
    """

    num_episodes: int = 100
    greedy: bool = True
    episodes_per_row: int = 1
    before: bool = True
    every: int = 0
    at_block_ends: bool = True
    tasks: str = "all"
    held_out: tuple[TaskLike, ...] = ()
    adapt_episodes: int = field(default=0, metadata={"added": True})
    exact: bool = field(default=False, metadata={"added": True})

    def __post_init__(self) -> None:
        make_fields_plain(self)
        n = self.num_episodes
        per_row = self.episodes_per_row
        held_out = (self.held_out,) if is_dataclass(self.held_out) else self.held_out
        object.__setattr__(self, "held_out", held_out)
        require(
            *at_least_one(num_episodes=n, episodes_per_row=per_row),
            *true_or_false(greedy=self.greedy, before=self.before, at_block_ends=self.at_block_ends, exact=self.exact),
            (is_int(self.every, 0), f"every must be an integer >= 0, got {self.every!r}"),
            (is_int(self.adapt_episodes, 0), f"adapt_episodes must be an integer >= 0, got {self.adapt_episodes!r}"),
            *one_of(EVALUATED, tasks=self.tasks),
            *are_tasks("held_out must be tasks", held_out),
        )
        require(
            (n % per_row == 0, f"num_episodes={n} must be a multiple of episodes_per_row={per_row}"),
            (len(set(self.held_out)) == len(self.held_out), "held_out tasks must differ"),
            (
                not (self.exact and self.adapt_episodes),
                f"exact must be false with adapt_episodes={self.adapt_episodes}",
            ),
        )

    @property
    def row_episodes(self) -> int:
        """All episodes that a row plays."""
        return self.adapt_episodes + self.episodes_per_row

    def every_rule(self, num_envs: int) -> Rule:
        """Return the rule that evaluations fall between steps of ``num_envs`` rows."""
        near = max(self.every - self.every % num_envs, num_envs)
        message = f"evaluation.every={self.every} must be a multiple of num_envs={num_envs}, such as {near}"
        return self.every % num_envs == 0, message

    def check(self, tasks: Iterable[TaskLike]) -> None:
        """Refuse to measure changing goals by first episodes, goals that change while a row adapts, and too many rows.

        Raises:
            ValueError: if tasks cannot be evaluated so.
        """
        tasks = tuple(tasks)
        changes = []
        for task in tasks:
            change = getattr(task, "goal_change", None)
            if change:
                changes.append(change[0])
        changing = self.row_episodes == 1 and bool(changes)
        stays = min(changes, default=self.row_episodes)
        lasts = not self.adapt_episodes or self.row_episodes <= stays
        row = f"adapt_episodes={self.adapt_episodes} + episodes_per_row={self.episodes_per_row}"
        rows = len(tasks) * self.num_episodes // self.episodes_per_row
        many = f"num_episodes={self.num_episodes} of {len(tasks)} tasks are {rows:,} rows at once, the limit is"
        require(
            (not changing, "tasks with goal_change need episodes_per_row > 1: a row's first goal is the task's own"),
            (lasts, f"{row} must be at most {stays}, after which the goal of a row may change; use fewer"),
            (rows <= MOST_ROWS, f"{many} {MOST_ROWS:,}; use fewer, or more episodes_per_row"),
        )


@dataclass(frozen=True)
class Protocol:
    """What the learner is given on tasks and boundaries between blocks.

    Args:
        task_id: ``hidden``; ``one_hot``: every observation comes with a one-hot ``task_id``; ``at_boundaries``: the
            agent is given the task's id when a block or an evaluation begins.
        boundaries: ``announced``: at a block's start all episodes end and the agent is notified; ``hidden``: each row
            changes task when its episode ends, without notice.
        num_task_ids: length of the one-hot id; None: just enough.
        task_ids: the id of each of the curriculum's ``tasks``, all different; None: their positions, from 0.
        guide_frames: frames after each announced boundary over which a guide's share of new episodes falls from 1 to 0.
            The guide waits where it must and decides at random, so that the learner sees rewards early. 0: only the
            learner acts.
        episodes: ``shown``; ``hidden``: the learner observes no end of an episode. Done flags stay False, ``is_init``
            is True once in a life, and recurrent state is kept, also over announced boundaries. The last state of an
            episode takes one more action, which has no effect and reward 0; then the next episode starts.

    Raises:
        ValueError: for values out of range, ids given at boundaries that are hidden, and a guide of hidden episodes.
    """

    task_id: str = "hidden"
    boundaries: str = "announced"
    num_task_ids: int | None = None
    task_ids: tuple[int, ...] | None = None
    guide_frames: int = field(default=0, metadata={"added": True})
    episodes: str = field(default="shown", metadata={"added": True})

    def __post_init__(self) -> None:
        make_fields_plain(self)
        require(
            *one_of(TASK_IDS, task_id=self.task_id),
            *one_of(BOUNDARIES, boundaries=self.boundaries),
            *one_of(EPISODES, episodes=self.episodes),
        )
        ids = self.task_ids
        is_ids = ids is None or (are_ints(ids, 0, MOST_IDS) and bool(ids))
        names_ids = self.task_id != "hidden" or (ids is None and self.num_task_ids is None)
        differ = not isinstance(ids, tuple) or not is_ids or len(set(ids)) == len(ids)
        hidden_gift = self.task_id == "at_boundaries" and not self.announces
        is_length = self.num_task_ids is None or is_int(self.num_task_ids, 1, MOST_IDS)
        require(
            (is_int(self.guide_frames, 0), f"guide_frames must be an integer >= 0, got {self.guide_frames!r}"),
            (
                not (self.hides_episodes and self.guide_frames),
                f"guide_frames={self.guide_frames} guides whole episodes, which episodes=hidden hides: set it to 0",
            ),
            (is_length, f"num_task_ids must be an integer in 1..{MOST_IDS}, got {self.num_task_ids!r}"),
            (is_ids, f"task_ids must be integers in 0..{MOST_IDS}, one for each task, got {ids!r}"),
            (differ, f"task_ids must differ from each other, got {ids!r}"),
            (names_ids, "num_task_ids and task_ids say nothing where task_id is hidden: leave them out"),
            (not hidden_gift, "task_id cannot be given at_boundaries that are hidden; use one_hot, or announced ones"),
        )

    @property
    def announces(self) -> bool:
        """Whether the agent is notified of boundaries."""
        return self.boundaries == "announced"

    @property
    def hides_episodes(self) -> bool:
        """Whether the learner observes no end of an episode."""
        return self.episodes == "hidden"

    def ids(self, num_tasks: int) -> tuple[int, ...]:
        """The id of each of ``num_tasks`` tasks.

        Raises:
            ValueError: if ``task_ids`` are not that many, or ``num_task_ids`` has no room for them.
        """
        ids = tuple(range(num_tasks)) if self.task_ids is None else self.task_ids
        room = max(ids) + 1 if self.num_task_ids is None else self.num_task_ids
        require(
            (len(ids) == num_tasks, f"task_ids must be one for each of {num_tasks} tasks, got {len(ids)}"),
            (max(ids) < room, f"num_task_ids={room} is too few for task id {max(ids)}: needs at least {max(ids) + 1}"),
        )
        return ids

    def length(self, num_tasks: int) -> int:
        """The length of a one-hot id."""
        return max(self.ids(num_tasks)) + 1 if self.num_task_ids is None else self.num_task_ids


def changed(name: str, part: ProtocolPart, changes: ReadOnlyValues) -> ProtocolPart:
    """An evaluation or a protocol with other values; ``name`` is the part's, for errors.

    Raises:
        ValueError: for an unknown field, with the likely one, and for values out of range.
    """
    known = [each.name for each in fields(part)]
    require(*((key in known, f"{name} has no {key}: {did_you_mean(key, known)}") for key in changes))
    return replace(part, **changes)
