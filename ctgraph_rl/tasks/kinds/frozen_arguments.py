"""Arguments of environments and wrappers, held as frozen values that keep lists, tuples and dicts apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ctgraph_rl.checks import plain, require


class ListArgument(tuple[Any, ...]):
    """A list."""


@dataclass(frozen=True)
class TupleArgument:
    """A tuple."""

    items: tuple[Any, ...]


@dataclass(frozen=True)
class DictArgument:
    """A dict, as pairs in the order written."""

    items: tuple[tuple[Any, Any], ...]


HELD = (ListArgument, TupleArgument, DictArgument)


def freeze(value: Any) -> Any:
    """Return an argument as a frozen value.

    Raises:
        ValueError: for values that JSON has no form for.
    """
    if isinstance(value, str):
        return str.__str__(value)  # of an enumeration's member, as JSON has it
    if isinstance(value, HELD) or value is None or isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, Mapping):
        return DictArgument(tuple((_key(key), freeze(item)) for key, item in value.items()))
    if isinstance(value, tuple):
        return TupleArgument(tuple(map(freeze, value)))
    listed = isinstance(value, Sequence) and not isinstance(value, (bytes, bytearray, memoryview))
    require((listed, f"{value!r:.80} is no number, text, None, list, tuple or dict"))
    return ListArgument(map(freeze, value))


def _key(key: Any) -> Any:
    key = plain(key)
    known = key is None or isinstance(key, (bool, int, float, str))
    require((known, f"the key {key!r:.80} of a dict is no number or text"))
    return key


def thaw(value: Any) -> Any:
    """Return the argument of `freeze`, new lists and dicts at each call."""
    if isinstance(value, ListArgument):
        return [thaw(item) for item in value]
    if isinstance(value, TupleArgument):
        return tuple(thaw(item) for item in value.items)
    if isinstance(value, DictArgument):
        return {key: thaw(item) for key, item in value.items}
    return value


def from_json(content: Any) -> Any:
    """Return the frozen argument of its JSON.

    Raises:
        ValueError: for an object that is no tuple and no dict.
    """
    if isinstance(content, list):
        return ListArgument(map(from_json, content))
    if not isinstance(content, Mapping):
        return content
    items: Any = content.get("items")
    fits = set(content) == {"type", "items"} and isinstance(items, list)
    require((fits, f"an argument must be an object with type and items, got {content!r:.80}"))
    if content["type"] == TupleArgument.__name__:
        return TupleArgument(tuple(map(from_json, items)))
    is_dict = content["type"] == DictArgument.__name__
    require((is_dict, f"type must be TupleArgument or DictArgument, got {content['type']!r:.80}"))
    paired = all(isinstance(item, list) and len(item) == 2 for item in items)
    require((paired, f"items of a DictArgument must be pairs, got {items!r:.80}"))
    return DictArgument(tuple((_key(key), from_json(item)) for key, item in items))


def by_name(what: str, arguments: Any) -> tuple[tuple[str, Any], ...]:
    """Return arguments as pairs of name and frozen value, by name.

    Args:
        what: has the arguments; begins the message.

    Raises:
        ValueError: for anything else, and values that JSON has no form for.
    """
    rule = f"{what} must be plain values by name, such as {{'is_slippery': False}}, got {arguments!r:.200}"
    try:
        given = dict(arguments)
        frozen = {name: freeze(value) for name, value in given.items()}
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{rule}: {error}") from None
    require((all(isinstance(name, str) and name for name in frozen), rule))
    return tuple(sorted(frozen.items()))
