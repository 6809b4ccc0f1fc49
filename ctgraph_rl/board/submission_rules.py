"""What a submission must hold to: rules over its runs, its curriculum and what is said of the method.

A rule is a pair of (holds, message), for `ctgraph_rl.checks.require`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from ctgraph_rl.board.tracks import Track
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, Rule
from ctgraph_rl.log.damage import damaged
from ctgraph_rl.log.escape import listed
from ctgraph_rl.log.provenance import NUMBERS, code_changes, is_published
from ctgraph_rl.log.sources import SCRIPTS, find_sources
from ctgraph_rl.packages import class_named
from ctgraph_rl.runs.load import OURS
from ctgraph_rl.runs.read import MODIFIED, Run
from ctgraph_rl.runs.settings import with_added
from ctgraph_rl.tasks.curriculum import Curriculum

OF_OURS = "baselines."
"""Beginning of the names of our classes."""

MAY_BE_READ = ("", "the frames of each block")
"""What methods may read of tasks beside what the protocol gives: a track fixes the frames of its blocks."""


def curriculum_rule(curriculum: Curriculum, of_track: Track | None) -> Rule:
    """Return the rule that a curriculum is one of a track, or without a track the published one of its name."""
    name = curriculum.name.removesuffix(MODIFIED)
    found = curriculum.fingerprint
    if of_track is not None:
        wanted = of_track.by_fingerprint
        return found in wanted, (
            f"curriculum {name} has fingerprint {found}, track {of_track.id} has {', '.join(wanted)}: "
            f"run ctgraph-rl -m track={of_track.name}, with no other curriculum, protocol or evaluation"
        )
    published = is_published(replace(curriculum, name=name))
    if published is None:
        return False, f"no published curriculum is named {name}: run a published one, or name a track that has it"
    fix = "run it without changes, or name a track that has it"
    return published, f"curriculum {name} (fingerprint {found}) is not the published one, it was modified: {fix}"


def seed_rules(seeds: Iterable[int], tuned: Iterable[int], of_track: Track | None) -> list[Rule]:
    """Return the rules that the seeds are those of the track, and that none was used for tuning.

    Args:
        seeds: of the runs.
        tuned: seeds that the method says it was tuned on.
        of_track: the track; None: any seeds that were not used for tuning.
    """
    own = set(seeds)
    used = own & set(tuned)
    rules = [(not used, f"seeds {listed(sorted(used))} are among tuning.seeds: submit runs of other seeds")]
    if of_track is None:
        return rules
    wanted = set(of_track.seeds)
    reserved = own & set(of_track.tuning_seeds)
    missing = wanted - own
    others = own - wanted - reserved
    asked = f"track {of_track.id} has seeds {_ranges(wanted)}"
    return [
        *rules,
        (not missing, f"seeds {listed(sorted(missing))} are missing: {asked}"),
        (not reserved, f"seeds {listed(sorted(reserved))} are for tuning: {asked}"),
        (not others, f"seeds {listed(sorted(others))} are of no submission: {asked}"),
    ]


def _ranges(seeds: Iterable[int]) -> str:
    """Return seeds in words, such as ``0..9``."""
    ordered = sorted(seeds)
    whole = len(ordered) > 2 and ordered == list(range(ordered[0], ordered[-1] + 1))
    return f"{ordered[0]}..{ordered[-1]}" if whole else ", ".join(map(str, ordered))


def same_rules(runs: Sequence[Run]) -> Iterator[Rule]:
    """Yield the rules that all runs are of one configuration, one curriculum and one code."""
    nameless = [run.path for run in runs if run.agent is None]
    fix = 'give Recorder(about={"learner": ...})'
    yield not nameless, f"{listed(nameless)} do not name their learner: {fix}"
    curricula = {f"{run.curriculum[0]} (fingerprint {run.curriculum[1]})" for run in runs}
    yield len(curricula) == 1, f"runs are of several curricula, {listed(sorted(curricula))}: submit those of one"
    several = {} if nameless else _differing([run.settings for run in runs])
    shown = listed(map("=".join, several.items()))
    yield not several, f"runs are of several configurations, {shown}: submit those of one"
    mixed = _differing([run.code for run in runs], absent="")
    yield not mixed, f"runs are of different code, {listed(mixed)} differs between them: run all with one"
    other = _differing([run.about.get("versions") or {} for run in runs])
    shown = listed(map(" ".join, other.items()))
    yield not other, f"runs are of different versions, {shown}: run all with one"


def _differing(given: Sequence[ReadOnlyValues], absent: object = None) -> dict[str, str]:
    """Return the names that have several values, each with these in words."""
    found = {}
    for name in dict.fromkeys(chain(*given)):
        values: dict[str, None] = {}
        for each in given:
            values[json.dumps(each.get(name, absent), sort_keys=True).strip('"')] = None
        if len(values) > 1:
            found[name] = " and ".join(values)
    return found


def code_rules(runs: Sequence[Run]) -> Iterator[Rule]:
    """Yield the rules that the code of all runs is known, and that it has not changed since."""
    unknown: list[Path] = []
    unsaid: list[Path] = []
    changed: dict[str, None] = {}
    for run in runs:
        if None in run.code.values():
            unknown.append(run.path)
        elif run.about.get("sources") is None:
            unsaid.append(run.path)
        changed |= dict.fromkeys(code_changes(run.about, _code_now(run.about)))
    fix = "run again from files, and with Recorder(code=[MyLearner])"
    yield not unknown + unsaid, f"{listed(unknown + unsaid)} do not say of which source they are: {fix}"
    yield not changed, f"the code has changed since the runs, {listed(changed)}: run again, or submit with that code"


def _code_now(about: ReadOnlyValues) -> NamedValues:
    """Return the code of this process, as far as a run's log names its parts; None for what cannot be found."""
    stored = about.get("sources") or {}
    found = find_sources(stored.keys() - {*SCRIPTS})
    sources = {**dict.fromkeys(stored), **found} if about.get("sources") is not None else None
    return {"fingerprint": about["fingerprint"], "numbers": NUMBERS, "sources": sources}


def failure_rules(runs: Sequence[Run], reasons: Mapping[int, str]) -> Iterator[Rule]:
    """Yield the rules that every run is finished and whole, or accounted for.

    Args:
        runs: the runs.
        reasons: why runs failed or were stopped, by seed.
    """
    for run in runs:
        known = run.seed in reasons
        fix = f"finish it, or account for it: failed: {{{run.seed}: why}} in method.yaml"
        if run.reason is not None:
            yield known, f"{run.path} has no results ({run.reason}): {fix}"
            continue
        yield not known, f"failed has seed {run.seed}, but {run.path} is finished: remove the seed from failed"
        lost = damaged(run.path)
        yield not lost, f"{run.path} has files that are not as they were written, {listed(lost)}: run it again"
    without = sorted(set(reasons) - {run.seed for run in runs})
    yield not without, f"failed has seeds {listed(without)}, of which there is no run: give their directories, too"


def entry_rule(config: ReadOnlyValues, entry_point: str | None) -> Rule:
    """Return the rule that there is a way to run a configuration again."""
    agent = config.get("agent")
    is_built = isinstance(agent, Mapping) and "_target_" in agent
    fix = "set entry_point: module:function in method.yaml, a function (curriculum, seed, run_dir) that trains a run"
    return is_built or entry_point is not None, f"no agent can be built from the configuration of the runs: {fix}"


def oracle_rule(config: ReadOnlyValues) -> Rule:
    """Return the rule that a method or detector of ours reads no more of the tasks than the learner is given.

    A class of `baselines` goes by the name of the module that defines it only: what other names stand for is unknown.
    """
    unknown = []
    named = []
    parts: dict[str, object] = {}
    for group in ("method", "detector"):
        settings = config.get(group)
        if not isinstance(settings, Mapping):
            continue
        name = str(settings.get("_target_"))
        kind = _kind(group, name)
        part = None if kind is None else _part(kind, settings)
        if part is not None:
            parts[group] = part
            named.append(f"{group}={type(part).__name__}")
        elif kind is None and name.startswith(OF_OURS):
            unknown.append(f"{group}={name}")
    if unknown:
        return False, f"{listed(unknown)} is no method or detector of baselines: name it by the module that defines it"
    reads = getattr(parts.get("method"), "reads_tasks", "")
    is_oracle = getattr(parts.get("detector"), "is_oracle", False)
    return reads in MAY_BE_READ and not is_oracle, (
        f"{' '.join(named)} is an oracle, which reads {reads or 'the true tasks'}: it is a reference for others, "
        f"submit runs without it"
    )


def _kind(part: str, name: str) -> type | None:
    """Return the class of `baselines` that a group names; None for any other."""
    ours = OURS[part].fullmatch(name)
    return None if ours is None else class_named(ours[1], ours[2])


def _part(kind: type, settings: ReadOnlyValues) -> object:
    """Return what a group of a configuration builds of one of our classes; None for settings of another version."""
    try:
        return kind(**{key: value for key, value in with_added(settings).items() if not key.startswith("_")})
    except (TypeError, ValueError):
        return None
