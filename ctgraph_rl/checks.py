"""Rules for users' values: every broken rule of an object is named in one error."""

from __future__ import annotations

import math
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


def is_int(value: object, low: float = -math.inf, high: float = math.inf) -> bool:
    """True for an ``int`` (not a ``bool``) in [low, high]."""
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def is_real(value: object, low: float = -math.inf, high: float = math.inf) -> bool:
    """True for a finite ``int`` or ``float`` (not a ``bool``) in [low, high]."""
    real = isinstance(value, (int, float)) and not isinstance(value, bool)
    return real and math.isfinite(value) and low <= value <= high  # type: ignore[arg-type]


def as_tuple(value: object) -> object:
    """A list-like value as a tuple (yaml has only lists); anything else unchanged."""
    if isinstance(value, Iterable) and not isinstance(value, (str, bytes, dict)):
        return tuple(value)
    return value
