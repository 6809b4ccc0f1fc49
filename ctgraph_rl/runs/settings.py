"""The settings of a run as plain values: how they name a run, and how those of two runs are compared."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from inspect import Parameter, signature
from typing import Any

ADDED: dict[str, dict[str, Any]] = {
    "run": {"portable": False},
    "curricula.from_axes": {"read_noise": 0, "read_rotation": 0, "random_graphs": None},
}
"""Settings that were added after runs had been stored, each with the value for "as before".

They are listed by the ``_target_`` that takes them, as ``{"baselines.rl2.RL2": {"cell": "lstm"}}``; those of no target
by their dotted names under ``run``, as ``{"run": {"meta.enabled": False}}``. With this value a setting is part of no
run name and of no comparison, and stored runs without it have it. So a setting that is added to a yaml file needs an
entry here, and then no earlier run is lost.
"""


def flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested settings by dotted names."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def as_before(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run without those of `ADDED` that have the value for "as before"."""
    kept = _without(settings, ADDED.get("run", {}))
    return {
        key: _without(value, _added_to(value)) if isinstance(value, Mapping) else value for key, value in kept.items()
    }


def _without(settings: Mapping[str, Any], added: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings without added ones of this value, and without groups that then are empty."""
    kept: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        inner = _without(value, added, f"{name}.") if isinstance(value, Mapping) else value
        is_added = name in added and json.dumps(value, sort_keys=True) == json.dumps(added[name], sort_keys=True)
        if not is_added and (inner != {} or value == {}):
            kept[key] = inner
    return kept


def _added_to(group: Any) -> dict[str, Any]:
    """Return the settings that were added to the target of a group."""
    return ADDED.get(str(group.get("_target_")), {}) if isinstance(group, Mapping) else {}


def with_added(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a stored group, such as ``agent``, with those that were added to its target since."""
    return {**_added_to(settings), **settings}


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
    before, now = dict(flat(as_before(stored))), dict(flat(as_before(given)))

    def value_of(key: str, values: Mapping[str, Any]) -> Any:
        group, _, name = key.partition(".")
        return values.get(key, _added_to(given.get(group)).get(name, ADDED.get("run", {}).get(key)))

    pairs = {key: (value_of(key, before), value_of(key, now)) for key in sorted({*before, *now})}
    return [f"{key}={old!r} instead of {new!r}" for key, (old, new) in pairs.items() if old != new]
