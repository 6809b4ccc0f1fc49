"""Tensors and plain values of `torch.save`, read without running code or taking more memory than their size."""

from __future__ import annotations

import hashlib
import io
import pickletools
import re
import struct
import zipfile
from collections.abc import Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any

import torch

from ctgraph_rl.checks import memory_bytes, require
from ctgraph_rl.disk import read_regular

SHARE_OF_MEMORY = 4
"""Part of the machine's memory for a file, which is read, checked, made tensors and copied."""

_GLOBALS = re.compile(
    r"torch\._utils _rebuild_(tensor_v2|parameter|parameter_with_state)"
    r"|torch \w+Storage|torch\.storage UntypedStorage|torch [a-z]\w*\d\w*|torch (bool|device|Size)"
    r"|collections OrderedDict|_codecs encode|(__builtin__|builtins) (set|complex)"
)
"""Names in a pickle of tensors and plain values; `torch.load` by itself also makes arrays of any size."""

_FOLLOWS = {"_codecs encode": "BINUNICODE", "collections OrderedDict": "EMPTY_TUPLE"}


def read_content(path: Path) -> bytes:
    """Return the content of a regular file that fits this machine.

    Raises:
        ValueError: for a larger file, or no regular one.
        OSError: if it cannot be read.
    """
    return read_regular(path, memory_bytes() // SHARE_OF_MEMORY)


def read_plain(content: bytes) -> Any:
    """Read tensors and plain values of `torch.save`, on the CPU; nothing else is built, and no code runs.

    Raises:
        ValueError: for anything else, and for values that take many times the file's size in memory.
    """
    require_records(content)
    try:
        value = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # what a pickle that others made may raise is without end
        raise ValueError("holds more than tensors and plain values, or is torn") from error
    num_bytes = len(content)
    parts = [value]
    count = 0
    total = 0
    while parts and count <= num_bytes:
        part = parts.pop()
        count += 1
        if isinstance(part, torch.Tensor):
            total += part.numel() * part.element_size()
        elif isinstance(part, Mapping):
            parts.extend(part.values())
        elif isinstance(part, (list, tuple)):
            parts.extend(part)
    most = memory_bytes() // SHARE_OF_MEMORY
    require(
        (count <= num_bytes, f"has more parts than its {num_bytes:,} bytes, as some stand in many places"),
        (total <= most, f"has tensors of {total:,} bytes, the limit is {most:,}"),
    )
    return value


def without_moments(state: Any) -> Any:
    """Return a learner's state without what its optimisers keep of each weight, such as Adam's moments."""
    if isinstance(state, Mapping):
        if {"state", "param_groups"} <= state.keys():
            return {**state, "state": {}}
        return {name: without_moments(value) for name, value in state.items()}
    return [without_moments(value) for value in state] if isinstance(state, list) else state


def sum_of_state(state: Any) -> str:
    """Return the SHA-256 of tensors and plain values: names, types, shapes and bits, however saved."""
    found = hashlib.sha256()
    for name, value in sorted(_leaves(state), key=itemgetter(0)):
        found.update(f"{name}\n{_described(value)}\n".encode("utf-8", "backslashreplace"))
        if isinstance(value, torch.Tensor):
            found.update(view_bits(value).numpy().tobytes())
    return found.hexdigest()


def count_bytes(state: Any) -> int:
    """Return the bytes of a state's tensors."""
    return sum(value.nbytes for _, value in _leaves(state) if isinstance(value, torch.Tensor))


def view_bits(tensor: torch.Tensor) -> torch.Tensor:
    """Return a tensor's bytes, uint8 [bytes], on the CPU."""
    return tensor.detach().cpu().contiguous().view(-1).view(torch.uint8)


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping) and value:
        for key, item in value.items():
            yield from _leaves(item, f"{name}/{key!r}")
    elif isinstance(value, (list, tuple)) and value:
        for number, item in enumerate(value):
            yield from _leaves(item, f"{name}[{number}]")
    else:
        yield name, value


def _described(value: Any) -> str:
    is_tensor = isinstance(value, torch.Tensor)
    return f"{value.dtype} {list(value.shape)}" if is_tensor else f"{type(value).__name__} {value!r}"


def require_records(content: bytes) -> None:
    """Refuse records that would take more memory than file, before any is read.

    Raises:
        ValueError: for other archives than of `torch.save`, which end with the list of their records, uncompressed and
            without overlap; and for pickles that name more than tensors and plain values.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as records:
            listed = records.infolist()
            end = len(content) - 22
            large = content[end - 20 : end - 16] == b"PK\x06\x07"
            one_list = (
                content[end : end + 4] == b"PK\x05\x06"
                and content[-2:] == b"\0\0"
                and (not large or struct.unpack_from("<Q", content, end - 12)[0] == end - 76)
                and min((record.header_offset for record in listed), default=0) == 0
            )
            stored = all(record.compress_type == zipfile.ZIP_STORED for record in listed)
            total = sum(max(record.file_size, record.compress_size) for record in listed)
            require(
                (one_list, "is no archive of torch.save, whose records begin at its start and are listed at its end"),
                (stored, "has compressed records, which torch.save does not write"),
                (total <= len(content), f"says that its records have {total:,} bytes, and has {len(content):,}"),
            )
            pickles = [records.read(record) for record in listed if record.filename.endswith("/data.pkl")]
        require((len(pickles) == 1, "holds more than tensors and plain values, or is torn"))
        names = list(_names(pickles[0]))
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, struct.error) as error:
        raise ValueError("holds more than tensors and plain values, or is torn") from error
    other = [name for name, follows in names if not _GLOBALS.fullmatch(name) or follows != _FOLLOWS.get(name, follows)]
    require((not other, f"holds more than tensors and plain values: {', '.join(other[:3])!r:.80}"))


def _names(pickled: bytes) -> Iterator[tuple[str, str]]:
    known: dict[Any, str] = {}
    name = ""
    last = ""
    for operation, argument, _ in pickletools.genops(pickled):
        if "PUT" in operation.name:
            known[argument] = last
            continue
        if name:
            yield name, operation.name
        name = _named(operation.name, argument, known)
        last = name


def _named(operation: str, argument: Any, known: dict[Any, str]) -> str:
    if operation == "GLOBAL":
        return argument
    if operation in ("STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4", "OBJ", "MEMOIZE"):
        return operation  # which torch.save does not write
    return known.get(argument, "") if "GET" in operation else ""
