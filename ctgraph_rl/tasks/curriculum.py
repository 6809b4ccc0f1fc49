"""Block and Curriculum: a frozen sequence of tasks with frame budgets, what the learner is told, how it is measured."""

from __future__ import annotations

import hashlib
import json
from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from itertools import accumulate
from os import PathLike
from typing import Any

from ctgraph_rl.checks import as_tuple, at_least_one, is_int, require
from ctgraph_rl.tasks.switch import Switch, switch_rule
from ctgraph_rl.tasks.task import Task

FINGERPRINT_SCHEMA = 1
"""Raised when the way a fingerprint is computed changes."""


TASK_IDS = ("hidden", "one_hot", "at_boundaries")
BOUNDARIES = ("announced", "hidden")
EVALUATED = ("all", "seen")
MOST_IDS = 2**20
"""One-hot ids are held for every row."""

MOST_ROWS = 2**24
"""Of an evaluation; they take 10 GB."""


@dataclass(frozen=True)
class Block:
    """One stay on one task, or on several.

    Several tasks share the rows equally, all at once, or with a ``switch`` every row changes between them from episode
    to episode, beginning with the first.

    Args:
        tasks: a task, or several.
        num_frames: frames to learn from; a frame is one row for one step.
        switch: how rows change between the tasks, such as ``Drift(episodes=100)`` of `ctgraph_rl.tasks.switch`; None:
            they do not.

    Raises:
        ValueError: for no tasks, a budget below 1, or a switch with one task.
    """

    tasks: tuple[Task, ...]
    num_frames: int
    switch: Switch | None = None

    def __post_init__(self) -> None:
        tasks = (self.tasks,) if isinstance(self.tasks, Task) else as_tuple(self.tasks)
        object.__setattr__(self, "tasks", tasks)
        only_tasks = isinstance(tasks, tuple) and bool(tasks) and all(isinstance(task, Task) for task in tasks)
        switches = is_dataclass(self.switch) and switch_rule(self.switch)[0]
        require(
            (only_tasks, f"a block needs at least one Task and nothing else, got {tasks!r}"),
            (is_int(self.num_frames, 1), f"num_frames must be an integer >= 1, got {self.num_frames!r}"),
            (
                self.switch is None or switches,
                f"switch must be a frozen dataclass such as Drift(100), or None, got {self.switch!r}",
            ),
        )
        enough = self.switch is None or len(self.tasks) > 1
        require((enough, "a block with a switch needs at least two tasks, got one; leave the switch out"))

    def rows(self, num_envs: int) -> list[Task]:
        """The task that each of ``num_envs`` rows begins with; several tasks without a switch take turns.

        Raises:
            ValueError: if the tasks cannot share the rows equally.
        """
        if self.switch is not None:
            return [self.tasks[0]] * num_envs
        count = len(self.tasks)
        require((num_envs % count == 0, f"num_envs={num_envs} must be a multiple of the block's {count} tasks"))
        return list(self.tasks) * (num_envs // count)

    def frame_rule(self, num_envs: int, name: str) -> tuple[bool, str]:
        """What must hold for ``num_envs`` rows: whole steps only. ``name`` says which block it is."""
        below = self.num_frames - self.num_frames % num_envs
        near = f"{below} or {below + num_envs}" if below else f"{num_envs}"
        message = f"num_frames={self.num_frames} of {name} must be a multiple of num_envs={num_envs}; nearest: {near}"
        return self.num_frames % num_envs == 0, message


@dataclass(frozen=True)
class Evaluation:
    """When and how tasks are evaluated. It never disturbs what is random in training.

    Args:
        num_episodes: episodes per task.
        greedy: take the most likely action; False samples as in training.
        episodes_per_row: episodes that a row plays one after the other; a divisor of ``num_episodes``.
        before: evaluate before any training.
        every: evaluate within blocks, whenever the run's frames are a multiple of this; 0: not.
        at_block_ends: evaluate at the end of every block.
        tasks: ``all`` tasks of the curriculum, or those ``seen`` so far, the present block's included.
        held_out: further tasks that are evaluated each time and never trained.

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
    held_out: tuple[Task, ...] = ()

    def __post_init__(self) -> None:
        n, per_row = self.num_episodes, self.episodes_per_row
        held_out = (self.held_out,) if isinstance(self.held_out, Task) else as_tuple(self.held_out)
        object.__setattr__(self, "held_out", held_out)
        only_tasks = isinstance(held_out, tuple) and all(isinstance(task, Task) for task in held_out)
        flags = {"greedy": self.greedy, "before": self.before, "at_block_ends": self.at_block_ends}
        require(
            *at_least_one(num_episodes=n, episodes_per_row=per_row),
            *((isinstance(flag, bool), f"{name} must be true or false, got {flag!r}") for name, flag in flags.items()),
            (is_int(self.every, 0), f"every must be an integer >= 0, got {self.every!r}"),
            _one_of("tasks", self.tasks, EVALUATED),
            (only_tasks, f"held_out must be tasks, got {held_out!r}"),
        )
        require(
            (n % per_row == 0, f"num_episodes={n} must be a multiple of episodes_per_row={per_row}"),
            (len(set(self.held_out)) == len(self.held_out), "held_out tasks must differ"),
        )

    def every_rule(self, num_envs: int) -> tuple[bool, str]:
        """What must hold for ``num_envs`` rows: evaluations fall between steps of all rows."""
        near = max(self.every - self.every % num_envs, num_envs)
        message = f"evaluation.every={self.every} must be a multiple of num_envs={num_envs}, such as {near}"
        return self.every % num_envs == 0, message

    def check(self, tasks: Iterable[Task]) -> None:
        """Refuse to measure changing goals by first episodes, which all have the first goal.

        Raises:
            ValueError: for one episode a row and a task with ``goal_change``.
        """
        tasks = tuple(tasks)
        changing = self.episodes_per_row == 1 and any(task.goal_change for task in tasks)
        rows = len(tasks) * self.num_episodes // self.episodes_per_row
        many = f"num_episodes={self.num_episodes} of {len(tasks)} tasks are {rows:,} rows at once, the limit is"
        require(
            (not changing, "tasks with goal_change need episodes_per_row > 1: a row's first goal is the task's own"),
            (rows <= MOST_ROWS, f"{many} {MOST_ROWS:,}; use fewer, or more episodes_per_row"),
        )


@dataclass(frozen=True)
class Protocol:
    """What the learner is told.

    Args:
        task_id: ``hidden``; ``one_hot``: every observation comes with a one-hot ``task_id``; ``at_boundaries``: the
            agent is given the task's id where a block begins and where it is evaluated.
        boundaries: ``announced``: at the start of a block all episodes end and the agent is told; ``hidden``: each row
            goes over to the next block's task when its episode ends, and nobody is told.
        num_task_ids: length of the one-hot id; None: just enough.
        task_ids: the id of each of the curriculum's ``tasks``; None: their positions, from 0.

    Raises:
        ValueError: for values out of range, and ids given at boundaries that are hidden.
    """

    task_id: str = "hidden"
    boundaries: str = "announced"
    num_task_ids: int | None = None
    task_ids: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        ids = as_tuple(self.task_ids)
        object.__setattr__(self, "task_ids", ids)
        is_ids = ids is None or (isinstance(ids, tuple) and len(ids) > 0 and all(is_int(i, 0, MOST_IDS) for i in ids))
        names_ids = self.task_id != "hidden" or (ids is None and self.num_task_ids is None)
        hidden_gift = self.task_id == "at_boundaries" and self.boundaries == "hidden"
        require(
            _one_of("task_id", self.task_id, TASK_IDS),
            _one_of("boundaries", self.boundaries, BOUNDARIES),
            (
                self.num_task_ids is None or is_int(self.num_task_ids, 1, MOST_IDS),
                f"num_task_ids must be an integer in 1..{MOST_IDS}, got {self.num_task_ids!r}",
            ),
            (is_ids, f"task_ids must be integers in 0..{MOST_IDS}, one for each task, got {ids!r}"),
            (names_ids, "num_task_ids and task_ids say nothing where task_id is hidden: leave them out"),
            (not hidden_gift, "task_id cannot be given at_boundaries that are hidden; use one_hot, or announced ones"),
        )

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


@dataclass(frozen=True)
class Curriculum:
    """A named, citable sequence of blocks.

    Args:
        name: name that a paper cites.
        version: raised when the content changes.
        source: where the sequence comes from.
        blocks: the blocks in order.
        evaluation: how performance is measured.
        protocol: what the learner is told.

    Raises:
        ValueError: for no blocks, an empty name, tasks that one environment cannot hold together, and a protocol or an
            evaluation that does not fit the tasks.
    """

    name: str
    version: int
    source: str
    blocks: tuple[Block, ...]
    evaluation: Evaluation = field(default_factory=Evaluation)
    protocol: Protocol = field(default_factory=Protocol)

    def __post_init__(self) -> None:
        object.__setattr__(self, "blocks", as_tuple(self.blocks))
        only_blocks = (
            isinstance(self.blocks, tuple)
            and bool(self.blocks)
            and all(isinstance(block, Block) for block in self.blocks)
        )
        require(
            (isinstance(self.name, str) and bool(self.name), f"a curriculum needs a name, got {self.name!r}"),
            (is_int(self.version, 1), f"version must be an integer >= 1, got {self.version!r}"),
            (only_blocks, f"a curriculum needs at least one Block and nothing else, got {self.blocks!r}"),
            (isinstance(self.evaluation, Evaluation), f"evaluation must be an Evaluation, got {self.evaluation!r}"),
            (isinstance(self.protocol, Protocol), f"protocol must be a Protocol, got {self.protocol!r}"),
        )
        self.protocol.ids(len(self.tasks))
        require(*self._task_rules())

    def _task_rules(self) -> list[tuple[bool, str]]:
        everything = (*self.tasks, *self.evaluation.held_out)
        shapes = list(dict.fromkeys(task.images.shape for task in everything))
        one_shape = len(shapes) == 1 or all(len(shape) == 1 for shape in shapes)
        trained_too = [task for task in self.evaluation.held_out if task in self.tasks]
        one_each = self.protocol.task_id != "at_boundaries" or all(len(set(block.tasks)) == 1 for block in self.blocks)
        return [
            (one_shape, f"all tasks of a curriculum must show observations of one shape, got {shapes}"),
            (not trained_too, f"held_out tasks must not be trained, got {trained_too[:3]}"),
            (one_each, "task ids given at_boundaries need blocks of one task each"),
            (self._ever_evaluates(), "nothing would be evaluated: set before, every or at_block_ends"),
        ]

    def _ever_evaluates(self) -> bool:
        how = self.evaluation
        at_once = how.before and (how.tasks == "all" or bool(how.held_out))
        return how.at_block_ends or at_once or 0 < how.every <= self.num_frames

    @property
    def tasks(self) -> tuple[Task, ...]:
        """The different tasks, in the order of first appearance."""
        return tuple(dict.fromkeys(task for block in self.blocks for task in block.tasks))

    @property
    def num_frames(self) -> int:
        """Frames of all blocks."""
        return sum(block.num_frames for block in self.blocks)

    @property
    def ends(self) -> tuple[int, ...]:
        """Frames of the run at the end of each block."""
        return tuple(accumulate(block.num_frames for block in self.blocks))

    def block_at(self, frames: int) -> int:
        """The number of the block, from 1, that the last of the run's first ``frames`` frames is of; 0 for none."""
        return bisect_left(self.ends, frames) + 1 if frames else 0

    def moment(self, frames: int) -> str | None:
        """Which evaluation is due after ``frames`` frames: ``before``, ``during`` or ``after`` a block, or None."""
        how = self.evaluation
        within = how.every > 0 and frames % how.every == 0
        if frames == 0:
            return "before" if how.before else None
        if frames in self.ends:
            return "after" if how.at_block_ends or within else None
        return "during" if within else None

    @property
    def segments(self) -> tuple[tuple[Block, ...], ...]:
        """The blocks between two announced boundaries: each alone, or all of them where boundaries are hidden."""
        announced = self.protocol.boundaries == "announced"
        return tuple((block,) for block in self.blocks) if announced else (self.blocks,)

    stretches = segments
    """The former name of `segments`."""

    @property
    def task_ids(self) -> dict[Task, int]:
        """The id of each of ``tasks``."""
        return dict(zip(self.tasks, self.protocol.ids(len(self.tasks)), strict=True))

    @property
    def labels(self) -> tuple[str, ...]:
        """A different short name for each of ``tasks``: the goal, and what else differs between them."""
        return self.evaluated_labels[: len(self.tasks)]

    @property
    def evaluated_labels(self) -> tuple[str, ...]:
        """`labels`, and in the same manner those of the held-out tasks."""
        parts = [task.label_parts for task in (*self.tasks, *self.evaluation.held_out)]
        differing = [name for name in parts[0] if name == "goal" or len({part[name] for part in parts}) > 1]
        labels = ["-".join(part[name] for name in differing) for part in parts]
        counts = [labels[:i].count(label) for i, label in enumerate(labels)]
        return tuple(f"{label}#{count + 1}" if count else label for label, count in zip(labels, counts, strict=True))

    @property
    def trained(self) -> tuple[tuple[int, ...], ...]:
        """For each block, the positions in ``tasks`` of the tasks that it trains."""
        position = {task: number for number, task in enumerate(self.tasks)}
        return tuple(tuple(position[task] for task in dict.fromkeys(block.tasks)) for block in self.blocks)

    def to_json(self, path: str | PathLike[str] | None = None) -> dict[str, Any]:
        """This curriculum as JSON with every field written out; see `ctgraph_rl.tasks.curriculum_json`.

        Args:
            path: where to write the file; None: nowhere.

        Raises:
            ValueError: for a file that exists, and rewards, image sets or switches that are not of this package.
        """
        from ctgraph_rl.tasks.curriculum_json import write_curriculum

        return write_curriculum(self, path)

    @classmethod
    def from_json(cls, path_or_dict: str | PathLike[str] | Mapping[str, Any]) -> Curriculum:
        """The curriculum that `to_json` wrote. Only types of this package are made.

        Args:
            path_or_dict: the file, or its content.

        Raises:
            ValueError: for a file that cannot be read or is too large, another fingerprint than the file states, keys
                that are missing or unknown, and values out of range; names the file and the key.
        """
        from ctgraph_rl.tasks.curriculum_json import read_curriculum

        return read_curriculum(path_or_dict)

    @property
    def fingerprint(self) -> str:
        """16 hex digits that depend on everything but name and source, equal on every machine."""
        content = _canonical(replace(self, name="-", source="-"))
        text = json.dumps([FINGERPRINT_SCHEMA, content], sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _one_of(name: str, value: object, choices: tuple[str, ...]) -> tuple[bool, str]:
    return value in choices, f"{name} must be one of {', '.join(choices)}, got {value!r}"


def _canonical(value: Any) -> Any:
    """A value as plain JSON: dataclasses by name with the compared fields that differ from their defaults."""
    if is_dataclass(value) and not isinstance(value, type):
        compared = [f for f in fields(value) if f.compare]
        given = {f.name: getattr(value, f.name) for f in compared if getattr(value, f.name) != _default(f)}
        return {"type": _type_name(type(value)), **{name: _canonical(item) for name, item in given.items()}}
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [_canonical(item) for item in value]
    return value


def _type_name(kind: type) -> str:
    """Our own types by name alone, so that they may move between modules; a user's with the module."""
    return kind.__qualname__ if kind.__module__.startswith("ctgraph_rl.") else f"{kind.__module__}.{kind.__qualname__}"


def _default(field_: Any) -> Any:
    return field_.default if field_.default_factory is MISSING else field_.default_factory()
