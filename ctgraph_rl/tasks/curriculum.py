"""Curriculum: a frozen sequence of blocks with a protocol, an evaluation and a fingerprint."""

from __future__ import annotations

import hashlib
import json
import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import accumulate
from os import PathLike
from typing import Any

from ctgraph_rl.checks import (
    LARGEST_INT,
    NamedValues,
    ReadOnlyValues,
    as_path,
    is_int,
    make_fields_plain,
    require,
)
from ctgraph_rl.tasks.curriculum_json import read_curriculum, type_name, write_curriculum
from ctgraph_rl.tasks.exactness import task_rules
from ctgraph_rl.tasks.kinds.frozen_arguments import FrozenArguments
from ctgraph_rl.tasks.kinds.task_like import TaskLike, are_tasks
from ctgraph_rl.tasks.life import DrawnTasks, Lazy, Life
from ctgraph_rl.tasks.protocol import Block, Evaluation, Protocol, count_rule
from ctgraph_rl.tasks.task import Task, are_graphs

FINGERPRINT_SCHEMA = 1


@dataclass(frozen=True)
class Curriculum:
    """A named, citable sequence of blocks.

    Args:
        name: name that a paper cites.
        version: rises when the content changes.
        source: where the sequence comes from.

    Raises:
        ValueError: for no blocks, an empty name, tasks that one environment cannot hold, or an unfit protocol or
            evaluation.

    Example:
        >>> from ctgraph_rl import Block, Evaluation
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> blocks = tuple(Block(ct_su_b1(goal=goal), num_frames=10_000) for goal in ("1.1", "2.2"))
        >>> mine = Curriculum("mine", 1, "this page", blocks, Evaluation(num_episodes=10))
        >>> mine.num_frames, mine.labels
        (20000, ('goal1.1', 'goal2.2'))
    """

    name: str
    version: int
    source: str
    blocks: tuple[Block, ...]
    evaluation: Evaluation = field(default_factory=Evaluation)
    protocol: Protocol = field(default_factory=Protocol)

    def __post_init__(self) -> None:
        make_fields_plain(self)
        only_blocks = isinstance(self.blocks, tuple) and bool(self.blocks)
        only_blocks = only_blocks and all(isinstance(each, Block) for each in self.blocks)
        self._check(only_blocks)
        require(count_rule(len(self.tasks) + len(self.evaluation.held_out)))

    def _check(self, only_blocks: bool) -> None:
        require(
            (isinstance(self.name, str) and bool(self.name), f"a curriculum needs a name, got {self.name!r}"),
            (is_int(self.version, 1), f"version must be an integer >= 1, got {self.version!r}"),
            (isinstance(self.source, str), f"source must be a text, got {self.source!r:.80}"),
            (only_blocks, f"a curriculum needs at least one Block and nothing else, got {self.blocks!r}"),
            (isinstance(self.evaluation, Evaluation), f"evaluation must be an Evaluation, got {self.evaluation!r}"),
            (isinstance(self.protocol, Protocol), f"protocol must be a Protocol, got {self.protocol!r}"),
        )
        self.protocol.ids(len(self.tasks))
        everything = (*self.examples, *self.evaluation.held_out)
        require(*are_tasks("tasks", everything))
        shapes = list(dict.fromkeys(task.observation_shape for task in everything))
        actions = list(dict.fromkeys(task.num_actions for task in everything))
        pads = are_graphs(everything)
        one_shape = len(shapes) == 1 or (pads and max(map(len, shapes)) == 1)
        trained = set(self.examples)
        trained_too = [task for task in self.evaluation.held_out if task in trained]
        one_each = self.protocol.task_id != "at_boundaries" or not self.blocks_of_several
        how = self.evaluation
        at_once = how.before and (how.tasks == "all" or bool(how.held_out))
        evaluates = how.at_block_ends or at_once or 0 < how.every <= self.num_frames
        require(
            (one_shape, f"all tasks of a curriculum must show observations of one shape, got {shapes}"),
            (pads or len(actions) == 1, f"all tasks of a curriculum must have as many actions, got {actions}"),
            (not trained_too, f"held_out tasks must not be trained, got {trained_too[:3]}"),
            (self.num_frames <= LARGEST_INT, f"the blocks have {self.num_frames:,} frames together, at most 2**63 - 1"),
            (one_each, "task ids given at_boundaries need blocks of one task each"),
            (evaluates, "nothing would be evaluated: set before, every or at_block_ends"),
        )
        if how.exact:
            for task in everything:
                require(*task_rules(task))

    def __repr__(self) -> str:
        sizes = f"tasks: {len(self.tasks):,}, blocks: {len(self.blocks):,}, frames: {self.num_frames:,}"
        return f"<Curriculum {self.name!r}, version {self.version}, {sizes}>"

    @cached_property
    def tasks(self) -> Sequence[TaskLike]:
        """The different tasks, by first appearance."""
        return tuple(dict.fromkeys(task for block in self.blocks for task in block.tasks))

    @property
    def examples(self) -> tuple[TaskLike, ...]:
        """Tasks that have all graphs, rewards and kinds of images: ``tasks``."""
        return tuple(self.tasks)

    @property
    def example_blocks(self) -> Sequence[Block]:
        """Blocks that have all lengths, switches and numbers of tasks: ``blocks``."""
        return self.blocks

    @property
    def blocks_of_several(self) -> list[int]:
        """The numbers, from 1, of the blocks with several tasks."""
        return [number for number, block in enumerate(self.example_blocks, 1) if len(set(block.tasks)) > 1]

    def for_seed(self, seed: int) -> Curriculum:
        """Return the curriculum of a run with this seed: the same for all."""
        return self

    def evaluated(self, frames: int) -> dict[TaskLike, tuple[int, str]]:
        """Return the tasks to evaluate after ``frames`` frames, with their numbers, from 1, and labels."""
        everything = *self.tasks, *self.evaluation.held_out
        named = dict(zip(everything, enumerate(self.evaluated_labels, 1), strict=True))
        if self.evaluation.tasks == "all":
            return named
        seen = {i + 1 for block in self.trained[: self.block_at(frames)] for i in block}
        return {task: name for task, name in named.items() if name[0] in seen or name[0] > len(self.tasks)}

    @cached_property
    def num_frames(self) -> int:
        """Frames of all blocks."""
        return self.ends[-1]

    @cached_property
    def ends(self) -> Sequence[int]:
        """Frames of the run at each block's end."""
        return tuple(accumulate(block.num_frames for block in self.blocks))

    def frames_of(self, share: float) -> int:
        """Return a share of the frames, rounded up."""
        return math.ceil(Fraction(str(share)) * self.num_frames)

    def block_at(self, frames: int) -> int:
        """The block, from 1, of the run's frame number ``frames``; 0 for none."""
        return bisect_left(self.ends, frames) + 1 if frames else 0

    def is_end(self, frames: int) -> bool:
        """Return whether a block ends after ``frames`` frames."""
        block = self.block_at(frames)
        return block > 0 and block <= len(self.ends) and self.ends[block - 1] == frames

    def moment(self, frames: int) -> str | None:
        """Return the evaluation due after ``frames`` frames: ``before``, ``during`` or ``after`` a block, or None."""
        how = self.evaluation
        within = how.every > 0 and frames % how.every == 0
        if frames == 0:
            return "before" if how.before else None
        if self.is_end(frames):
            return "after" if how.at_block_ends or within else None
        return "during" if within else None

    @property
    def moments(self) -> tuple[int, ...]:
        """All frames after which an evaluation is due."""
        every = self.evaluation.every
        within = range(every, self.num_frames + 1, every) if every else ()
        return tuple(filter(self.moment, sorted({0, *self.ends, *within})))

    @cached_property
    def task_ids(self) -> Mapping[TaskLike, int]:
        """The id of each of ``tasks``."""
        return dict(zip(self.tasks, self.protocol.ids(len(self.tasks)), strict=True))

    @property
    def labels(self) -> Sequence[str]:
        """A short name for each of ``tasks``: the first of its parts, such as the goal, and what else differs."""
        return self.evaluated_labels[: len(self.tasks)]

    @property
    def example_labels(self) -> Sequence[str]:
        """A short name for each of ``examples``."""
        return self.labels

    @cached_property
    def evaluated_labels(self) -> Sequence[str]:
        """`labels`, then those of the held-out tasks."""
        return self._labels_of((*self.tasks, *self.evaluation.held_out))

    def _labels_of(self, tasks: Sequence[TaskLike]) -> tuple[str, ...]:
        parts = [task.label_parts for task in tasks]
        first = next(iter(parts[0]))
        differing = []
        for name in parts[0]:
            values = {part.get(name) for part in parts}
            if name == first or len(values) > 1:
                differing.append(name)
        counts: Counter[str] = Counter()
        labels = []
        for part in parts:
            label = "-".join(part.get(name, "") for name in differing)
            counts[label] += 1
            labels.append(f"{label}#{counts[label]}" if counts[label] > 1 else label)
        return tuple(labels)

    @cached_property
    def trained(self) -> Sequence[tuple[int, ...]]:
        """For each block, the positions of its tasks in ``tasks``."""
        position = {task: number for number, task in enumerate(self.tasks)}
        trained = []
        for block in self.blocks:
            trained.append(tuple(position[task] for task in dict.fromkeys(block.tasks)))
        return tuple(trained)

    def to_json(self, path: str | PathLike[str] | None = None) -> NamedValues:
        """This curriculum as JSON, with every field written out, and written to ``path`` if given.

        Raises:
            ValueError: for a file that exists, and rewards, image sets or switches that are not of this package.
        """
        return write_curriculum(self, None if path is None else as_path("path", path))

    @classmethod
    def from_json(cls, path_or_dict: str | PathLike[str] | ReadOnlyValues) -> Curriculum:
        """The curriculum that `to_json` wrote, from a file or its content. Only types of this package are made.

        Raises:
            ValueError: names file and key: an unreadable or too large file, another fingerprint than stated, missing or
                unknown keys, or values out of range.
        """
        return read_curriculum(path_or_dict, Curriculum, Stream)

    @cached_property
    def fingerprint(self) -> str:
        """16 hex digits of all but name and source, equal on every machine."""
        content = {**_canonical(self), "name": "-", "source": "-"}
        text = json.dumps([FINGERPRINT_SCHEMA, content], sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


LAGS = (1, 10, 100)
"""Blocks after which the tasks of a stream are evaluated again."""


@dataclass(frozen=True, repr=False)
class Stream(Curriculum):
    """A curriculum whose tasks are drawn when they are needed, up to 100,000.

    Block n trains task n or, where a task returns, the task of its first block. Evaluation is of the present task; at a
    block's end also of the next one, and of those that were trained `LAGS` blocks before. With
    ``evaluation.tasks="all"`` these earlier ones are evaluated each time.

    Args:
        blocks: say how tasks are drawn.

    Raises:
        ValueError: as `Curriculum`, for held-out tasks, and an evaluation that blocks do not repeat.
    """

    blocks: Life  # type: ignore[assignment]

    def __post_init__(self) -> None:
        make_fields_plain(self)
        at_once = "a stream draws its tasks block by block, and all at once are asked for: take Stream.first(n)"
        require((isinstance(self.blocks, Life), at_once))
        how = self.evaluation
        frames = self.blocks.num_frames
        near = f"evaluation.every={how.every} must divide num_frames={frames} of a stream's blocks, or be 0"
        require(
            (how.every == 0 or frames % how.every == 0, near),
            (not how.held_out, "a stream has no held_out tasks: evaluate further ones of another seed"),
        )
        self._check(True)

    @cached_property
    def tasks(self) -> DrawnTasks:
        """The task of each block; one that returns counts by its first block."""
        return self.blocks.tasks

    @property
    def examples(self) -> tuple[Task, ...]:
        """The tasks from which all but the images is drawn."""
        return self.blocks.choices

    @property
    def example_blocks(self) -> Sequence[Block]:
        """The first block: all have its frames, and one task."""
        return self.blocks[:1]

    @cached_property
    def ends(self) -> range:
        """Frames of the run at each block's end."""
        frames = self.blocks.num_frames
        return range(frames, frames * len(self.blocks) + 1, frames)

    @cached_property
    def task_ids(self) -> Mapping[TaskLike, int]:
        """The id of each of ``tasks``, found when it is asked for."""
        return _DrawnIds(self)

    @property
    def labels(self) -> Lazy:
        """A short name for each of ``tasks``: its number and goal."""
        return Lazy(len(self.blocks), self.blocks.label)

    evaluated_labels = labels

    @cached_property
    def example_labels(self) -> tuple[str, ...]:
        """A short name for each of ``examples``, by what differs."""
        return self._labels_of(self.examples)

    @property
    def trained(self) -> Lazy:
        """For each block, the position of its task in ``tasks``."""
        return Lazy(len(self.blocks), lambda place: (self.blocks.origin(place),))

    def for_seed(self, seed: int) -> Stream:
        """Return the stream that a run's seed draws; unchanged if it has its seed."""
        return self if self.blocks.seed is not None else replace(self, blocks=replace(self.blocks, run_seed=seed))

    def evaluated(self, frames: int) -> dict[TaskLike, tuple[int, str]]:
        """Return the tasks to evaluate after ``frames`` frames, with their numbers, from 1, and labels."""
        block = self.block_at(frames)
        places = [max(block - 1, 0)]
        is_end = block > 0 and self.is_end(frames)
        if is_end and block < len(self.blocks):
            places.append(block)
        if is_end or self.evaluation.tasks == "all":
            places += [block - 1 - lag for lag in LAGS if lag < block]
        origins = dict.fromkeys(map(self.blocks.origin, places))
        return {self.tasks[place]: (place + 1, self.labels[place]) for place in origins}

    def first(self, count: int) -> Curriculum:
        """Return the first blocks as a plain curriculum, which JSON holds task by task.

        Args:
            count: of blocks, at least 1.
        """
        require((is_int(count, 1, len(self.blocks)), f"count must be in 1..{len(self.blocks)}, got {count!r}"))
        name = f"{self.name}_first_{count}"
        return Curriculum(name, self.version, self.source, self.blocks[:count], self.evaluation, protocol=self.protocol)


class _DrawnIds(Mapping[TaskLike, int]):
    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.ids = stream.protocol.ids(len(stream.tasks))

    def __getitem__(self, task: TaskLike) -> int:
        try:
            place = self.stream.tasks.index(task)
        except ValueError as error:
            raise KeyError(task) from error
        return self.ids[self.stream.blocks.origin(place)]

    def __iter__(self) -> Iterator[TaskLike]:
        for place in range(len(self.ids)):
            if self.stream.blocks.origin(place) == place:
                yield self.stream.tasks[place]

    def __len__(self) -> int:
        return len({*map(self.stream.blocks.origin, range(len(self.ids)))})


def _canonical(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        found = {"type": type_name(type(value))}
        for field_ in fields(value):
            item = getattr(value, field_.name)
            default = field_.default if field_.default_factory is MISSING else field_.default_factory()
            if field_.compare and item != default:
                found[field_.name] = _canonical(item)
        return found
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [_canonical(item) for item in value]
    if isinstance(value, FrozenArguments):
        return value.pairs
    plain = value is None or isinstance(value, (bool, int, float, str))
    fix = "put @dataclass(frozen=True) above its class, whose fields then are part of the fingerprint"
    require((plain, f"a curriculum's parts must be dataclasses or plain values, got {value!r:.80}: {fix}"))
    return value
