"""Named task sequences that a paper can cite.

``curricula.load("ct8")`` and ``curricula.ct8()`` are as published; arguments such as ``num_frames`` change them.
`names` lists all, and ``curricula.axes`` makes other sequences.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from inspect import getdoc, signature, unwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctgraph_rl.checks import nearest, takes_its_kinds

if TYPE_CHECKING:
    from ctgraph_rl.tasks.curriculum import Curriculum

_MODULES = ("paper", "masks", "memory", "lives", "sharing", "task_free", "adaptation", "profile", "gym")
"""Where curricula are looked for, until one has the name; gym imports Gymnasium."""

_HOMES = {
    "from_axes": "configured",
    "from_graph": "configured",
    "from_meta_json": "meta_json",
    "sequence": "axes",
}

__all__ = ["from_axes", "from_graph", "from_meta_json", "load", "names", "sequence", "summary"]


def names() -> list[str]:
    """Names of all curricula, without those that need a missing package."""
    needs = import_module("curricula.gym").NEEDS
    found = {name for module in _MODULES for name in _named(module)}
    return sorted(name for name in found if name not in needs or find_spec(needs[name]) is not None)


def load(name: str, **arguments: Any) -> Curriculum:
    """A curriculum by name, changed by arguments.

    Raises:
        ValueError: for an unknown name or argument; lists the choices.

    Example:
        >>> curriculum = load("ct8", num_frames=1024)
        >>> len(curriculum.tasks), curriculum.num_frames
        (8, 8192)
    """
    function = _function(name)
    choices = list(signature(function).parameters)
    unknown = [argument for argument in arguments if argument not in choices]
    if unknown:
        raise ValueError(f"{name} has no {', '.join(unknown)}. Choices: {', '.join(choices)}")
    return function(**arguments)


def listed() -> tuple[tuple[str, ...], ...]:
    """Return name, version, number of tasks, frames, fingerprint and source of each curriculum, stored as torch loads
    slowly.
    """
    stored = json.loads(Path(__file__).with_name("fingerprints.json").read_text(encoding="utf-8"))
    return tuple(
        (name, str(one["version"]), f"{one['tasks']:,}", f"{one['frames']:,}", one["fingerprint"], one["source"])
        for name, one in stored.items()
    )


def summary(name: str) -> str:
    """Return the first line of a curriculum's docstring.

    Raises:
        ValueError: for an unknown name; lists the choices.
    """
    function = unwrap(_function(name))
    return (getdoc(getattr(function, "func", function)) or "").split("\n")[0]


def _function(name: str) -> Callable[..., Curriculum]:
    found = _find(name)
    if found is None:
        near = nearest(str(name), names())
        hint = "ctgraph-rl curricula lists all" if near is None else f"did you mean {near!r}?"
        one_task = f"CT-{str(name).upper().replace('_', '-').removeprefix('CT-')}"
        if one_task in import_module("ctgraph_rl.tasks.configurations").CONFIGURATIONS:
            hint = f"{one_task} is a configuration of one task, which ctgraph-rl draw {one_task} shows"
        if f"from_{name}" in _HOMES:
            hint = f"it is made from settings: curricula.from_{name}(...)"
        raise ValueError(f"unknown curriculum {name!r}; {hint}")
    return found


def _find(name: str) -> Callable[..., Curriculum] | None:
    return next((table[name] for table in map(_named, _MODULES) if name in table), None)


@cache
def _named(module: str) -> dict[str, Callable[..., Curriculum]]:
    table = import_module(f"curricula.{module}").NAMED
    return {name: takes_its_kinds(function) for name, function in table.items()}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"curricula.{_HOMES[name]}"), name)
    # a module that is being imported needs no other
    is_module = name.startswith("_") or find_spec(f"curricula.{name}") is not None
    found = None if is_module else _find(name)
    if found is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return found


def __dir__() -> list[str]:
    return sorted([*__all__, *names()])
