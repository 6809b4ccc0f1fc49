"""``method.yaml``: what the author of a method says about it, against what its runs say."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, Rule, are_ints, did_you_mean, is_int, is_real, require
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

EXAMPLE: ReadOnlyValues = yaml.safe_load(TEMPLATE)

MOST_BYTES = 2**16

HOURS_APART, SHARE_APART = 0.01, 0.05
"""How far the hours of a ``method.yaml`` may be from those of the logs."""

OURS = "ctgraph_rl"


class Kind(NamedTuple):
    """What a field of a file may hold."""

    holds: Callable[[Any], bool]
    what: str  # in words


def or_null(kind: Kind) -> Kind:
    """Return a kind that may be None."""
    return Kind(lambda value: value is None or kind.holds(value), f"{kind.what} or null")


def matching(pattern: str, what: str) -> Kind:
    """Return the kind of texts that match a whole regular expression."""
    return Kind(lambda value: isinstance(value, str) and re.fullmatch(pattern, value) is not None, what)


def list_of(kind: Kind, what: str) -> Kind:
    """Return the kind of lists of a kind."""
    return Kind(lambda value: isinstance(value, list) and all(map(kind.holds, value)), what)


def kind_rules(values: ReadOnlyValues, kinds: Mapping[str, Kind], owner: str = "") -> list[Rule]:
    """Return the rule of each present field, whose name follows the owner."""
    rules = []
    for name, value in values.items():
        kind = kinds[name]
        rules.append((kind.holds(value), f"{name}{owner} must be {kind.what}, got {value!r:.80}"))
    return rules


TEXT = Kind(lambda value: isinstance(value, str) and bool(value.strip()), "a text")
COUNT = Kind(lambda value: is_int(value, 0), "an integer >= 0")
HOURS = or_null(Kind(lambda value: is_real(value, 0), "a number >= 0"))


KINDS = {
    "name": TEXT,
    "track": or_null(TEXT),
    "track_version": Kind(lambda value: is_int(value, 1), "an integer >= 1"),
    "authors": Kind(lambda value: value != [] and list_of(TEXT, "").holds(value), "a list of names"),
    "paper": or_null(TEXT),
    "code.repository": matching(rf"https?://\S+|{OURS}", f"an address, or {OURS}"),
    "code.commit": matching("[0-9a-f]{7,40}", "7 to 40 hexadecimal digits, in quotes"),
    "code.licence": TEXT,
    "entry_point": or_null(
        matching(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", "module:function, such as my_learner:train,")
    ),
    "given.boundaries": or_null(TEXT),
    "given.task_id": or_null(TEXT),
    "given.guide_frames": or_null(COUNT),
    "bytes_per_task": COUNT,
    "tuning.how": TEXT,
    "tuning.seeds": Kind(lambda value: are_ints(value, 0), "a list of seeds, such as [100, 101]"),
    "compute.hardware": or_null(TEXT),
    "compute.hours": HOURS,
    "compute.tuning_hours": HOURS,
    "failed": Kind(
        lambda value: isinstance(value, Mapping) and are_ints([*value], 0) and all(map(TEXT.holds, value.values())),
        "a reason for each seed, such as {3: out of memory}",
    ),
}
"""Fields by dotted names; only ``track_version`` may be missing, which ``submit`` writes."""

PARTS = ("code", "given", "tuning", "compute")


def read_method(path: Path) -> NamedValues:
    """Read a ``method.yaml``.

    Raises:
        ValueError: for what is no YAML, missing or unknown keys, and values out of range; names all.
        OSError: if it cannot be read.
    """
    require((path.exists(), f"{path} does not exist: ctgraph-rl submit --template > {path} makes one to fill in"))
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
        ValueError: for missing or unknown keys and values out of range; names all.
    """
    fix = "ctgraph-rl submit --template prints one to fill in"
    require((isinstance(method, Mapping), f"it must hold name, authors and so on, got {method!r:.80}; {fix}"))
    values: NamedValues = {}
    rules = []
    for key, value in method.items():
        if key not in PARTS:
            values[key] = value
            continue
        is_part = isinstance(value, Mapping)
        rules.append((is_part, f"{key} must have {', '.join(EXAMPLE[key])}, got {value!r:.80}"))
        for name, each in value.items() if is_part else ():
            values[f"{key}.{name}"] = each
    known = list(KINDS)
    for name in known:
        rules.append((name in values or name == "track_version", f"{name} is missing; it may be null or empty"))
    for name in values:
        rules.append((name in KINDS, f"unknown key {name}: {did_you_mean(str(name), known)}"))
    require(*rules)
    require(*kind_rules(values, KINDS))


def completed(method: ReadOnlyValues, facts: Mapping[str, ReadOnlyValues]) -> NamedValues:
    """Return a method with its nulls filled in from the runs.

    Args:
        method: content of a ``method.yaml``.
    """
    filled = dict(method)
    for part, known in facts.items():
        filled[part] = {key: known.get(key) if value is None else value for key, value in method[part].items()}
    return filled


def facts_of(protocol: Protocol, runs: Sequence[Any]) -> dict[str, NamedValues]:
    """Return what the submitted runs say of the method, under ``given`` and ``compute``."""
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
    """Return the rules that a method does not contradict its runs; nulls contradict nothing.

    Args:
        method: content of a ``method.yaml``.
    """
    rules = []
    for key, known in facts["given"].items():
        said = method["given"][key]
        contradiction = f"given.{key} is {said!r}, the runs were given {known!r}: write null, or that"
        rules.append((said in (None, known), contradiction))
    hours = method["compute"]["hours"]
    logged = facts["compute"]["hours"]
    near = hours is None or abs(hours - logged) <= max(HOURS_APART, SHARE_APART * logged)
    rules.append((near, f"compute.hours is {hours}, the logs of the runs have {logged}: write null, or that"))
    each = method["bytes_per_task"]
    kept = each * (num_tasks - 1)
    largest = max((run.agent_bytes or 0 for run in runs), default=0)
    said = f"bytes_per_task is {each}, {kept:,} bytes for {num_tasks - 1} further tasks"
    rules.append(
        (not largest or kept <= largest, f"{said}, the agents of the runs have {largest:,} bytes in all: correct it")
    )
    return rules
