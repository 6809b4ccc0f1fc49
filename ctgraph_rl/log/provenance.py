"""Provenance: the versions and the machine that a run's numbers depend on, for the first line of its log."""

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
from ctgraph_rl.tasks.curriculum import Curriculum

NUMBERS = 2
"""The numbers version of this package: raised when equal configurations and seeds give other weights or measurements.

Every run stores it. A log without it is of numbers version 1.
"""

NUMBERS_TOGETHER = 3
"""The numbers version of runs whose seeds were trained as one batch, which rose by what changed for these only."""


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
    """Return whether a curriculum is the published one of its name; None if no published one has this name.

    Raises:
        ValueError: see `check_packages`.
    """
    check_packages()
    for name, _, _, _, fingerprint, _ in import_module("curricula").listed():
        if name == curriculum.name:
            return bool(fingerprint == curriculum.fingerprint)
    return None


def name_in_logs(curriculum: Curriculum) -> str:
    """Return a curriculum's name, with ``(modified)`` behind it if another one is published under that name."""
    return f"{curriculum.name} (modified)" if is_published(curriculum) is False else curriculum.name


def provenance(curriculum: Curriculum, names: Iterable[str] | None = ()) -> NamedValues:
    """Return curriculum, code, versions and machine as plain values for JSON. Tasks are counted from 1.

    Args:
        curriculum: what is learned.
        names: see `code`.
    """
    return {
        "schema": SCHEMA,
        "curriculum": name_in_logs(curriculum),
        "version": curriculum.version,
        "source": curriculum.source,
        **code(curriculum, names),
        "tasks": list(curriculum.labels),
        "trained": [[number + 1 for number in block] for block in curriculum.trained],
        "num_frames": curriculum.num_frames,
        "versions": versions(),
        **machine(),
        "cpu": cpu_model(),
    }


def code(curriculum: Curriculum, names: Iterable[str] | None = ()) -> NamedValues:
    """Return what decides the numbers of a run beside its configuration, as plain values for JSON.

    Args:
        curriculum: what is learned; its fingerprint stands for it, and its parts of a user's classes count as names do.
        names: classes and functions that learn, such as ``my_agent.MyAgent``, of which the user's sources count; None
            if they are not known.
    """
    known: dict[str, str | None] | None = None
    if names is not None:
        others = [name for name in (*names, *dict.fromkeys(_parts(curriculum))) if not is_ours(name)]
        known = find_sources(others) if others else {}
    return {"fingerprint": curriculum.fingerprint, "numbers": NUMBERS, "sources": known}


def learners(config: ReadOnlyValues | None, agent: object) -> list[str]:
    """Return the classes and functions that learn in a run: those of its configuration, or else the agent's parts.

    The curriculum of a configuration is left out: what it is says its fingerprint, however it was made.
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
    """Yield the names of the user's classes that parts of a curriculum have."""
    if is_dataclass(value) and not isinstance(value, type):
        if not is_ours(type(value).__module__):
            yield full_name(type(value))
        for each in fields(value):
            yield from _parts(getattr(value, each.name))
    elif isinstance(value, Iterable) and not isinstance(value, str):
        for item in value:
            yield from _parts(item)


def code_changes(before: ReadOnlyValues, now: ReadOnlyValues) -> list[str]:
    """Return in words what differs in the `code` of two runs; what one of them does not know does not differ.

    Args:
        before: the first line of a log.
        now: the code of this process.
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
    """Return whether a run does not say of which source it is where that counts now."""
    stored = before.get("sources")
    return bool(now["sources"]) and (stored is None or None in stored.values())


def numbers_of(about: ReadOnlyValues) -> int:
    """Return the numbers version that this package gives a run, by the first line of its log."""
    return NUMBERS_TOGETHER if about.get("together") else NUMBERS


def machine() -> NamedValues:
    """Return what besides versions decides the bits of a run on a CPU: its kind and the number of threads.

    The kind is such as ``x86_64 AVX512``, or ``x86_64 portable`` for any CPU of `ctgraph_rl.portable`.
    """
    instructions = "portable" if is_portable() else torch.backends.cpu.get_cpu_capability()
    kind = f"{platform.machine()} {instructions}"
    return {"machine": kind, "num_threads": torch.get_num_threads()}


def targets(settings: Any) -> Iterator[str]:
    """Yield the names of classes and functions that a configuration builds or hands on, at any depth."""
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
