"""Curricula from the JSON files of the labs: a list of environments, and which of their goals in which order.

The labs' wrappers number all goals of all environments. ``config_paths`` names the environment files, relative to and
within the file's folder; ``task_order`` puts their goals one environment after the other (``default``) or in turns
(``interleaved``); ``filter_tasks`` chooses from that list, in its order, repeats allowed; ``num_tasks`` cuts the
choice. A task's one-hot label has length ``label_dim`` and is its number in the whole list, or, by ``task_label_mode``,
its place in the curriculum (``curriculum_index``) or what ``task_label_ids`` says (``explicit``).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate
from os import PathLike
from pathlib import Path
from reprlib import repr as short

from ctgraph_rl.checks import ReadOnlyValues, Rule, are_ints, is_int, one_of, require, takes_numbers, true_or_false
from ctgraph_rl.strict import json_object, require_keys, within
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import MOST_TASKS, Protocol
from ctgraph_rl.tasks.reference import read_task
from ctgraph_rl.tasks.task import Task
from curricula.axes import sequence
from curricula.published import one_id_each

MOST_BYTES = 4 * 2**20
MOST_NESTING = 8
MOST_CONFIGS = 1000
MOST_LABELS = 1_000_000

REQUIRED = ("config_paths", "task_order", "label_dim", "one_hot")
OPTIONAL = ("num_tasks", "filter_tasks", "task_label_mode", "label_by_curriculum_index", "task_label_ids")
ORDERS = ("default", "interleaved")
LABEL_MODES = ("global_task_id", "curriculum_index", "explicit")


@takes_numbers
def from_meta_json(path: str | PathLike[str], num_frames: int | Sequence[int], name: str | None = None) -> Curriculum:
    """The curriculum of a meta-JSON file, on environments of the authors' implementation.

    The learner sees the labels as one-hot task ids; the evaluation is our default. ``dataclasses.replace(curriculum,
    protocol=Protocol())`` hides the labels.

    Args:
        path: the meta-JSON file; its environment files may have the keys of 2019, 2021 or 2023.
        num_frames: of every task, or a list with those of each.
        name: of the curriculum; None: that of the file.

    Raises:
        ValueError: names file and key: files unreadable, too large or too deeply nested, keys missing or unknown,
            numbers out of range, and the order ``random`` or other labels than one-hot.
    """
    file = Path(path)
    meta = _read(file)
    with within(file):
        require_keys(meta, REQUIRED, OPTIONAL)
        require(*_value_rules(meta))
        paths = [_within(file.parent, config) for config in meta["config_paths"]]
    environments = []
    for path in paths:
        content = _read(path)
        with within(path):
            environments.append(read_task(content, ()))
    with within(file):
        sizes = [environment["graph"].num_end_states for environment in environments]
        numbers = _chosen(meta, sum(sizes))
        tasks = []
        for number in numbers:
            config, leaf = place_of(number, sizes, meta["task_order"])
            graph = environments[config]["graph"]
            tasks.append(Task(**environments[config] | {"goal": graph.path(graph.num_decision_states + leaf)}))
        by_place = meta.get("label_by_curriculum_index", meta.get("task_label_mode") == "curriculum_index")
        labels = meta.get("task_label_ids", list(range(len(numbers))) if by_place else numbers)
        length = meta["label_dim"]
        count = len(tasks)
        least = max(labels) + 1
        require(
            (len(labels) == count, f"task_label_ids must be one for each of {count} tasks, got {len(labels)}"),
            (least <= length, f"label_dim must be at least {least}, one more than a label, got {length}"),
        )
        protocol = Protocol("one_hot", num_task_ids=length, task_ids=one_id_each(tuple(tasks), labels))
        return sequence(name or file.stem, tasks, num_frames, source=f"meta-JSON file {file.name}", protocol=protocol)


def place_of(number: int, sizes: Sequence[int], order: str) -> tuple[int, int]:
    """Return the environment and goal of a number; environments without a further goal lose their turn.

    Args:
        number: among all goals of the environments.
        sizes: number of goals of each environment.
        order: ``default`` or ``interleaved``.
    """
    if order != "interleaved":
        starts = [0, *accumulate(sizes)]
        config = bisect_right(starts, number) - 1
        return config, number - starts[config]
    done = 0
    for end in sorted(set(sizes)):
        active = [config for config, size in enumerate(sizes) if size > done]
        if number < len(active) * (end - done):
            break
        number -= len(active) * (end - done)
        done = end
    return active[number % len(active)], done + number // len(active)


def _read(path: Path) -> ReadOnlyValues:
    return json_object(path, "meta-JSON", MOST_BYTES, MOST_NESTING)[1]


def _chosen(meta: ReadOnlyValues, pool_size: int) -> list[int]:
    listed = meta.get("filter_tasks")
    count = pool_size if listed is None else len(listed)
    count = min(count, meta.get("num_tasks", count))
    require((count <= MOST_TASKS, f"{count} tasks are too many, at most {MOST_TASKS}: use filter_tasks or num_tasks"))
    numbers = list(range(count)) if listed is None else listed[:count]
    outside = [number for number in numbers if number >= pool_size]
    range_rule = f"filter_tasks must be in 0..{pool_size - 1}, the goals of config_paths, got {short(outside)}"
    require((not outside, range_rule))
    return numbers


def _within(folder: Path, name: str) -> Path:
    path = folder / name
    inside = "\0" not in name and path.resolve().is_relative_to(folder.resolve())
    require((inside, f"config_paths must be in the folder of the file, got {short(name)}; copy the file there"))
    return path


def _value_rules(meta: ReadOnlyValues) -> list[Rule]:
    paths = meta["config_paths"]
    order = meta["task_order"]
    by_place = meta.get("label_by_curriculum_index", False)
    mode = meta.get("task_label_mode", LABEL_MODES[0])
    random_order = "; random is drawn from a global generator, so it cannot be reproduced" if order == "random" else ""
    only_paths = isinstance(paths, list) and 1 <= len(paths) <= MOST_CONFIGS and all(isinstance(p, str) for p in paths)
    in_turns = order != "interleaved" or (only_paths and len(paths) >= 2)
    return [
        (only_paths, f"config_paths must be a list of 1 to {MOST_CONFIGS} paths, got {short(paths)}"),
        (order in ORDERS, f"task_order must be {' or '.join(ORDERS)}, got {short(order)}{random_order}"),
        (in_turns, "task_order interleaved needs at least two config_paths"),
        _int_rule("label_dim", meta["label_dim"], MOST_LABELS),
        (meta["one_hot"] is True, f"one_hot must be true, got {short(meta['one_hot'])}; other labels are random there"),
        _int_rule("num_tasks", meta.get("num_tasks", 1)),
        _ints_rule("filter_tasks", meta.get("filter_tasks", [0])),
        _ints_rule("task_label_ids", meta.get("task_label_ids", [0])),
        *one_of(LABEL_MODES, task_label_mode=mode),
        (mode != "explicit" or "task_label_ids" in meta, "task_label_mode explicit needs task_label_ids"),
        *true_or_false(label_by_curriculum_index=by_place),
    ]


def _int_rule(key: str, value: object, most: float = float("inf")) -> Rule:
    limit = "" if most == float("inf") else f" and <= {most}"
    return is_int(value, 1, most), f"{key} must be an integer >= 1{limit}, got {short(value)}"


def _ints_rule(key: str, value: object) -> Rule:
    holds = isinstance(value, list) and 1 <= len(value) <= MOST_TASKS and are_ints(value, 0)
    return holds, f"{key} must be a list of 1 to {MOST_TASKS} integers >= 0, got {short(value)}"
