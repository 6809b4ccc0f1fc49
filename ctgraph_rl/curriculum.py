"""Block and Curriculum: a frozen sequence of tasks with frame budgets, and nothing more."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from typing import Any

from ctgraph_rl.checks import as_tuple, at_least_one, is_int, require
from ctgraph_rl.task import Task

FINGERPRINT_SCHEMA = 1
"""Raised when the way a fingerprint is computed changes."""


@dataclass(frozen=True)
class Block:
    """One stay on one task, or on several at once that share the rows equally.

    Args:
        tasks: a task, or several.
        num_frames: frames to learn from; a frame is one row for one step.

    Raises:
        ValueError: for no tasks or a budget below 1.
    """

    tasks: tuple[Task, ...]
    num_frames: int

    def __post_init__(self) -> None:
        tasks = (self.tasks,) if isinstance(self.tasks, Task) else as_tuple(self.tasks)
        object.__setattr__(self, "tasks", tasks)
        only_tasks = isinstance(tasks, tuple) and bool(tasks) and all(isinstance(task, Task) for task in tasks)
        require(
            (only_tasks, f"a block needs at least one Task and nothing else, got {tasks!r}"),
            (is_int(self.num_frames, 1), f"num_frames must be an integer >= 1, got {self.num_frames!r}"),
        )

    def rows(self, num_envs: int) -> list[Task]:
        """The task of each of ``num_envs`` rows; several tasks take turns.

        Raises:
            ValueError: if the tasks cannot share the rows equally.
        """
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
    """How all tasks are evaluated, before training and after every block.

    Args:
        num_episodes: episodes per task.
        greedy: take the most likely action; False samples as in training.
        episodes_per_row: episodes that a row plays one after the other; a divisor of ``num_episodes``.
    """

    num_episodes: int = 100
    greedy: bool = True
    episodes_per_row: int = 1

    def __post_init__(self) -> None:
        n, per_row = self.num_episodes, self.episodes_per_row
        require(
            *at_least_one(num_episodes=n, episodes_per_row=per_row),
            (isinstance(self.greedy, bool), f"greedy must be true or false, got {self.greedy!r}"),
        )
        require((n % per_row == 0, f"num_episodes={n} must be a multiple of episodes_per_row={per_row}"))

    def check(self, tasks: Iterable[Task]) -> None:
        """Refuse to measure changing goals by first episodes, which all have the first goal.

        Raises:
            ValueError: for one episode a row and a task with ``goal_change``.
        """
        changing = self.episodes_per_row == 1 and any(task.goal_change for task in tasks)
        require(
            (not changing, "tasks with goal_change need episodes_per_row > 1: a row's first goal is the task's own")
        )


@dataclass(frozen=True)
class Curriculum:
    """A named, citable sequence of blocks.

    Boundaries between blocks are announced: all episodes end, the agent is told, and the next observation starts an
    episode. Task identities are not given.

    Args:
        name: name that a paper cites.
        version: raised when the content changes.
        source: where the sequence comes from.
        blocks: the blocks in order.
        evaluation: how performance is measured.

    Raises:
        ValueError: for no blocks or an empty name.
    """

    name: str
    version: int
    source: str
    blocks: tuple[Block, ...]
    evaluation: Evaluation = field(default_factory=Evaluation)

    def __post_init__(self) -> None:
        object.__setattr__(self, "blocks", as_tuple(self.blocks))
        only_blocks = (
            isinstance(self.blocks, tuple)
            and bool(self.blocks)
            and all(isinstance(block, Block) for block in self.blocks)
        )
        require(
            (bool(self.name), "a curriculum needs a name, got an empty one"),
            (is_int(self.version, 1), f"version must be an integer >= 1, got {self.version!r}"),
            (only_blocks, f"a curriculum needs at least one Block and nothing else, got {self.blocks!r}"),
        )

    @property
    def tasks(self) -> tuple[Task, ...]:
        """The different tasks, in the order of first appearance."""
        return tuple(dict.fromkeys(task for block in self.blocks for task in block.tasks))

    @property
    def num_frames(self) -> int:
        """Frames of all blocks."""
        return sum(block.num_frames for block in self.blocks)

    @property
    def labels(self) -> tuple[str, ...]:
        """A different short name for each of ``tasks``: the goal, and what else differs between them."""
        parts = [task.label_parts for task in self.tasks]
        differing = [name for name in parts[0] if name == "goal" or len({part[name] for part in parts}) > 1]
        labels = ["-".join(part[name] for name in differing) for part in parts]
        counts = [labels[:i].count(label) for i, label in enumerate(labels)]
        return tuple(f"{label}#{count + 1}" if count else label for label, count in zip(labels, counts, strict=True))

    @property
    def trained(self) -> tuple[tuple[int, ...], ...]:
        """For each block, the positions in ``tasks`` of the tasks that it trains."""
        return tuple(tuple(self.tasks.index(task) for task in dict.fromkeys(block.tasks)) for block in self.blocks)

    @property
    def fingerprint(self) -> str:
        """16 hex digits that depend on everything but name and source, equal on every machine."""
        content = _canonical(replace(self, name="-", source="-"))
        text = json.dumps([FINGERPRINT_SCHEMA, content], sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


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
