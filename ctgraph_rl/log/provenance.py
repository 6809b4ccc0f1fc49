"""Provenance: versions and machine that a run's numbers depend on, for the first line of its log."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from itertools import filterfalse
from types import FunctionType
from typing import Any

import tensordict
import torch
import torchrl

from ctgraph_rl import __version__
from ctgraph_rl.checks import NamedValues, ReadOnlyValues
from ctgraph_rl.log.run_log import SCHEMA
from ctgraph_rl.log.sources import OURS, find_sources
from ctgraph_rl.packages import check_packages
from ctgraph_rl.portable import cpu_model, is_portable
from ctgraph_rl.tasks.curriculum import Curriculum, Stream

NUMBERS = 2
"""Numbers version: rises when equal configurations and seeds give other weights or measurements.

A log without it has 1.
"""

NUMBERS_TOGETHER = 3
"""Numbers version of seeds trained as one batch; rises for changes to these only."""


def versions() -> dict[str, str]:
    """Return the versions of this package and of what computes its numbers."""
    return {
        "ctgraph_rl": __version__,
        "torch": torch.__version__,
        "torchrl": torchrl.__version__,
        "tensordict": tensordict.__version__,
        "python": platform.python_version(),
    }


def is_published(curriculum: Curriculum) -> bool | None:
    """Return whether a curriculum is the published one of its name; None if there is none.

    Raises:
        ValueError: as `check_packages`.
    """
    check_packages()
    for name, _, _, _, fingerprint, _ in import_module("curricula").listed():
        if name == curriculum.name:
            return bool(fingerprint == curriculum.fingerprint)
    return None


def name_in_logs(curriculum: Curriculum) -> str:
    """Return a curriculum's name, with ``(modified)`` behind it if a published one of that name differs."""
    return f"{curriculum.name} (modified)" if is_published(curriculum) is False else curriculum.name


def provenance(curriculum: Curriculum, names: Iterable[str] | None = ()) -> NamedValues:
    """Return curriculum, code, versions and machine as plain values for JSON; tasks count from 1. ``names`` are as in
    `code`.
    """
    tasks: NamedValues = {}
    if isinstance(curriculum, Stream):  # whose tasks are drawn when they are needed
        tasks["life"] = len(curriculum.blocks)
    else:
        tasks["tasks"] = list(curriculum.labels)
        tasks["trained"] = [[number + 1 for number in block] for block in curriculum.trained]
    return {
        "schema": SCHEMA,
        "curriculum": name_in_logs(curriculum),
        "version": curriculum.version,
        "source": curriculum.source,
        **code(curriculum, names),
        **tasks,
        "num_frames": curriculum.num_frames,
        "versions": versions(),
        **machine(),
        "cpu": cpu_model(),
    }


def code(curriculum: Curriculum, names: Iterable[str] | None = ()) -> NamedValues:
    """Return what decides a run's numbers beside its configuration, as plain values for JSON.

    Args:
        curriculum: counts by its fingerprint, and a user's classes of its parts as ``names`` do.
        names: classes and functions that learn, such as ``my_agent.MyAgent``, whose user sources count; None: unknown.
    """
    known: dict[str, str | None] | None = None
    if names is not None:
        others = [name for name in (*names, *dict.fromkeys(_parts(curriculum))) if not is_ours(name)]
        known = find_sources(others) if others else {}
    return {"fingerprint": curriculum.fingerprint, "numbers": NUMBERS, "sources": known}


def learners(config: ReadOnlyValues | None, agent: object) -> list[str]:
    """Return the classes and functions that learn: of the configuration, without its curriculum, or else the agent's
    parts.
    """
    named = list(targets({**(config or {}), "curriculum": None}))
    if named or agent is None:
        return named
    parts = agent.modules() if isinstance(agent, torch.nn.Module) else [agent]
    found: dict[str, None] = {}
    for part in parts:
        found |= dict.fromkeys(filterfalse(is_ours, map(full_name, type(part).__mro__)))
    return list(found)


def _parts(value: Any) -> Iterator[str]:
    if is_dataclass(value) and not isinstance(value, type):
        if not is_ours(type(value).__module__):
            yield full_name(type(value))
        for each in fields(value):
            yield from _parts(getattr(value, each.name))
    elif isinstance(value, Iterable) and not isinstance(value, str):
        for item in value:
            yield from _parts(item)


def code_changes(before: ReadOnlyValues, now: ReadOnlyValues) -> list[str]:
    """Return in words what differs in two runs' `code`, where both know it.

    Args:
        before: the first line of a log.
    """
    stored = before.get("sources")
    fingerprint = before.get("fingerprint")
    numbers = before.get("numbers", 1)
    changed = []
    if fingerprint not in (None, now["fingerprint"]):
        changed.append(f"the curriculum (fingerprint {fingerprint} before, {now['fingerprint']} now)")
    if numbers != numbers_of(before):
        changed.append(f"ctgraph_rl (numbers version {numbers} before, {numbers_of(before)} now)")
    if stored is not None and now["sources"] is not None:
        for name in sorted({*stored, *now["sources"]}):
            digests = {stored.get(name, ""), now["sources"].get(name, "")}
            if None not in digests and len(digests) == 2:
                changed.append(name)
    return changed


def is_unknown(before: ReadOnlyValues, now: ReadOnlyValues) -> bool:
    """Return whether a run lacks the source that counts now."""
    stored = before.get("sources")
    return bool(now["sources"]) and (stored is None or None in stored.values())


def numbers_of(about: ReadOnlyValues) -> int:
    """Return the numbers version that this package gives a run, by its log's first line."""
    return NUMBERS_TOGETHER if about.get("together") else NUMBERS


def machine() -> NamedValues:
    """Return what decides a run's bits on a CPU: its threads and kind, such as ``x86_64 AVX512``.

    The kind is ``x86_64 portable`` for any CPU of `ctgraph_rl.portable`.
    """
    instructions = "portable" if is_portable() else torch.backends.cpu.get_cpu_capability()
    kind = f"{platform.machine()} {instructions}"
    return {"machine": kind, "num_threads": torch.get_num_threads()}


def targets(settings: Any) -> Iterator[str]:
    """Yield the classes and functions that a configuration names, at any depth."""
    if isinstance(settings, Mapping):
        name = str(settings.get("_target_", ""))
        if name:
            yield str(settings.get("path")) if name.startswith("hydra.utils.get_") else name
    if isinstance(settings, (Mapping, list, tuple)):
        for each in settings.values() if isinstance(settings, Mapping) else settings:
            yield from targets(each)


def is_ours(name: str) -> bool:
    """Return whether a class or function is of this package."""
    return name.partition(".")[0] in OURS


def full_name(kind: type | FunctionType) -> str:
    """Return the dotted name of a class or function."""
    return f"{kind.__module__}.{kind.__qualname__}"
