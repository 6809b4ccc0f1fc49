"""The command ``ctgraph-rl submit``: finished runs become a folder that others can check."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, filterfalse
from pathlib import Path

from ctgraph_rl import parsers
from ctgraph_rl.board.method_yaml import TEMPLATE, completed, fact_rules, facts_of, read_method
from ctgraph_rl.board.rescore import curriculum_rule, entry_rule, oracle_rule, seed_rules
from ctgraph_rl.board.submission import (
    LOGS,
    SUBMISSION,
    Submission,
    SubmittedRun,
    log_name,
    log_sum,
    packed,
    read_submission,
    submission_text,
)
from ctgraph_rl.board.tracks import Track, track
from ctgraph_rl.checks import ReadOnlyValues, Rule, require
from ctgraph_rl.disk import make_folder, new_folder, require_new, write_whole
from ctgraph_rl.log.escape import listed, refused_by, terminal_text
from ctgraph_rl.log.files import AGENT, CURRICULUM, LOG, locked_new
from ctgraph_rl.log.provenance import NUMBERS, code_changes
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.saved import count_bytes, read_content, read_plain, sum_of_state
from ctgraph_rl.log.sources import SCRIPTS, find_sources
from ctgraph_rl.log.sums import damaged
from ctgraph_rl.runs.read import Run, find_runs, why_left_out
from ctgraph_rl.runs.settings import flat
from ctgraph_rl.tasks.curriculum import Curriculum


def submit(
    paths: Sequence[Path],
    to: Path,
    method: ReadOnlyValues,
    of_track: Track | None = None,
    only: ReadOnlyValues | None = None,
) -> Submission:
    """Make a submission of runs; return it, read from its folder.

    Args:
        method: content of a ``method.yaml``, from `ctgraph_rl.board.method_yaml.read_method`.
        only: settings by dotted names, such as ``{"curriculum.depth": 4}``; runs with others are left out.

    Raises:
        ValueError: for runs that cannot be submitted; names every broken rule, before anything is written.
        FileExistsError: if the folder exists.
        BlockingIOError: if another process makes it.
    """
    require_new(to)
    runs = _found(paths, only or {})
    curriculum = _checked(runs, method, of_track)
    lines = []
    for run in runs:
        lines.append(_line(run, method["failed"].get(run.seed)))
    facts = facts_of(curriculum.protocol, lines)
    require(*fact_rules(method, facts, lines, len(curriculum.tasks)))
    about = completed(method, facts)
    about.pop("track_version", None)
    about["track"] = None
    if of_track is not None:
        about |= {"track": of_track.name, "track_version": of_track.version}
    make_folder(to.absolute().parent)
    with locked_new(to), new_folder(to) as folder:
        make_folder(folder / LOGS)
        for run, line in zip(runs, lines, strict=True):
            write_whole(folder / log_name(line.run), packed((run.path / LOG).read_bytes()))
        config = dict(runs[0].about["config"])
        config.pop("seed", None)
        content = submission_text(about, config, runs[0].about["versions"], curriculum, tuple(lines))
        write_whole(folder / SUBMISSION, content)
        made = read_submission(folder, None if of_track is None else of_track.config_dir)
    return replace(made, path=to)


def _found(paths: Sequence[Path], only: ReadOnlyValues) -> list[Run]:
    found, problems = find_runs(paths)
    errors = [problem for problem in problems if problem.is_error]
    require((not errors and bool(found), why_left_out(problems)))
    chosen = []
    values: dict[str, dict[str, None]] = {key: {} for key in only}
    for run in found:
        settings = {**dict.fromkeys(only), **dict(flat(run.about["config"]))}
        if only.items() <= settings.items():
            chosen.append(run)
        for key, own in values.items():
            own[str(settings[key])] = None
    there = [f"{key}={listed(own)}" for key, own in values.items()]
    require((bool(chosen), f"no run is left by --only; there are {'; '.join(there)}"))
    return sorted(chosen, key=lambda run: run.seed)


def _checked(runs: Sequence[Run], method: ReadOnlyValues, of_track: Track | None) -> Curriculum:
    seeds = [run.seed for run in runs]
    rules = [*same_rules(runs), *code_rules(runs), *failure_rules(runs, method["failed"])]
    rules += seed_rules(seeds, method["tuning"]["seeds"], of_track)
    config = runs[0].about["config"]
    rules += [entry_rule(config, method["entry_point"]), oracle_rule(config)]
    curricula = [run.path / CURRICULUM for run in runs]
    unwritten = list(filterfalse(Path.exists, curricula))
    fix = "as of curricula with classes of your own: submit a named curriculum"
    rules.append((not unwritten, f"{listed(unwritten)} is missing, {fix}"))
    if unwritten:
        require(*rules)
    first = Curriculum.from_json(curricula[0])
    other = [run.path for run in runs if run.curriculum[1] != first.fingerprint]
    rules.append((not other, f"the logs of {listed(other)} are of another curriculum than {curricula[0]}"))
    require(*rules, curriculum_rule(first, of_track))
    return first


def _line(run: Run, reason: str | None) -> SubmittedRun:
    log = RunLog.read(run.path / LOG)
    agent = run.path / AGENT
    state = None
    if run.reason is None and agent.exists():
        try:
            state = read_plain(read_content(agent))
        except ValueError as error:
            raise ValueError(f"{agent} {error}: save a state_dict there, or nothing") from error
    return SubmittedRun(
        run=f"seed{run.seed}",
        seed=run.seed,
        reason=reason,
        group=tuple(run.about.get("together") or ()),
        agent_sha256=None if state is None else sum_of_state(state),
        agent_bytes=None if state is None else count_bytes(state),
        log_sha256=log_sum(log),
        machine=str(run.about.get("machine", "")),
        num_threads=int(run.about.get("num_threads", 1)),
        cpu=str(run.about.get("cpu") or ""),
        seconds=float(log.measurements[-1].get("seconds", 0.0)),
    )


def same_rules(runs: Sequence[Run]) -> Iterator[Rule]:
    """Yield the rules that all runs have one configuration, curriculum and code."""
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
    found = {}
    for name in dict.fromkeys(chain(*given)):
        values: dict[str, None] = {}
        for each in given:
            values[json.dumps(each.get(name, absent), sort_keys=True).strip('"')] = None
        if len(values) > 1:
            found[name] = " and ".join(values)
    return found


def code_rules(runs: Sequence[Run]) -> Iterator[Rule]:
    """Yield the rules that the code of all runs is known and unchanged."""
    unknown: list[Path] = []
    unsaid: list[Path] = []
    changed: dict[str, None] = {}
    for run in runs:
        if None in run.code.values():
            unknown.append(run.path)
        elif run.about.get("sources") is None:
            unsaid.append(run.path)
        stored = run.about.get("sources")
        sources = None
        if stored is not None:
            sources = {**dict.fromkeys(stored), **find_sources(stored.keys() - {*SCRIPTS})}
        now = {"fingerprint": run.about["fingerprint"], "numbers": NUMBERS, "sources": sources}
        changed |= dict.fromkeys(code_changes(run.about, now))
    fix = "run again from files, and with Recorder(code=[MyLearner])"
    yield not unknown + unsaid, f"{listed(unknown + unsaid)} do not say of which source they are: {fix}"
    yield not changed, f"the code has changed since the runs, {listed(changed)}: run again, or submit with that code"


def failure_rules(runs: Sequence[Run], reasons: Mapping[int, str]) -> Iterator[Rule]:
    """Yield the rules that every run is finished and whole, or has a reason by its seed."""
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


def main() -> None:
    """Make a submission, or print a ``method.yaml`` to fill in."""
    parser = parsers.submit()
    arguments = parser.parse_args()
    if arguments.template:
        print(TEMPLATE, end="")
        return
    if not arguments.runs or arguments.to is None:
        parser.error("give run directories and --to DIR, or --template")
    sys.path.append(os.getcwd())  # where a user's own modules may be, as in a run
    with refused_by(parser):
        method = read_method(arguments.method)
        name = method["track"] if arguments.track is None else arguments.track
        of_track = None if name is None else track(name, arguments.config_dir)
        made = submit(arguments.runs, arguments.to, method, of_track, dict(arguments.only))
    print(summary(made))


def summary(made: Submission) -> str:
    """Return in words what a submission holds, and what to do next."""
    count = len(made.runs)
    finished = len(made.finished)
    failed = f", {count - finished} of them failed" if finished < count else ""
    where = "for no track" if made.track is None else f"for track {made.track.id}"
    lines = [
        f"submission of {made.method['name']} {where}, on {made.curriculum.name}",
        f"runs: {count}{failed}",
        f"digest: {made.digest}",
        f"files: {made.path}; ctgraph-rl verify {made.path} --level rescored checks them",
    ]
    return "\n".join(map(terminal_text, lines))


if __name__ == "__main__":
    main()
