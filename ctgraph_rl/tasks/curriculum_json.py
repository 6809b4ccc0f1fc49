"""Curricula as JSON, so that others can use one without this package.

Every field is written out under its name in Python, a goal as text, ``"1.2"``. The different tasks are listed once,
trained ones first; blocks and ``held_out`` name them by position, from 0. ``type`` says which of several classes a part
is. ``fingerprint`` is that of `Curriculum`; ``about`` holds numbers that follow from the rest and is not read. A file
may lack a field that was added later: ``field(default=..., metadata={"added": True})``, where the default means "as
before".
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from itertools import chain
from os import PathLike
from os.path import lexists
from typing import TYPE_CHECKING, Any

from ctgraph_rl import __version__
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, are_ints, by_name, is_int, require
from ctgraph_rl.core.goal import write_goal
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.core.rewards import REWARD_FNS
from ctgraph_rl.disk import write_whole
from ctgraph_rl.strict import json_object, require_keys, within
from ctgraph_rl.tasks.images import IMAGE_SETS
from ctgraph_rl.tasks.kinds.frozen_arguments import FrozenArguments, from_json
from ctgraph_rl.tasks.kinds.gym_task import GymTask, require_wrapper_classes
from ctgraph_rl.tasks.kinds.task_like import TaskLike, is_kind
from ctgraph_rl.tasks.life import Life
from ctgraph_rl.tasks.memory import bank_bytes
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.protocol import Block, Evaluation, Protocol, count_rule
from ctgraph_rl.tasks.switch import SWITCHES
from ctgraph_rl.tasks.task import Task

if TYPE_CHECKING:
    from ctgraph_rl.tasks.curriculum import Curriculum

SCHEMA = 1

MAX_BYTES = 2**26

MAX_NESTING = 16

MAX_BANK_BYTES = 2**36

_GRAPH_FACTS = (
    "num_states",
    "num_end_states",
    "reward_prob_random",
    "expected_episode_length",
)

_KEYS = ("schema", "fingerprint", "name", "version", "source", "tasks", "blocks", "evaluation", "protocol")
_DERIVED = "about"

_CHOICES: dict[tuple[type, str], tuple[type, ...]] = {
    (Task, "images"): IMAGE_SETS,
    (Task, "reward_fn"): tuple(REWARD_FNS.values()),
    (Block, "switch"): SWITCHES,
}
"""Fields that hold one of several types, which JSON names."""

_PARTS: dict[tuple[type, str], type] = {(Task, "graph"): CTGraph, (Task, "observations"): Observations}

_OF_TASKS = ((Block, "tasks"), (Evaluation, "held_out"), (Life, "choices"))
_OF_ARGUMENTS = ((GymTask, "kwargs"), (GymTask, "wrappers"))

_NAMED_TYPES = (*chain.from_iterable(_CHOICES.values()), Life)

_OURS = (*_NAMED_TYPES, *_PARTS.values(), Task, Block, Evaluation, Protocol)


TASK_KINDS: dict[str, type] = {GymTask.__name__: GymTask}
"""Kinds of tasks by their names in JSON, beside `Task`, which has none."""


def write_curriculum(curriculum: Curriculum, path: str | PathLike[str] | None = None) -> NamedValues:
    """Return a curriculum as JSON, and write it to ``path`` if given."""
    require((path is None or not lexists(path), f"{path} exists: choose another path, nothing is overwritten"))
    tasks = (*curriculum.examples, *curriculum.evaluation.held_out)
    places: dict[TaskLike, int] = {task: i for i, task in enumerate(tasks)}
    listed = []
    for task in places:
        kind = type(task)
        named = {} if kind is Task else {"type": type_name(kind)}
        values = {name: _plain(getattr(task, name), {}) for name in _names(kind)}
        if isinstance(task, Task):
            values["goal"] = write_goal(task.goal)
        listed.append(named | values)
    content: NamedValues = {
        "schema": SCHEMA,
        "fingerprint": curriculum.fingerprint,
        "name": curriculum.name,
        "version": curriculum.version,
        "source": curriculum.source,
        "tasks": listed,
        "blocks": _plain(curriculum.blocks, places),
        "evaluation": _plain(curriculum.evaluation, places),
        "protocol": _plain(curriculum.protocol, places),
    }
    with within(curriculum.name):
        _check_form(content)
    about = []
    for label, task in zip(curriculum.labels, curriculum.examples, strict=False):
        facts: NamedValues = {"label": label}
        if isinstance(task, Task):
            facts["goal_leaf"] = task.goal_leaf
            facts |= {name: getattr(task.graph, name) for name in _GRAPH_FACTS}
        about.append(facts)
    written_by = f"ctgraph_rl {__version__}"
    content[_DERIVED] = {"written_by": written_by, "num_frames": curriculum.num_frames, "tasks": about}
    if path is not None:
        write_whole(path, file_text(content))
    return content


def read_curriculum(
    path_or_dict: str | PathLike[str] | ReadOnlyValues, kind: type[Curriculum], of_life: type[Curriculum]
) -> Curriculum:
    """Return the curriculum of a JSON file or its content, of one class or that for a life."""
    source, content = json_object(path_or_dict, "curriculum", MAX_BYTES, MAX_NESTING)  # `_check_form` knows numbers
    content = dict(content)
    content.pop(_DERIVED, None)
    with within(source):
        _check_form(content)
        schema = content.get("schema")
        newer = f"schema {schema} is newer than {SCHEMA}, the newest that is known here; update ctgraph_rl"
        require((not is_int(schema, SCHEMA + 1), newer))
        require_keys(content, _KEYS)
        require((schema == SCHEMA, f"schema must be {SCHEMA}, got {schema!r}"))
        listed = content["tasks"]
        require(count_rule(len(listed) if isinstance(listed, list) else 0))
        tasks = _each("tasks", listed, _task)
        blocks: Any = content["blocks"]
        if isinstance(blocks, Mapping):
            kind = of_life
            with within("blocks"):
                blocks = _chosen((Life,), blocks, tasks)
        else:
            blocks = tuple(_each("blocks", blocks, lambda block: _built(Block, block, tasks)))
        with within("evaluation"):
            evaluation = _built(Evaluation, content["evaluation"], tasks)
        with within("protocol"):
            protocol = _built(Protocol, content["protocol"])
        name = content["name"]
        curriculum = kind(name, content["version"], content["source"], blocks, evaluation, protocol=protocol)
        stated = content["fingerprint"]
        found = curriculum.fingerprint
        fix = f"if the change is intended, write {found!r} there, and a new version and name"
        require((stated == found, f"fingerprint is {stated!r}, but the content has {found!r}; {fix}"))
    return curriculum


def _plain(value: Any, places: Mapping[TaskLike, int]) -> Any:
    if places and value in places:
        return places[value]
    if isinstance(value, tuple):
        return [_plain(item, places) for item in value]
    if isinstance(value, FrozenArguments):
        return value.pairs
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    kind = type(value)
    require((kind in _OURS, f"JSON holds only types of this package, got {value!r}; exchange it as Python"))
    content: NamedValues = {"type": kind.__name__} if kind in _NAMED_TYPES else {}
    return content | {name: _plain(getattr(value, name), places) for name in _names(kind)}


def type_name(kind: type) -> str:
    """Return a type's name in JSON: ours by name only, so that they may move; a user's with the module."""
    return kind.__qualname__ if kind.__module__.startswith("ctgraph_rl.") else f"{kind.__module__}.{kind.__qualname__}"


def _names(kind: type) -> list[str]:
    return [field.name for field in fields(kind) if field.init]


def file_text(content: ReadOnlyValues) -> str:
    """Return the text of a curriculum's file."""
    return _text(content) + "\n"


def _text(value: Any, margin: str = "\n") -> str:
    inner = margin + "  "
    if isinstance(value, dict):
        parts = [f"{json.dumps(key)}: {_text(item, inner)}" for key, item in value.items()]
        return "{" + inner + f",{inner}".join(parts) + margin + "}"
    if isinstance(value, list) and any(isinstance(item, (dict, list)) for item in value):
        return "[" + inner + f",{inner}".join(_text(item, inner) for item in value) + margin + "]"
    return json.dumps(value, allow_nan=False)


def _check_form(value: Any, nesting: int = 1) -> None:
    if isinstance(value, (Mapping, list)):
        require((nesting <= MAX_NESTING, f"nested more than {MAX_NESTING} deep"))
        for key, item in value.items() if isinstance(value, Mapping) else enumerate(value):
            with within(str(key)):
                _check_form(item, nesting + 1)
        return
    require(
        (value is None or isinstance(value, (bool, int, float, str)), f"must be a JSON value, got {value!r}"),
        (not isinstance(value, int) or -(2**63) <= value < 2**63, "must fit 64 bits, got a larger integer"),
        (not isinstance(value, float) or math.isfinite(value), f"must be a finite number, got {value!r}"),
    )


def _task(content: Any) -> TaskLike:
    if not isinstance(content, Mapping) or "type" not in content:
        task = _built(Task, content)
        needed = bank_bytes([task])
        require((needed <= MAX_BANK_BYTES, f"images need {needed:,} bytes, the limit is {MAX_BANK_BYTES:,}; use fewer"))
        return task
    task = _built(_kind(content["type"]), _without_type(content))
    known = ("ctgraph_rl", "curricula", "gymnasium")
    missing = [name for name in getattr(task, "modules", ()) if name not in sys.modules]
    unknown = [name for name in missing if name.partition(".")[0] not in known]
    fix = "import them first, as nothing of a file is imported"
    require((not unknown, f"the task needs the modules {', '.join(unknown)}: {fix}"))
    if isinstance(task, GymTask):
        require_wrapper_classes(task)
    return task


def _kind(name: Any) -> type:
    require((isinstance(name, str), f"type must be the name of a kind of tasks, got {name!r:.80}"))
    if name in TASK_KINDS:
        return TASK_KINDS[name]
    module, _, own_name = name.rpartition(".")
    kind = getattr(sys.modules.get(module), own_name, None)
    fix = f"import {module or 'its module'} first, as nothing of a file is imported, or give the curriculum as Python"
    known = isinstance(kind, type) and kind.__module__ == module and is_kind(kind)
    require((known, f"type {name!r:.80} is no kind of tasks that is known here: {fix}"))
    return kind  # type: ignore[return-value]


def _each(name: str, content: Any, read: Callable[[Any], Any]) -> list[Any]:
    require((isinstance(content, list), f"{name} must be a list, got {content!r:.80}"))
    items = []
    for i, item in enumerate(content):
        with within(f"{name}[{i}]"):
            items.append(read(item))
    return items


def _built(kind: type, content: Any, tasks: Sequence[TaskLike] = ()) -> Any:
    added = [field.name for field in fields(kind) if field.metadata.get("added")]
    require_keys(content, [name for name in _names(kind) if name not in added], added)
    arguments = {}
    for name, item in content.items():
        place = (kind, name)
        with within(name):
            value = item
            if place in _PARTS:
                value = _built(_PARTS[place], item)
            elif place in _CHOICES and (item is not None or place != (Block, "switch")):
                value = _chosen(_CHOICES[place], item)
            elif place in _OF_TASKS:
                holds = are_ints(item, 0, len(tasks) - 1)
                require((holds, f"must be positions in the list of {len(tasks)} tasks, from 0, got {item!r:.80}"))
                value = tuple(tasks[i] for i in item)
            elif place in _OF_ARGUMENTS:
                value = from_json(item)
            arguments[name] = value
    return kind(**arguments)


def _chosen(kinds: Sequence[type], content: Any, tasks: Sequence[TaskLike] = ()) -> Any:
    require((isinstance(content, Mapping), f"must be an object with a type, got {content!r:.80}"))
    names = by_name(*kinds)
    given = content.get("type")
    known = isinstance(given, str) and given in names
    require((known, f"type must be one of {', '.join(names)}, got {given!r:.80}"))
    return _built(names[given], _without_type(content), tasks)


def _without_type(content: ReadOnlyValues) -> NamedValues:
    return {key: item for key, item in content.items() if key != "type"}
