"""``method.yaml``: what the author of a method says about it, and what its runs say themselves."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from ctgraph_rl.checks import (
    NamedValues,
    ReadOnlyValues,
    Rule,
    are_ints,
    did_you_mean,
    is_int,
    is_real,
    is_shallow,
    require,
)
from ctgraph_rl.disk import read_regular
from ctgraph_rl.strict import named, yaml_value
from ctgraph_rl.tasks.protocol import Protocol

TEMPLATE = """\
# About a method, for ctgraph-rl submit RUNS --method method.yaml --to DIR. Of given, hardware and hours, null takes
# what the runs say.
name: null                  # the name that a board shows, such as PPO with EWC
track: null                 # the track of the submission, such as small; --track names it, too
authors: []                 # their names, such as [Ada Lovelace, Alan Turing]
paper: null                 # the address of a paper, or null
code:
  repository: null          # the address of the source of the learner; ctgraph_rl: it is in this package
  commit: null              # the commit that was run, 7 to 40 hexadecimal digits in quotes
  licence: null             # its licence, by SPDX identifier, such as MIT
entry_point: null           # module:function that trains one seed, for learners that a Recorder measured; else null
given:                      # the information that the learner is given; null: as the runs say
  boundaries: null          # announced or hidden
  task_id: null             # hidden, one_hot or at_boundaries
  guide_frames: null        # frames of a block over which a policy that navigates acts in the learner's place
bytes_per_task: 0           # bytes that the learner keeps for each further task; 0 if only weights of a constant size
tuning:
  how: null                 # how settings were chosen, and over which values; not tuned if they were not
  seeds: []                 # the seeds of the runs by which they were chosen; none of them may be submitted
compute:
  hardware: null            # such as 1 core of an AMD EPYC 9654; null: as the runs say
  hours: null               # of the submitted runs, on this hardware; null: as the runs say
  tuning_hours: null        # of the runs by which settings were chosen
failed: {}                  # seeds of runs without results, each with the reason, such as {3: out of memory}
"""
"""A ``method.yaml`` to fill in, with a comment on every line."""


MOST_BYTES = 2**16
"""Largest ``method.yaml`` that is read."""

MAX_NESTING = 4

EXAMPLE: ReadOnlyValues = yaml.safe_load(TEMPLATE)

ENTRY_POINT = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")
COMMIT = re.compile(r"[0-9a-f]{7,40}")
HOURS_APART, SHARE_APART = 0.01, 0.05
"""How far the hours of a ``method.yaml`` may be from those of the logs."""

OURS = "ctgraph_rl"
"""Stands for the repository of this package."""

ADDRESS = re.compile(r"https?://\S+")


def read_method(path: Path) -> NamedValues:
    """Read a ``method.yaml``.

    Raises:
        ValueError: for what is no YAML, a missing or unknown key, and values out of range; names all of them.
        OSError: if it cannot be read.
    """
    with named(path):
        method = yaml_value(read_regular(path, MOST_BYTES))
    try:
        check_method(method)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return dict(method)


def track_version(method: ReadOnlyValues) -> Any:
    """Return the version of the track that a method was submitted to."""
    return method.get("track_version", 1)


def check_method(method: Any) -> None:
    """Refuse what does not describe a method.

    Raises:
        ValueError: for a missing or unknown key, and values out of range; names all of them.
    """
    plain = isinstance(method, Mapping) and is_shallow(method, MAX_NESTING)
    fix = "ctgraph-rl submit --template prints one to fill in"
    require((plain, f"it must hold name, authors and so on, got {method!r:.80}; {fix}"))
    require(*_key_rules(method, EXAMPLE, ""))
    require(*_rules(method))


def _key_rules(given: ReadOnlyValues, example: ReadOnlyValues, prefix: str) -> list[Rule]:
    """Return the rules that an object has the keys of another one, and so have its parts."""
    rules = [(key in given, f"{prefix}{key} is missing; it may be null or empty") for key in example]
    known = [*example] if prefix else [*example, "track_version"]  # which earlier submissions do not have
    rules += [(key in known, f"unknown key {prefix}{key}: {did_you_mean(str(key), known)}") for key in given]
    for key, part in example.items():
        if isinstance(part, Mapping) and part and key in given:
            is_part = isinstance(given[key], Mapping)
            rules.append((is_part, f"{key} must have {', '.join(part)}, got {given[key]!r:.80}"))
            rules += _key_rules(given[key], part, f"{key}.") if is_part else []
    return rules


def _rules(method: ReadOnlyValues) -> list[Rule]:
    """Return the rules for the values of an object with the right keys."""
    code = method["code"]
    tuning = method["tuning"]
    compute = method["compute"]
    authors = method["authors"]
    failed = method["failed"]
    listed = isinstance(authors, list) and bool(authors) and all(map(_is_text, authors))
    reasons = isinstance(failed, Mapping) and are_ints(list(failed), 0) and all(map(_is_text, failed.values()))
    seeds = tuning["seeds"]
    repository = code["repository"]
    commit = code["commit"]
    given = method["given"]
    return [
        _text_rule("name", method["name"]),
        _text_rule("code.licence", code["licence"]),
        _text_rule("given.boundaries", given["boundaries"], or_null=True),
        _text_rule("given.task_id", given["task_id"], or_null=True),
        _text_rule("track", method["track"], or_null=True),
        _text_rule("paper", method["paper"], or_null=True),
        _text_rule("tuning.how", tuning["how"]),
        _text_rule("compute.hardware", compute["hardware"], or_null=True),
        (listed, f"authors must be a list of names, got {authors!r:.80}"),
        (
            repository == OURS or _matches(ADDRESS, repository),
            f"code.repository must be an address, or {OURS}, got {repository!r:.80}",
        ),
        (_matches(COMMIT, commit), f"code.commit must be 7 to 40 hexadecimal digits, in quotes, got {commit!r:.80}"),
        (
            method["entry_point"] is None or _matches(ENTRY_POINT, method["entry_point"]),
            f"entry_point must be module:function, such as my_learner:train, got {method['entry_point']!r:.80}",
        ),
        (is_int(track_version(method), 1), f"track_version must be an integer >= 1, got {track_version(method)!r:.80}"),
        _count_rule("given.guide_frames", given["guide_frames"], or_null=True),
        _count_rule("bytes_per_task", method["bytes_per_task"]),
        (are_ints(seeds, 0), f"tuning.seeds must be a list of seeds, such as [100, 101], got {seeds!r:.80}"),
        _hours_rule("hours", compute["hours"]),
        _hours_rule("tuning_hours", compute["tuning_hours"]),
        (reasons, f"failed must have a reason for each seed, such as {{3: out of memory}}, got {failed!r:.80}"),
    ]


def _is_text(value: object) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _matches(pattern: re.Pattern[str], value: object) -> bool:
    return isinstance(value, str) and pattern.fullmatch(value) is not None


def _text_rule(name: str, value: object, or_null: bool = False) -> Rule:
    return _rule(name, value, _is_text(value), "a text", or_null)


def _count_rule(name: str, value: object, or_null: bool = False) -> Rule:
    return _rule(name, value, is_int(value, 0), "an integer >= 0", or_null)


def _hours_rule(name: str, value: object) -> Rule:
    return _rule(f"compute.{name}", value, is_real(value, 0), "a number >= 0", or_null=True)


def _rule(name: str, value: object, holds: bool, what: str, or_null: bool) -> Rule:
    choice = f"{what} or null" if or_null else what
    return holds or (or_null and value is None), f"{name} must be {choice}, got {value!r:.80}"


def completed(method: ReadOnlyValues, facts: Mapping[str, ReadOnlyValues]) -> NamedValues:
    """Return a method with what is null in it as the runs say it.

    Args:
        method: what a ``method.yaml`` holds.
        facts: what the runs say, as `facts_of` returns it.
    """
    filled = dict(method)
    for part, known in facts.items():
        filled[part] = {key: known.get(key) if value is None else value for key, value in method[part].items()}
    return filled


def facts_of(protocol: Protocol, runs: Sequence[Any]) -> dict[str, NamedValues]:
    """Return what the runs of a submission say of the method themselves.

    Args:
        protocol: of what they learned.
        runs: the submitted runs.
    """
    given = {key: getattr(protocol, key) for key in EXAMPLE["given"]}
    shared: dict[Any, float] = {}
    machines: dict[str, None] = {}
    for run in runs:
        shared[run.seeds] = max(shared.get(run.seeds, 0.0), run.seconds)
        machines[f"{run.cpu or run.machine}, threads: {run.num_threads}"] = None
    hours = round(math.fsum(shared.values()) / 3600, 4)
    return {"given": given, "compute": {"hardware": "; ".join(machines), "hours": hours}}


def fact_rules(
    method: ReadOnlyValues, facts: Mapping[str, ReadOnlyValues], runs: Sequence[Any], num_tasks: int
) -> list[Rule]:
    """Return the rules that a method does not contradict its runs; what is null in it contradicts nothing.

    Args:
        method: what a ``method.yaml`` holds.
        facts: what the runs say.
        runs: the submitted runs.
        num_tasks: of the curriculum.
    """
    hours = method["compute"]["hours"]
    logged = facts["compute"]["hours"]
    near = hours is None or abs(hours - logged) <= max(HOURS_APART, SHARE_APART * logged)
    kept = method["bytes_per_task"] * (num_tasks - 1)
    largest = max((run.agent_bytes or 0 for run in runs), default=0)
    fits = not largest or kept <= largest
    all_kept = f"{kept:,} bytes for {num_tasks - 1} further tasks"
    further = method["bytes_per_task"]
    less = f"bytes_per_task is {further}, {all_kept}, the agents of the runs have {largest:,} bytes in all: correct it"
    rules = []
    for key, known in facts["given"].items():
        said = method["given"][key]
        rules.append(
            (said in (None, known), f"given.{key} is {said!r}, the runs were given {known!r}: write null, or that")
        )
    rules.append((near, f"compute.hours is {hours}, the logs of the runs have {logged}: write null, or that"))
    return [*rules, (fits, less)]
