"""Curriculum: a frozen sequence of blocks with a protocol, an evaluation and a fingerprint."""

from __future__ import annotations

import hashlib
import json
import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from fractions import Fraction
from functools import cached_property
from html import escape
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
from ctgraph_rl.tasks.kinds.task_like import TaskLike, are_tasks
from ctgraph_rl.tasks.protocol import Block, Evaluation, Protocol
from ctgraph_rl.tasks.task import Task, are_graphs

FINGERPRINT_SCHEMA = 1
"""Raised when the way a fingerprint is computed changes."""

SHOWN = 20
"""Most blocks, and tasks of a block, in a notebook."""


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
        blocks = self.blocks
        only_blocks = isinstance(blocks, tuple) and bool(blocks) and all(isinstance(each, Block) for each in blocks)
        require(
            (isinstance(self.name, str) and bool(self.name), f"a curriculum needs a name, got {self.name!r}"),
            (is_int(self.version, 1), f"version must be an integer >= 1, got {self.version!r}"),
            (isinstance(self.source, str), f"source must be a text, got {self.source!r:.80}"),
            (only_blocks, f"a curriculum needs at least one Block and nothing else, got {self.blocks!r}"),
            (isinstance(self.evaluation, Evaluation), f"evaluation must be an Evaluation, got {self.evaluation!r}"),
            (isinstance(self.protocol, Protocol), f"protocol must be a Protocol, got {self.protocol!r}"),
        )
        self.protocol.ids(len(self.tasks))
        everything = (*self.tasks, *self.evaluation.held_out)
        require(*are_tasks("tasks", everything))
        shapes = list(dict.fromkeys(task.observation_shape for task in everything))
        actions = list(dict.fromkeys(task.num_actions for task in everything))
        pads = are_graphs(everything)
        one_shape = len(shapes) == 1 or (pads and max(map(len, shapes)) == 1)
        trained = set(self.tasks)
        trained_too = [task for task in self.evaluation.held_out if task in trained]
        one_each = self.protocol.task_id != "at_boundaries" or max(map(len, self.trained)) == 1
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

    def __repr__(self) -> str:
        return f"<Curriculum {self._summary}>"

    def _repr_html_(self) -> str:
        labels = dict(zip(self.tasks, self.labels, strict=True))
        rows = ["<tr><th>block</th><th>tasks</th><th>b, d, p</th><th>frames</th></tr>"]
        for number, block in enumerate(self.blocks[:SHOWN], 1):
            names = [labels[task] for task in dict.fromkeys(block.tasks)]
            graphs = dict.fromkeys(task.graph for task in block.tasks if isinstance(task, Task))
            shapes = [f"{graph.branching_factor}, {graph.depth}, {graph.wait_prob:g}" for graph in graphs]
            cells = (str(number), _some(names), _some(shapes, "; "), f"{block.num_frames:,}")
            rows.append(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>")
        more = f"<p>and {len(self.blocks) - SHOWN:,} more blocks</p>" if len(self.blocks) > SHOWN else ""
        source = escape(f"{self._summary}. {self.source}")
        return f"<p>{source}</p><table>{''.join(rows)}</table>{more}"

    @property
    def _summary(self) -> str:
        sizes = f"tasks: {len(self.tasks):,}, blocks: {len(self.blocks):,}, frames: {self.num_frames:,}"
        return f"{self.name!r}, version {self.version}, {sizes}"

    @cached_property
    def tasks(self) -> tuple[TaskLike, ...]:
        """The different tasks, by first appearance."""
        return tuple(dict.fromkeys(task for block in self.blocks for task in block.tasks))

    @cached_property
    def num_frames(self) -> int:
        """Frames of all blocks."""
        return self.ends[-1]

    @cached_property
    def ends(self) -> tuple[int, ...]:
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

    @property
    def segments(self) -> tuple[tuple[Block, ...], ...]:
        """The blocks between announced boundaries: each separately, or all where boundaries are hidden."""
        return tuple((block,) for block in self.blocks) if self.protocol.announces else (self.blocks,)

    @property
    def task_ids(self) -> dict[TaskLike, int]:
        """The id of each of ``tasks``."""
        return dict(zip(self.tasks, self.protocol.ids(len(self.tasks)), strict=True))

    @property
    def labels(self) -> tuple[str, ...]:
        """A short name for each of ``tasks``: the first of its parts, such as the goal, and what else differs."""
        return self.evaluated_labels[: len(self.tasks)]

    @cached_property
    def evaluated_labels(self) -> tuple[str, ...]:
        """`labels`, then those of the held-out tasks."""
        parts = [task.label_parts for task in (*self.tasks, *self.evaluation.held_out)]
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
    def trained(self) -> tuple[tuple[int, ...], ...]:
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
        return read_curriculum(path_or_dict, cls)

    @cached_property
    def fingerprint(self) -> str:
        """16 hex digits of all but name and source, equal on every machine."""
        content = {**_canonical(self), "name": "-", "source": "-"}
        text = json.dumps([FINGERPRINT_SCHEMA, content], sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _some(names: Sequence[str], between: str = ", ") -> str:
    more = [f"{len(names) - SHOWN:,} more"] if len(names) > SHOWN else []
    return between.join([*names[:SHOWN], *more])


def _canonical(value: Any) -> Any:
    """A value as plain JSON: dataclasses by name, with compared fields that differ from their defaults."""
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
    plain = value is None or isinstance(value, (bool, int, float, str))
    fix = "put @dataclass(frozen=True) above its class, whose fields then are part of the fingerprint"
    require((plain, f"a curriculum's parts must be dataclasses or plain values, got {value!r:.80}: {fix}"))
    return value
