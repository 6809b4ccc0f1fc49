"""Compares two runs: equal, equal up to rounding, or different, since when and in what."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ctgraph_rl import parsers
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, is_real, positive, require
from ctgraph_rl.log.escape import listed, refused_by, terminal_lines, terminal_text
from ctgraph_rl.log.files import AGENT, LOG, no_run
from ctgraph_rl.log.measurement import without_time
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.saved import read_content, read_plain, view_bits
from ctgraph_rl.parsers import BOUND
from ctgraph_rl.runs.settings import ADDED, as_before, flat

EQUAL, DIFFERENT, ROUNDING = 0, 1, 3
"""Exit codes."""

TOGETHER = "seeds trained together"
EXPERTS_TOGETHER = "seeds of experts trained together"

PARTS = {
    "curriculum": ("curriculum", "version", "fingerprint", "source", "tasks", "trained"),
    TOGETHER: ("together",),
    "machine": ("machine", "num_threads", "cpu"),
}
"""Keys of a log's first line by meaning; others, but for settings, are code."""

LogLine = ReadOnlyValues


class Compared(NamedTuple):
    """An exit code and lines to print."""

    code: int
    lines: list[str]


def compare(one: Path, other: Path, bound: float = BOUND) -> Compared:
    """Compare two run directories, finished or not.

    Raises:
        ValueError: for a directory without a run, and a log or weights that cannot be read.
    """
    logs = [_log(one), _log(other)]
    code, verdict = _verdict([list(map(_measured, log.measurements[1:])) for log in logs], bound)
    weights = _weights(one, other)
    if code == EQUAL and weights.startswith("different"):
        code = DIFFERENT
        verdict = "different: all measurements are equal, the agents' weights are not"
    lines = [verdict, f"weights: {weights}"]
    firsts = [log.measurements[0] for log in logs]
    parts, others = map(_parts, firsts)
    if not any(first.get("together") for first in firsts):
        del parts[TOGETHER]
    lines += [_compared(name, part, others[name], 10) for name, part in parts.items()]
    experts, others = map(_seeds_of_experts, logs)
    if any((*experts.values(), *others.values())):
        lines.append(_compared(EXPERTS_TOGETHER, experts, others, 3))
    for path, log in zip((one, other), logs, strict=True):
        if log.torn_lines:
            lines.append(f"note: the last line of {path / LOG} is torn and not compared")
    return Compared(code, lines)


def _measured(line: LogLine) -> LogLine:
    line = without_time(line)
    if line["kind"] != "experts" or not isinstance(line.get("experts"), list):
        return line
    alone = [{**each, "together": None} if isinstance(each, dict) else each for each in line["experts"]]
    return {**line, "experts": alone}


def _seeds_of_experts(log: RunLog) -> NamedValues:
    found = {}
    for line in log.of_kind("experts"):
        for each in line.get("experts", ()):
            if isinstance(each, dict):
                found[f"task {each.get('task')}"] = each.get("together")
    return found


def _compared(name: str, one: ReadOnlyValues, other: ReadOnlyValues, most: int) -> str:
    return f"{name}: {'equal' if one == other else 'different, ' + _changes(one, other, most)}"


def _log(path: Path) -> RunLog:
    require(((path / LOG).is_file(), no_run(path, below=False)))
    log = RunLog.read(path / LOG)
    begins = bool(log.measurements) and log.measurements[0]["kind"] == "run"
    require((begins, f"{path / LOG} does not say what was run in its first line"))
    return log


def _verdict(found: Sequence[Sequence[LogLine]], bound: float) -> tuple[int, str]:
    scale: dict[str, float] = {}
    for line in chain(*found):
        for key, value in line.items():
            if is_real(value):
                scale[key] = max(scale.get(key, 0.0), abs(value))
    lengths = list(map(len, found))
    unequal = None
    beyond = None
    for pair in zip(*found, strict=False):
        if pair[0] != pair[1] and beyond is None:
            unequal = unequal or pair
            beyond = None if _is_rounding(pair[0], pair[1], bound, scale) else pair
    if unequal is None and lengths[0] == lengths[1]:
        return EQUAL, f"equal: all {lengths[0]} measurements, bit for bit"
    if unequal is None:
        return DIFFERENT, f"different: equal as far as both go, {min(lengths)} of {lengths[0]} and {lengths[1]} lines"
    since = f"{_where(unequal[0])}: {_changes(unequal[0], unequal[1], 3)}"
    if beyond is None and lengths[0] == lengths[1]:
        within = f"all measurements agree within {bound:g} of their field's largest value"
        return ROUNDING, f"equal up to rounding: {within}; they diverge at {since}"
    more = "" if beyond is None or beyond is unequal else f"; beyond rounding ({bound:g}) at {_where(beyond[0])}"
    return DIFFERENT, f"different since {since}{more}"


def _is_rounding(one: LogLine, other: LogLine, bound: float, scale: Mapping[str, float]) -> bool:
    for key in _differing(one, other):
        first = one.get(key)
        second = other.get(key)
        if not (isinstance(first, float) and isinstance(second, float)):
            return False
        if abs(first - second) > bound * scale[key]:
            return False
    return True


def _differing(one: ReadOnlyValues, other: ReadOnlyValues) -> list[str]:
    return [key for key in {**one, **other} if one.get(key) != other.get(key)]


def _where(line: LogLine) -> str:
    label = f" of {line['label']}" if "label" in line else ""
    block = f" in block {line['block']}" if "block" in line else ""
    frames = f" after {line['frames']:,} frames" if is_real(line.get("frames")) else ""
    return terminal_text(f"{line['kind']}{label}{block}{frames}")


def _changes(one: ReadOnlyValues, other: ReadOnlyValues, most: int) -> str:
    pairs = [f"{key} {one.get(key)!r} and {other.get(key)!r}" for key in _differing(one, other)]
    return terminal_text(listed(pairs, most))


def _weights(one: Path, other: Path) -> str:
    missing = [str(path) for path in (one, other) if not (path / AGENT).exists()]
    if missing:
        return terminal_text(f"not compared, {' and '.join(missing)} has no {AGENT}")
    state = dict(flat(_state(one / AGENT)))
    others = dict(flat(_state(other / AGENT)))
    if list(state) != list(others):
        return "different: the agents have other parts"
    unequal = [key for key in state if not _same(state[key], others[key])]
    if not unequal:
        return "equal, bit for bit"
    return f"different in {len(unequal)} of {len(state)} parts: {terminal_text(listed(unequal))}"


def _state(path: Path) -> ReadOnlyValues:
    content = read_content(path)
    try:
        state = read_plain(content)
        require((isinstance(state, Mapping), "holds no state of an agent"))
    except ValueError as error:
        raise ValueError(f"{path} {error}: restore it") from error
    return state


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        alike = (one.dtype, one.shape) == (other.dtype, other.shape)
        return alike and torch.equal(view_bits(one), view_bits(other))
    if isinstance(one, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return list(one) == list(other) and all(_same(one[key], other[key]) for key in one)
    return type(one) is type(other) and bool(one == other)


def _parts(line: LogLine) -> dict[str, NamedValues]:
    left = dict(line)
    for key in ("kind", "seconds", "config"):
        left.pop(key, None)
    parts = {"settings": {**ADDED.get("run", {}), **dict(flat(as_before(line.get("config") or {})))}}
    for name, keys in PARTS.items():
        parts[name] = {key: left.pop(key, None) for key in keys}
    parts["code"] = dict(flat(left))
    return parts


def main() -> None:
    """Compare two run directories."""
    parser = parsers.compare()
    arguments = parser.parse_args()
    with refused_by(parser):
        require(*positive(bound=arguments.bound))
        found = compare(arguments.one, arguments.other, arguments.bound)
    print(terminal_lines("\n".join(found.lines)))
    sys.exit(found.code)


if __name__ == "__main__":
    main()
