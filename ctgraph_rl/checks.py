"""Rules for users' values: every broken rule of an object is named in one error."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable


def require(*rules: tuple[bool, str]) -> None:
    """Raise one ``ValueError`` that lists the message of every broken rule.

    Args:
        rules: pairs of (holds, message); the message names the rule, the value and the fix.

    Raises:
        ValueError: if any rule does not hold.
    """
    broken = [message for holds, message in rules if not holds]
    if broken:
        raise ValueError("; ".join(broken))


def memory_bytes() -> int:
    """Return the memory of this machine; without a limit where the system does not say."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else sys.maxsize


def require_memory(what: str, needed: int, fewer: str) -> None:
    """Refuse what cannot be held, before anything is allocated; POSIX systems only.

    Args:
        what: needs memory.
        needed: bytes at least.
        fewer: of what to use fewer.

    Raises:
        ValueError: if the machine has less memory.
    """
    memory = memory_bytes()
    require((needed < memory, f"{what} need {needed:,} bytes, this machine has {memory:,}; use fewer {fewer}"))


def is_int(value: object, low: float = -math.inf, high: float = math.inf) -> bool:
    """True for an ``int`` (not a ``bool``) in [low, high]."""
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def is_real(value: object, low: float = -math.inf, high: float = math.inf) -> bool:
    """True for a finite ``int`` or ``float`` (not a ``bool``) in [low, high]."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value) and low <= value <= high
    except OverflowError:  # an integer beyond float64
        return False


def is_shallow(value: object, levels: int) -> bool:
    """True for a value of JSON with at most so many lists and objects within each other."""
    if not isinstance(value, (dict, list)):
        return True
    items = value.values() if isinstance(value, dict) else value
    return levels > 0 and all(is_shallow(item, levels - 1) for item in items)


def at_least_one(**values: object) -> list[tuple[bool, str]]:
    """Rules that each named value is an integer >= 1."""
    return [(is_int(value, 1), f"{name} must be an integer >= 1, got {value!r}") for name, value in values.items()]


def positive(**values: object) -> list[tuple[bool, str]]:
    """Rules that each named value is a number > 0."""
    return [
        (is_real(value, 0) and value != 0, f"{name} must be a number > 0, got {value!r}")
        for name, value in values.items()
    ]


def fraction(**values: object) -> list[tuple[bool, str]]:
    """Rules that each named value is a number in [0, 1]."""
    return [(is_real(value, 0, 1), f"{name} must be in [0, 1], got {value!r}") for name, value in values.items()]


def not_negative(**values: object) -> list[tuple[bool, str]]:
    """Rules that each named value is a number >= 0."""
    return [(is_real(value, 0), f"{name} must be a number >= 0, got {value!r}") for name, value in values.items()]


def one_of(choices: tuple[str, ...], **values: object) -> list[tuple[bool, str]]:
    """Rules that each named value is one of the choices."""
    return [
        (value in choices, f"{name} must be one of {', '.join(choices)}, got {value!r}")
        for name, value in values.items()
    ]


def true_or_false(**values: object) -> list[tuple[bool, str]]:
    """Rules that each named value is a bool."""
    return [(isinstance(value, bool), f"{name} must be true or false, got {value!r}") for name, value in values.items()]


def as_tuple(value: object) -> object:
    """A list-like value as a tuple (yaml has only lists); anything else unchanged."""
    if isinstance(value, Iterable) and not isinstance(value, (str, bytes, dict, set, frozenset)):
        try:
            return tuple(value)
        except TypeError:  # an array without dimensions
            return value
    return value


def require_all(kind: type, name: str, values: object) -> tuple:
    """The items of a list-like value, all of one kind.

    Raises:
        ValueError: for anything else, or no item.
    """
    items = as_tuple(values)
    holds = isinstance(items, tuple) and len(items) > 0 and all(isinstance(item, kind) for item in items)
    kinds = sorted({type(item).__name__ for item in items}) if isinstance(items, tuple) else [type(values).__name__]
    require((holds, f"{name} must be a list with at least one {kind.__name__}, got {', '.join(kinds) or 'none'}"))
    return items  # type: ignore[return-value]
