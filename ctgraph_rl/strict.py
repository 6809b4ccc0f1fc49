"""Strict readers of other people's files, one per format.

They refuse what two programs could read differently, such as a repeated key, and what would take more memory or time
than its file says. Every error is a ``ValueError`` of one line.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, as_path, did_you_mean, is_shallow, repeated, require
from ctgraph_rl.disk import in_words, read_regular

MAX_NESTING = 32

LONGEST_NUMBER = 40

LONG_NUMBER = re.compile("[0-9]" * (LONGEST_NUMBER + 1))

MAX_DEPTH = 32


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Name a file in errors about its content."""
    try:
        yield
    except ValueError as error:
        raise ValueError(str(error) if str(path) in str(error) else f"{path} {error}") from None


@contextmanager
def within(place: object) -> Iterator[None]:
    """Begin errors with their file or key."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(str(place)) else f"{place}: {text}") from error


def json_value(content: bytes, finite: bool = True, nesting: int = MAX_NESTING) -> Any:
    """Return the value of a JSON text in UTF-8.

    Args:
        finite: refuse NaN and infinity, which are not JSON.
        nesting: at most.

    Raises:
        ValueError: for anything but JSON, repeated keys, too long integers, and too deep nesting.
    """
    text = content.decode("utf-8")
    if text.startswith("\ufeff"):
        raise ValueError("Unexpected UTF-8 BOM: save it without one")
    try:
        value = _decoder(finite).decode(text)
    except RecursionError:
        raise ValueError(f"nested more than {nesting} deep") from None
    if text.count("{") + text.count("[") > nesting and not is_shallow(value, nesting):
        raise ValueError(f"nested more than {nesting} deep")
    return value


def json_object(
    path_or_dict: str | os.PathLike[str] | ReadOnlyValues, name: str, most: int, nesting: int = MAX_NESTING
) -> tuple[str, ReadOnlyValues]:
    """Return a source's name, for errors, and its JSON object.

    Args:
        name: of a content without a file.
        most: bytes of a file.

    Raises:
        ValueError: for an unreadable file, or another value.
    """
    if isinstance(path_or_dict, Mapping):
        return name, path_or_dict
    is_path = isinstance(path_or_dict, (str, os.PathLike))
    require((is_path, f"from_json needs the path of a JSON file or a dict, got {path_or_dict!r}"))
    try:
        path = as_path("path", path_or_dict)
        with within(path_or_dict):
            data = read_regular(path, most)
    except OSError as error:
        raise ValueError(in_words(error)) from error
    try:
        content = json_value(data, finite=False, nesting=nesting)
    except ValueError as error:
        raise ValueError(f"{path_or_dict} must be JSON: {error}") from error
    require((isinstance(content, dict), f"{path_or_dict} must hold a JSON object, got {type(content).__name__}"))
    return str(path_or_dict), content


def require_keys(content: Any, names: Sequence[str], optional: Sequence[str] = ()) -> None:
    """Refuse what is no object, and one that lacks a name or has a name beside the optional ones.

    Raises:
        ValueError: names the keys, with the likely one for the first that is unknown.
    """
    require((isinstance(content, Mapping), f"must be an object with {', '.join(names)}, got {content!r:.80}"))
    known = (*names, *optional)
    missing = [name for name in names if name not in content]
    unknown = [str(name)[:80] for name in content if name not in known]
    hint = f"; {did_you_mean(unknown[0], known)}" if unknown else ""
    require(
        (not missing, f"missing keys: {', '.join(missing)}"),
        (not unknown, f"unknown keys: {', '.join(unknown)[:200]}{hint}"),
    )


@cache
def _decoder(finite: bool) -> json.JSONDecoder:
    return json.JSONDecoder(
        object_pairs_hook=_unique,
        parse_int=_integer,
        parse_constant=_no_number if finite else None,
        parse_float=_real if finite else None,
    )


def _unique(pairs: list[tuple[str, Any]]) -> NamedValues:
    values = dict(pairs)
    if len(values) < len(pairs):
        raise ValueError(f"key {repeated(key for key, _ in pairs)[0]!r:.80} occurs twice in one object")
    return values


def _integer(digits: str) -> int:
    if len(digits) > LONGEST_NUMBER + 1:
        raise ValueError(f"an integer has {len(digits):,} digits, the limit is {LONGEST_NUMBER}")
    return int(digits)


def _real(digits: str) -> float:
    value = float(digits)
    require((math.isfinite(value), f"{digits:.80} is beyond what a float64 holds"))
    return value


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")


class _Plain(yaml.SafeLoader):
    """Reads plain values: no aliases, other bases, dates or repeated keys."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse aliases and too deep values before they are made."""
        event = self.peek_event()
        require(
            (not isinstance(event, yaml.AliasEvent), "aliases (*name) are not read: write the value in its place"),
            (getattr(event, "anchor", None) is None, "anchors (&name) are not read: leave them out"),
            (self.depth < MAX_NESTING, f"nested more than {MAX_NESTING} deep"),
        )
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        found: dict[Any, Any] = {}
        for key_node, value_node in node.value:
            require((isinstance(key_node, yaml.ScalarNode), "a key must be a text or a number"))
            key = self.construct_object(key_node)
            require((key not in found, f"key {key!r:.80} occurs twice"))
            found[key] = self.construct_object(value_node, deep=True)
        return found

    def construct_number(self, node: Any) -> Any:
        text = self.construct_scalar(node)
        shown = f"{text:.40} is a number to some programs, a text to others: put it in quotes, or write decimal digits"
        require(
            (NUMBER.fullmatch(text) is not None, shown), (LONG_NUMBER.search(text) is None, f"{text:.40}: too long")
        )
        is_whole = node.tag.endswith(":int")
        return int(text) if is_whole else float(text.replace(".inf", "inf").replace(".nan", "nan"))


NUMBER = re.compile(r"[-+]?(0|[1-9][0-9]*|[0-9]+\.[0-9]*([eE][-+]?[0-9]+)?|\.[0-9]+([eE][-+]?[0-9]+)?|\.inf)|\.nan")

TAGS = ("null", "bool", "str", "seq", "map")

_Plain.yaml_constructors = {
    **{f"tag:yaml.org,2002:{name}": yaml.SafeLoader.yaml_constructors[f"tag:yaml.org,2002:{name}"] for name in TAGS},
    **dict.fromkeys(("tag:yaml.org,2002:int", "tag:yaml.org,2002:float"), _Plain.construct_number),
    None: yaml.SafeLoader.yaml_constructors[None],
}


def yaml_value(content: bytes) -> Any:
    """Return the value of a YAML text in UTF-8.

    Raises:
        ValueError: for anything but YAML of plain values, aliases, and repeated keys.
    """
    try:
        return yaml.load(content.decode("utf-8"), Loader=_Plain)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"must be YAML: {' '.join(str(error).split())}") from None


def files_below(folder: Path, names: Sequence[str] = ()) -> tuple[list[Path], list[Path]]:
    """Return the sorted files in or below a folder, and the folders that are too deep.

    Links to folders count as files. ``names``, if any, are those to find.
    """
    files = []
    deep = []
    waiting = [(folder, 0)]
    while waiting:
        where, depth = waiting.pop()
        entries: list[os.DirEntry[str]] = []
        with suppress(OSError), os.scandir(where) as found:
            entries = list(found)
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                if depth + 1 < MAX_DEPTH:
                    waiting.append((where / entry.name, depth + 1))
                else:
                    deep.append(where / entry.name)
            elif not names or entry.name in names:
                files.append(where / entry.name)
    return sorted(files), sorted(deep)


def one_line_of(error: Exception, file: Path) -> str:
    """Return why a file cannot be read, with the kind of an unforeseen error."""
    foreseen = isinstance(error, (OSError, ValueError)) and not isinstance(error, UnicodeError)
    said = " ".join(in_words(error).split())
    return said if foreseen else f"{file} cannot be read ({type(error).__name__}: {said:.200})"


def too_deep(folder: Path) -> str:
    """Return why a folder is not searched."""
    return f"{folder} is more than {MAX_DEPTH} folders deep, and is not looked into: name it, or one above it"


def sha256_of(path: Path, most: int) -> str:
    """Return the SHA-256 of a regular file, without reading it whole into memory.

    Raises:
        ValueError: for other than regular files, and more than ``most`` bytes.
    """
    found = path.lstat()
    require((stat.S_ISREG(found.st_mode), f"{path} must be a regular file"))
    require((found.st_size <= most, f"{path} has {found.st_size:,} bytes, the limit is {most:,}"))
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
