"""The settings of a run as plain values: how they name a run, and how those of two runs are compared."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping
from inspect import Parameter, signature
from typing import Any

ADDED: dict[str, Any] = {}
"""Settings that were added after runs had been stored, such as ``"agent.cell"``, with the value for "as before".

With this value a setting is part of no run name and of no comparison, and stored runs without it have it. So a setting
that is added to a yaml file needs a line here, and then no earlier run is lost.
"""


def flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested settings by dotted names."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def as_before(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings without those of `ADDED` that have the value that means "as before"."""
    kept: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            kept[key] = as_before(value, f"{name}.")
        elif name not in ADDED or value != ADDED[name]:
            kept[key] = value
    return kept


def with_added(group: str, settings: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return the settings of a group, such as ``agent``, with those of `ADDED` that a stored run lacks.

    Args:
        group: which group of the configuration they are.
        settings: of a stored run.
        names: the settings that the group takes today.
    """
    added = {key.removeprefix(f"{group}."): value for key, value in ADDED.items() if key.startswith(f"{group}.")}
    return {**{name: value for name, value in added.items() if name in names}, **settings}


def parameters_of(function: Any) -> dict[str, Parameter]:
    """Return the arguments of a function or class by name; those that a class takes as ``**`` are its base's."""
    own = signature(function).parameters
    stars = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
    named = {name: parameter for name, parameter in own.items() if parameter.kind not in stars}
    hands_on = isinstance(function, type) and stars[1] in {parameter.kind for parameter in own.values()}
    return parameters_of(function.__mro__[1]) | named if hands_on else named


def digest(settings: Mapping[str, Any]) -> str:
    """Return the hash of settings that a run's name ends with: 12 hexadecimal digits."""
    text = json.dumps(as_before(settings), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def differences(stored: Mapping[str, Any], given: Mapping[str, Any]) -> list[str]:
    """Return in words which settings of a stored run differ from those that are given."""
    before, now = dict(flat(stored)), dict(flat(given))
    pairs = {key: (before.get(key, ADDED.get(key)), now.get(key, ADDED.get(key))) for key in sorted({*before, *now})}
    return [f"{key}={old!r} instead of {new!r}" for key, (old, new) in pairs.items() if old != new]
