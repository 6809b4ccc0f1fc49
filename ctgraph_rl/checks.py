"""Rules for users' values: one error names all broken rules of an object."""

from __future__ import annotations

import json
import math
import operator
import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import fields
from difflib import get_close_matches
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

Function = TypeVar("Function", bound=Callable[..., Any])

Rule = tuple[bool, str]
"""Whether a rule holds, and the message if not."""

NamedValues = dict[str, Any]

ReadOnlyValues = Mapping[str, Any]

LARGEST_INT = 2**63 - 1

MOST_STREAMED = 100_000

LONGEST_NAME, LONGEST_PATH = 255, 4095
"""Bytes of a path's part, and of a path."""


def require(*rules: Rule) -> None:
    """Raise one ``ValueError`` with the message of every broken rule.

    Args:
        rules: pairs of (holds, message); the message names the rule, the value and the fix.

    Raises:
        ValueError: if any rule does not hold.
    """
    broken = [message for holds, message in rules if not holds]
    if broken:
        raise ValueError("; ".join(broken))


def nearest(word: str, choices: Iterable[str]) -> str | None:
    """Return the likely choice for a misspelt word, initials or a part, or None."""
    known = {choice.lower().replace("-", "_"): choice for choice in choices}
    initials = []
    parts = []
    word = word.lower().replace("-", "_")
    for name in known:
        if len(word) > 1 and word == "".join(re.findall("(?:^|_)([^_])", name)):
            initials.append(name)
        if word in name.split("_"):
            parts.append(name)
    close = get_close_matches(word, known, 1)
    found = [word] if word in known else close or initials[:1] or (parts if len(parts) == 1 else [])
    return known[found[0]] if found else None


def as_int(action: object) -> int:
    """Return an integer, -1 for anything else."""
    try:
        return operator.index(action)  # type: ignore[arg-type]
    except TypeError:
        return -1


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """Return the end of a message about an unknown word: the nearest choice, or all."""
    choices = list(choices)
    near = nearest(word, choices)
    return f"did you mean {near!r}?" if near is not None else f"choices: {', '.join(choices) or 'none'}"


def memory_bytes() -> int:
    """Return this machine's memory in bytes; a huge number if unknown."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else sys.maxsize


def require_memory(what: str, needed: int, fewer: str) -> None:
    """Refuse what needs more bytes than this machine has; ``fewer`` names what to reduce.

    Raises:
        ValueError: if the machine has less memory.
    """
    memory = memory_bytes()
    require((needed < memory, f"{what} need {needed:,} bytes, this machine has {memory:,}; use fewer {fewer}"))


def is_int(value: object, low: float = -math.inf, high: float = math.inf) -> bool:
    """True for an ``int`` (not a ``bool``) in [low, high]."""
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def are_ints(value: object, low: float = -math.inf, high: float = math.inf) -> bool:
    """True for a list or tuple of such integers."""
    return isinstance(value, (list, tuple)) and all(is_int(each, low, high) for each in value)


def repeated(values: Iterable[T]) -> list[T]:
    """Return each repeated value once."""
    return [value for value, count in Counter(values).items() if count > 1]


def by_name(*named: Any) -> dict[str, Any]:
    """Return functions or classes by name."""
    return {each.__name__: each for each in named}


def is_real(value: object, low: float = -math.inf, high: float = math.inf) -> bool:
    """True for a finite ``int`` or ``float`` (not a ``bool``) in [low, high]."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value) and low <= value <= high
    except OverflowError:  # an integer beyond float64
        return False


def plain(value: Any, whole: bool = False) -> Any:
    """Return numbers and arrays of NumPy, torch and others as Python's own; anything else unchanged.

    Args:
        value: a number, an array, or a list, tuple or dict of such.
        whole: return a whole float, such as ``1e5``, as an int.
    """
    try:
        return _plain(value, whole)
    except (ArithmeticError, RecursionError, RuntimeError, TypeError, ValueError):  # has no value, or none of Python
        return value


def _plain(value: Any, whole: bool) -> Any:
    kind = type(value)
    if kind is bool:
        return value
    if kind in (list, tuple):
        return kind(_plain(item, whole) for item in value)
    if kind is dict:
        return {key: _plain(item, whole) for key, item in value.items()}
    if hasattr(kind, "tolist"):
        listed = value.tolist()
        if type(listed) is not kind:  # NumPy's longdouble returns itself
            return _plain(listed, whole)
    if hasattr(kind, "__index__"):
        return operator.index(value)
    if not hasattr(kind, "__float__"):
        return value
    number = float(value)
    return int(number) if whole and number.is_integer() and abs(number) <= LARGEST_INT else number


def make_fields_plain(instance: Any) -> None:
    """Make a frozen dataclass's numbers and arrays `plain`, and lists for tuples tuples."""
    for each in fields(instance):
        if each.init:
            value = plain(getattr(instance, each.name), whole=_is_whole(each.type))
            if str(each.type).startswith("tuple") and not isinstance(value, tuple):
                value = as_tuple(value)
            object.__setattr__(instance, each.name, value)


def takes_numbers(function: Function) -> Function:
    """Give a function `plain` numbers for ``**`` and arguments annotated as numbers."""
    parameters = signature(function).parameters
    names = list(parameters)
    wholes = {name: _is_whole(each.annotation) for name, each in parameters.items() if _is_number(each)}
    takes_others = any(each.kind == Parameter.VAR_KEYWORD for each in parameters.values())

    @wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        given = list(args)
        for place, name in enumerate(names[: len(given)]):
            if name in wholes:
                given[place] = plain(given[place], wholes[name])
        for name, value in kwargs.items():
            if name in wholes or (takes_others and name not in parameters):
                kwargs[name] = plain(value, wholes.get(name, False))
        return function(*given, **kwargs)

    return called  # type: ignore[return-value]


KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "int": ("an integer", is_int),
    "float": ("a number", is_real),
    "bool": ("true or false", lambda value: isinstance(value, bool)),
    "str": ("a text", lambda value: isinstance(value, str)),
    "Sequence": ("a list", lambda value: isinstance(as_tuple(value), tuple)),
    "None": ("null", lambda value: value is None),
}
"""By names in annotations: a value's kind in words, and its test."""


def takes_its_kinds(function: Function) -> Function:
    """As `takes_numbers`, and refuse values of other kinds than annotations in `KINDS`."""
    shape = signature(function)
    checked = {}
    for name, parameter in shape.parameters.items():
        kinds = [kind.partition("[")[0] for kind in re.split(r" \| (?![^\[]*\])", str(parameter.annotation))]
        if set(kinds) <= set(KINDS):
            checked[name] = [KINDS[kind] for kind in kinds]

    @wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        rules = []
        for name, value in shape.bind(*args, **kwargs).arguments.items():
            kinds = checked.get(name)
            if kinds is not None:
                words = " or ".join(word for word, _ in kinds)
                rules.append((any(fits(value) for _, fits in kinds), f"{name} must be {words}, got {value!r}"))
        require(*rules)
        return function(*args, **kwargs)

    called.__module__ = getattr(function, "func", function).__module__  # a partial function is not one of functools
    return takes_numbers(called)  # type: ignore[return-value]


class TakesNumbers:
    """Base of classes whose constructors also take numbers of NumPy and torch."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in vars(cls):
            cls.__init__ = takes_numbers(cls.__init__)  # type: ignore[method-assign]


def _is_number(parameter: Parameter) -> bool:
    words = _words(parameter.annotation)
    return bool(words & {"int", "float", "bool"}) and not words & {"Tensor", "Callable"}


def _is_whole(annotation: object) -> bool:
    return annotation is int or (str(annotation).startswith("int") and "float" not in _words(annotation))


def _words(annotation: object) -> set[str]:
    return set(re.findall(r"\w+", str(annotation)))


def as_path(name: str, value: object) -> Path:
    """Return a path that a file system can take.

    Raises:
        ValueError: for other values, null characters, and too long paths.
    """
    require((isinstance(value, (str, os.PathLike)), f"{name} must be a path, got {value!r:.80}"))
    path = Path(value)  # type: ignore[arg-type]
    longest = max(map(len, map(os.fsencode, path.parts)), default=0)
    fits = longest <= LONGEST_NAME and len(os.fsencode(path)) <= LONGEST_PATH
    shown = f"got {len(str(path)):,} characters, {str(path)!r:.80}"
    require(
        ("\0" not in str(path), f"{name} must have no null character, got {str(path)!r:.80}"),
        (fits, f"{name} must have at most {LONGEST_PATH} bytes, {LONGEST_NAME} in each part; {shown}"),
    )
    return path


def is_json_object(value: object) -> bool:
    """Return whether a value is None, or plain values of JSON by name."""
    try:
        json.dumps(value)
    except (TypeError, ValueError, RecursionError):
        return False
    return value is None or isinstance(value, Mapping)


def is_shallow(value: object, levels: int) -> bool:
    """Return whether a JSON value nests at most so many lists and objects."""
    if not isinstance(value, (dict, list)):
        return True
    items = value.values() if isinstance(value, dict) else value
    return levels > 0 and all(is_shallow(item, levels - 1) for item in items if isinstance(item, (dict, list)))


def at_least_one(**values: object) -> list[Rule]:
    """Rules that each named value is an integer in 1..2**63 - 1."""
    rules = []
    for name, value in values.items():
        limit = "< 2**63" if is_int(value, 1) else ">= 1"
        rules.append((is_int(value, 1, LARGEST_INT), f"{name} must be an integer {limit}, got {value!r}"))
    return rules


def _rules(holds: Callable[[Any], bool], what: str, values: Mapping[str, object]) -> list[Rule]:
    return [(holds(value), f"{name} must be {what}, got {value!r}") for name, value in values.items()]


def at_most(limit: float, **values: object) -> list[Rule]:
    """Rules that each named number is at most a limit; other values break other rules."""
    return _rules(lambda value: not is_real(value) or value <= limit, f"at most {limit:,}", values)


def positive(**values: object) -> list[Rule]:
    """Rules that each named value is a number > 0."""
    return _rules(lambda value: is_real(value, 0) and value != 0, "a number > 0", values)


def fraction(**values: object) -> list[Rule]:
    """Rules that each named value is a number in [0, 1]."""
    return _rules(lambda value: is_real(value, 0, 1), "in [0, 1]", values)


def not_negative(**values: object) -> list[Rule]:
    """Rules that each named value is a number >= 0."""
    return _rules(lambda value: is_real(value, 0), "a number >= 0", values)


def one_of(choices: Collection[str], **values: object) -> list[Rule]:
    """Rules that each named value is one of the choices."""
    return _rules(lambda value: isinstance(value, str) and value in choices, f"one of {', '.join(choices)}", values)


def true_or_false(**values: object) -> list[Rule]:
    """Rules that each named value is a bool."""
    return _rules(lambda value: isinstance(value, bool), "true or false", values)


def as_tuple(value: object) -> object:
    """A list-like value, as of yaml, as a tuple of plain values; anything else unchanged."""
    value = plain(value)
    if isinstance(value, (list, tuple)):
        return tuple(value)
    if isinstance(value, Iterable) and not isinstance(value, (str, bytes, dict, set, frozenset)):
        return tuple(map(plain, value))
    return value


def require_all(kind: type[T], name: str, values: object) -> tuple[T, ...]:
    """The items, at least one, of a list-like value, all of one kind.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(values, (list, tuple)) and values and all(isinstance(value, kind) for value in values):
        return tuple(values)
    items = as_tuple(values)
    holds = isinstance(items, tuple) and len(items) > 0 and all(isinstance(item, kind) for item in items)
    kinds = sorted({type(item).__name__ for item in items}) if isinstance(items, tuple) else [type(values).__name__]
    require((holds, f"{name} must be a list with at least one {kind.__name__}, got {', '.join(kinds) or 'none'}"))
    return items  # type: ignore[return-value]
