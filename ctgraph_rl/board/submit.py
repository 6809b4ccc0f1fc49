"""The command ``ctgraph-rl submit``: finished runs become a folder of files that others can check."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping, Sequence
from itertools import filterfalse
from pathlib import Path
from typing import Any

from ctgraph_rl import parsers
from ctgraph_rl.board import submission as files
from ctgraph_rl.board.method_yaml import TEMPLATE, completed, fact_rules, facts_of, read_method
from ctgraph_rl.board.rescore import rescore
from ctgraph_rl.board.submission import (
    Submission,
    SubmittedRun,
    experts_of,
    log_name,
    log_sum,
    packed,
    read_submission,
    submission_text,
)
from ctgraph_rl.board.submission_rules import (
    code_rules,
    curriculum_rule,
    entry_rule,
    failure_rules,
    oracle_rule,
    same_rules,
    seed_rules,
)
from ctgraph_rl.board.tracks import Track, track
from ctgraph_rl.checks import ReadOnlyValues, Rule, is_real, repeated, require
from ctgraph_rl.disk import made_folder, new_folder, require_new, write_whole
from ctgraph_rl.log.escape import listed, terminal_text
from ctgraph_rl.log.files import AGENT, CURRICULUM, LOG, locked_new
from ctgraph_rl.log.refuse import refused_by
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.saved import count_bytes, read_content, read_plain, sum_of_state
from ctgraph_rl.log.scores import scores
from ctgraph_rl.metrics import Metric
from ctgraph_rl.runs.read import Run, find_runs, why_left_out
from ctgraph_rl.runs.settings import flat
from ctgraph_rl.tasks.curriculum import Curriculum

ROUNDING = 1e-9
"""Largest difference, as a share of the value, between what two kinds of machines compute from one log."""


def submit(
    paths: Sequence[Path],
    to: Path,
    method: ReadOnlyValues,
    of_track: Track | None = None,
    only: ReadOnlyValues | None = None,
) -> Submission:
    """Make a submission of runs.

    Args:
        paths: run directories, or folders that hold them.
        to: the folder to make; must not exist.
        method: what ``method.yaml`` holds; see `ctgraph_rl.board.method_yaml.read_method`.
        of_track: the track that it is for; None: it is for none.
        only: values of settings by dotted names, such as ``{"curriculum.depth": 4}``; runs with others are left out.

    Returns:
        The submission, read from its folder.

    Raises:
        ValueError: for runs that cannot be submitted; names every broken rule, before anything is written.
        FileExistsError: if the folder exists.
        BlockingIOError: if another process makes it.
    """
    require_new(to)
    runs, curriculum = _checked(_found(paths, only or {}), method, of_track)
    names = _names(runs)
    lines = [_line(run, name, method["failed"]) for run, name in zip(runs, names, strict=True)]
    facts = facts_of(curriculum.protocol, lines)
    require(*fact_rules(method, facts, lines, len(curriculum.tasks)))
    about = completed(method, facts)
    about.pop("track_version", None)
    about["track"] = None
    if of_track is not None:
        about |= {"track": of_track.name, "track_version": of_track.version}
    made_folder(to.absolute().parent)
    with locked_new(to), new_folder(to) as folder:
        _write(folder, runs, lines, about, curriculum=curriculum)
        made = read_submission(folder, of_track)
        wrong = [check.text for check in rescore(made) if not check.passed]
        require((not wrong, f"the submission would not pass its own check: {listed(wrong)}"))
    return read_submission(to, of_track)


def _found(paths: Sequence[Path], only: ReadOnlyValues) -> list[Run]:
    """Return the runs that have some settings, by seed; refuse what cannot be read."""
    found, problems = find_runs(paths)
    require((not problems, why_left_out(problems)))
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


def _checked(runs: list[Run], method: ReadOnlyValues, of_track: Track | None) -> tuple[list[Run], Curriculum]:
    """Return the runs, and what they learned; refuse what cannot be submitted."""
    seeds = [run.seed for run in runs]
    rules = [*same_rules(runs), *code_rules(runs), *failure_rules(runs, method["failed"])]
    rules += seed_rules(seeds, method["tuning"]["seeds"], of_track)
    config = runs[0].about["config"]
    rules += [entry_rule(config, method["entry_point"]), oracle_rule(config)]
    curricula = [run.path / CURRICULUM for run in runs]
    unwritten = list(filterfalse(Path.exists, curricula))
    message = f"{listed(unwritten)} is missing, as of curricula with classes of your own: submit a named curriculum"
    rules.append((not unwritten, message))
    first = None if unwritten else Curriculum.from_json(curricula[0])
    if first is not None:
        other = [run.path for run in runs if run.curriculum[1] != first.fingerprint]
        message = f"the logs of {listed(other)} are of another curriculum than {curricula[0]}"
        rules += [curriculum_rule(first, of_track), (not other, message)]
    fix = "submit from the directory that the run was started in"
    for run in runs:
        experts = _experts(run) if run.reason is None else {}
        missing = list(filterfalse(Path.is_file, experts.values()))
        message = f"{run.path} was trained with experts, {listed(missing)} cannot be found: {fix}"
        rules.append((not missing, message))
    require(*rules)
    assert first is not None
    return runs, first


def _experts(run: Run) -> dict[int, Path]:
    """Return where the logs of a run's single-task experts are, by the numbers of their tasks."""
    return {each["task"]: Path(str(each.get("run"))) / LOG for each in experts_of(RunLog.read(run.path / LOG))}


def _names(runs: Sequence[Run]) -> list[str]:
    """Return a name for each run: that of its directory, or its seed where these are no different names of files."""
    names = [run.path.resolve().name for run in runs]
    usable = all(map(files.NAME.fullmatch, names)) and not repeated(map(str.lower, names))
    return names if usable else [f"seed{run.seed}" for run in runs]


def _line(run: Run, name: str, reasons: Mapping[int, str]) -> SubmittedRun:
    """Return a run as ``submission.json`` has it."""
    log = RunLog.read(run.path / LOG)
    finished = run.reason is None
    state = _state(run.path / AGENT) if finished and (run.path / AGENT).exists() else None
    experts = _experts(run).values() if finished else ()
    return SubmittedRun(
        run=name,
        seed=run.seed,
        reason=None if finished else reasons[run.seed],
        group=tuple(run.about.get("together") or ()),
        agent_sha256=None if state is None else sum_of_state(state),
        agent_bytes=None if state is None else count_bytes(state),
        log_sha256=log_sum(log),
        experts=tuple(log_sum(RunLog.read(path)) for path in experts),
        machine=str(run.about.get("machine", "")),
        num_threads=int(run.about.get("num_threads", 1)),
        cpu=str(run.about.get("cpu") or ""),
        seconds=float(log.measurements[-1].get("seconds", 0.0)),
    )


def _state(path: Path) -> Any:
    """Return what an agent saved."""
    try:
        return read_plain(read_content(path))
    except ValueError as error:
        raise ValueError(f"{path} {error}: save a state_dict there, or nothing") from error


def _write(
    folder: Path,
    runs: Sequence[Run],
    lines: Sequence[SubmittedRun],
    method: ReadOnlyValues,
    *,
    curriculum: Curriculum,
) -> None:
    """Write all files of a submission."""
    made_folder(folder / files.LOGS)
    for run, line in zip(runs, lines, strict=True):
        write_whole(folder / log_name(line.run), packed((run.path / LOG).read_bytes()))
        if not line.finished:
            continue
        experts = _experts(run)
        for number, path in experts.items():
            write_whole(folder / log_name(line.run, number), packed(path.read_bytes()))
        log = RunLog.read(run.path / LOG)
        found = scores(log, curriculum, list(map(RunLog.read, experts.values())) or None)
        require(_metrics_rule(run, found))
    config = dict(runs[0].about["config"])
    config.pop("seed", None)
    content = submission_text(method, config, runs[0].about["versions"], curriculum, tuple(lines))
    write_whole(folder / files.SUBMISSION, content)


def near(one: object, other: object) -> bool:
    """Return whether two values are equal up to the rounding of another machine."""
    if not (is_real(one) and is_real(other)):
        return one == other
    return math.isclose(one, other, rel_tol=ROUNDING, abs_tol=ROUNDING)  # type: ignore[arg-type]


def _metrics_rule(run: Run, found: Mapping[str, Metric]) -> Rule:
    """Return the rule that the metrics of a run are what its log gives, up to the rounding of another machine."""
    other = []
    for name, stored in run.metrics.items():
        if name in found and not near(stored["value"], found[name].value):
            other.append(f"{name} {stored['value']} for {found[name].value}")
    return not other, f"{run.path} has metrics that its log does not give, {listed(other)}: run it again"


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
