"""A measurement: one line of a run's log, checked as it may come from anyone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from ctgraph_rl.checks import (
    LARGEST_INT,
    MOST_STREAMED,
    NamedValues,
    ReadOnlyValues,
    is_int,
    is_real,
)
from ctgraph_rl.strict import json_value

MOST = 10**6

MOST_FRAMES = 2**63 - 1

LARGEST = 1e100
"""Largest measured number: sums of squares stay finite."""


def _is_number(value: object) -> bool:
    if type(value) is float:  # most are
        return -LARGEST <= value <= LARGEST
    return value is None or is_real(value, -LARGEST, LARGEST)


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _are(holds: Callable[[Any], bool], value: object) -> bool:
    return isinstance(value, list) and all(map(holds, value))


def _is_task(value: object) -> bool:
    return is_int(value, 1, MOST)


def _are_blocks(value: object) -> bool:
    return _are(lambda block: block != [] and _are(_is_task, block), value)


def _are_sources(value: object) -> bool:
    values = value.values() if isinstance(value, Mapping) else [] if value is None else [0]
    return all(each is None or isinstance(each, str) for each in values)


def _are_seeds(value: object) -> bool:
    return value is None or _are(is_int, value)


def _is_expert(value: object) -> bool:
    return isinstance(value, Mapping) and _is_task(value.get("task")) and _are_seeds(value.get("together"))


RULES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "kind": (_is_text, "a text"),
    "schema": (is_int, "an integer"),
    "config": (lambda value: value is None or isinstance(value, Mapping), "an object"),
    "trained": (_are_blocks, f"lists of numbers of tasks in 1..{MOST:,}"),
    "tasks": (partial(_are, _is_text), "a list of texts"),
    "life": (lambda value: is_int(value, 1, MOST_STREAMED), f"an integer in 1..{MOST_STREAMED:,}"),
    "numbers": (is_int, "an integer"),
    **dict.fromkeys(("sources", "versions"), (_are_sources, "an object of texts")),
    "together": (_are_seeds, "a list of seeds"),
    "experts": (
        partial(_are, _is_expert),
        "a list of objects with a task and, where seeds were trained together, the list of those",
    ),
    "block": (lambda value: is_int(value, 0, MOST), f"an integer in 0..{MOST:,}"),
    **dict.fromkeys(("task", "step"), (_is_task, f"an integer in 1..{MOST:,}")),
    **dict.fromkeys(
        ("frames", "num_frames"), (lambda value: is_int(value, 0, MOST_FRAMES), "an integer in [0, 2**63)")
    ),
    "held_out": (lambda value: isinstance(value, bool), "true or false"),
    **dict.fromkeys(("moment", "label"), (_is_text, "a text")),
    **dict.fromkeys(
        ("found_rate", "exact_rate", "seconds", "episodes", "return_mean", "success_rate", "end_rate", "length_mean"),
        (_is_number, f"a number of at most {LARGEST:g}"),
    ),
}

NEEDED = {
    "training": ("block", "frames"),
    "evaluation": ("block", "frames", "task", "return_mean"),
    "adaptation": ("block", "frames", "task", "step", "return_mean"),
}


def parsed(line: bytes) -> NamedValues:
    """The object of a line.

    Raises:
        ValueError: for anything but an object with a ``kind``, such as a torn last line.
    """
    measurement = json_value(line, finite=False)  # settings may be infinite
    if not (isinstance(measurement, dict) and "kind" in measurement):
        raise ValueError(f"a measurement is an object with a kind, got {line!r:.80}")
    return measurement


def check(measurement: ReadOnlyValues, most: int = MOST) -> None:
    """Refuse a measurement that this package did not write.

    Args:
        most: number of blocks and of tasks that its file has room for.

    Raises:
        ValueError: for a missing field, one of another type, and numbers too large for tables.
    """
    broken = []
    for name, value in measurement.items():
        rule = RULES.get(name)
        if rule is not None and not rule[0](value):
            broken.append(f"{name} must be {rule[1]}, got {value!r:.80}")
        if isinstance(value, int) and not -LARGEST_INT <= value <= LARGEST_INT:
            broken.append(f"{name} must be an integer of 64 bits")
    kind = measurement["kind"]
    needed = NEEDED.get(kind, ()) if isinstance(kind, str) else ()
    missing = [name for name in needed if name not in measurement]
    if missing:
        broken.append(f"{', '.join(missing)} must be there")
    if not broken:
        highest = max(measurement.get("block", 0), measurement.get("task", 0), measurement.get("step", 0))
        for block in measurement.get("trained", ()):
            highest = max(highest, *block)
        if highest > most:
            broken.append(f"block or task {highest:,} is beyond what a file of its size can measure, {most:,}")
    if broken:
        raise ValueError("; ".join(broken))


def without_time(measurement: ReadOnlyValues) -> NamedValues:
    """Return a measurement without time and experts' directories: equal in equal runs."""
    kept = {key: value for key, value in measurement.items() if key != "seconds"}
    if "experts" in kept:
        experts = []
        for expert in kept["experts"]:
            experts.append({key: value for key, value in expert.items() if key != "run"})
        kept["experts"] = experts
    return kept
