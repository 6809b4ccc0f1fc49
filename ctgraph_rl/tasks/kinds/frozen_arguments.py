"""Arguments of environments and wrappers, held as a text that keeps lists, tuples and dicts apart."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from ctgraph_rl.checks import plain, require

TUPLE = "TupleArgument"

DICT = "DictArgument"


class FrozenArguments(str):
    """Arguments in the order of their names, as the JSON of pairs of name and value.

    A tuple or a dict is an object with ``type`` and ``items``. The items of a dict are pairs in the order written.
    """

    @property
    def pairs(self) -> list[Any]:
        """The pairs, as JSON."""
        return json.loads(self)

    def thaw(self) -> dict[str, Any]:
        """Return the arguments, new lists and dicts at each call."""
        return dict(from_json(self.pairs))


NONE = FrozenArguments("[]")


def freeze(what: str, arguments: Any) -> FrozenArguments:
    """Return arguments as a text.

    Args:
        what: has the arguments; begins the message.

    Raises:
        ValueError: for anything but arguments by name, and values that JSON has no form for.
    """
    if isinstance(arguments, FrozenArguments):
        return arguments
    rule = f"{what} must be plain values by name, such as {{'is_slippery': False}}, got {arguments!r:.200}"
    try:
        given = {name: _to_json(value) for name, value in dict(arguments).items()}
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{rule}: {error}") from None
    require((all(isinstance(name, str) and name for name in given), rule))
    return FrozenArguments(json.dumps(sorted(given.items())))


def _to_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {"type": DICT, "items": [[_key(key), _to_json(item)] for key, item in value.items()]}
    if isinstance(value, tuple):
        return {"type": TUPLE, "items": list(map(_to_json, value))}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    listed = isinstance(value, Sequence) and not isinstance(value, (bytes, bytearray, memoryview))
    require((listed, f"{value!r:.80} is no number, text, None, list, tuple or dict"))
    return list(map(_to_json, value))


def _key(key: Any) -> Any:
    key = plain(key)
    known = key is None or isinstance(key, (bool, int, float, str))
    require((known, f"the key {key!r:.80} of a dict is no number or text"))
    return key


def from_json(content: Any) -> Any:
    """Return the value of its JSON.

    Raises:
        ValueError: for an object that is no tuple and no dict.
    """
    if isinstance(content, list):
        return list(map(from_json, content))
    if not isinstance(content, Mapping):
        return content
    items: Any = content.get("items")
    fits = set(content) == {"type", "items"} and isinstance(items, list)
    require((fits, f"an argument must be an object with type and items, got {content!r:.80}"))
    if content["type"] == TUPLE:
        return tuple(map(from_json, items))
    require((content["type"] == DICT, f"type must be {TUPLE} or {DICT}, got {content['type']!r:.80}"))
    paired = all(isinstance(item, list) and len(item) == 2 for item in items)
    require((paired, f"items of a {DICT} must be pairs, got {items!r:.80}"))
    return {_key(key): from_json(item) for key, item in items}
