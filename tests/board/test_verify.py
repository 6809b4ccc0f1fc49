"""Levels *rerun* and *held out*: an honest submission reaches them, and what was made up is found."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.submissions import edit_run, make_nested
from helpers.sweeping import command_line

from ctgraph_rl.board import isolate, relearn, rerun, verify
from ctgraph_rl.board.isolate import Isolation, Limits, Outcome
from ctgraph_rl.board.relearn import Relearning, run_dir_of
from ctgraph_rl.board.rerun import cells_of, draw, result_of
from ctgraph_rl.board.rescore import Check
from ctgraph_rl.board.submit import submit
from ctgraph_rl.log.provenance import NUMBERS
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.scores import scores
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.tasks.curriculum import Curriculum

ENTRY = """
from pathlib import Path

import numpy as np

from ctgraph_rl import Recorder


class Waits:
    def __call__(self, observation):
        return np.zeros(len(observation), dtype=np.int64)


def train(curriculum, seed, run_dir):
    with Recorder(curriculum, run_dir, seed, about={"learner": "waits"}, code=[Waits]) as recorder:
        for frames in recorder.moments:
            recorder.evaluate(Waits(), frames)
"""


def call(monkeypatch, home: Path, folder: Path, *arguments: str) -> tuple[int, dict]:
    """Call ``ctgraph-rl verify``; return its exit code and what it wrote."""
    more = [f"--config-dir={home / 'conf'}", f"--folder={folder.parent / 'reruns'}", *arguments]
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl verify", str(folder), *more])
    try:
        verify.main()
        code = 0
    except SystemExit as ended:
        code = ended.code
    written = folder / "verification.json"
    return code, json.loads(written.read_text()) if written.exists() else {}


def failed(written: dict) -> list[tuple[str, str]]:
    return [(check["level"], check["what"]) for check in written["checks"] if not check["passed"]]


def submitted(home: Path, of_track, method: dict, to: Path) -> Path:
    return submit([home / "runs"], to, {**method, "track": "tiny"}, of_track).path


def test_drawn_runs_follow_from_digest_and_number_and_nothing_else():
    runs = [SimpleNamespace(run=f"run{number}") for number in range(10)]
    draws = {
        (digest, number): draw(SimpleNamespace(digest=digest, runs=runs), number, 2)
        for digest in ("a", "b")
        for number in range(100)
    }

    assert [run.run for run in draws["a", 7]] == ["run5", "run7"]
    assert draw(SimpleNamespace(digest="a", runs=runs[::-1]), 7, 2) == draws["a", 7]
    assert {run.run for pair in draws.values() for run in pair} == {run.run for run in runs}
    assert sum(draws["a", number] == draws["b", number] for number in range(100)) < 10


def test_an_honest_submission_is_rerun_and_a_second_call_repeats_no_run(
    tiny_home, tiny_track, method, tmp_path, monkeypatch, in_process, capsys
):
    folder = submitted(tiny_home, tiny_track, method, tmp_path / "submission")

    code, written = call(monkeypatch, tiny_home, folder, "--number=3", "--yes")

    assert (code, written["level"], written["number"], written["bits"]) == (0, "rerun", 3, True)
    assert sorted(written["cells"]) == ["seed0", "seed1"]
    assert len(in_process) == 2
    assert in_process[0].parents[1].stat().st_mode & 0o777 == 0o700, "other users could run what others' code made"
    said = capsys.readouterr()
    assert "number 3 draws rerun of seeds" in said.out
    assert "isolated: bubblewrap 0.8.0; no network" in said.out
    assert "NOT isolated: weaknesses of the kernel stay" in said.out
    assert written["isolation"]["bubblewrap"] == "0.8.0"
    assert "process 2/2: seeds " in said.err
    assert call(monkeypatch, tiny_home, folder, "--number=3", "--yes")[1]["level"] == "rerun"
    assert len(in_process) == 2


@pytest.mark.slow
def test_an_edited_sum_of_an_agent_is_found_by_a_rerun_alone(
    tiny_home, tiny_track, method, tmp_path, monkeypatch, in_process
):
    folder = submitted(tiny_home, tiny_track, method, tmp_path / "submission")
    for number in (0, 1):
        edit_run(folder, number, agent_sha256="a" * 64, agent_bytes=1)

    code, written = call(monkeypatch, tiny_home, folder, "--cells=1", "--yes")

    assert (code, written["level"]) == (1, "none")
    assert failed(written) == [("rerun", "agent of the rerun"), ("rerun", "bytes of the agent")]


def test_a_log_that_was_edited_with_all_that_follows_from_it_is_found_by_a_rerun_alone(
    tiny_home, tiny_track, method, tmp_path, monkeypatch, in_process, capsys
):
    shutil.copytree(tiny_home / "runs", tmp_path / "runs")
    for run_dir in (tmp_path / "runs").iterdir():
        log = RunLog.read(run_dir / "run.jsonl")
        lines = [{**m, "return_mean": 1.0} if m["kind"] == "evaluation" else m for m in log.measurements]
        (run_dir / "run.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        found = scores(RunLog.read(run_dir / "run.jsonl"), Curriculum.from_json(run_dir / "curriculum.json"))
        write_metrics(run_dir / "metrics.json", found)
    folder = submitted(tmp_path, tiny_track, method, tmp_path / "submission")

    code, written = call(monkeypatch, tiny_home, folder, "--cells=1", "--yes")

    assert (code, written["level"]) == (1, "none")
    assert failed(written) == [("rerun", "log of the rerun")]
    assert "first in line 2, evaluation: return_mean 1.0 and 0.0" in capsys.readouterr().out


def test_nothing_runs_where_nobody_can_be_asked(tiny_submission, tiny_home, tmp_path, monkeypatch, in_process, capsys):
    folder = shutil.copytree(tiny_submission.path, tmp_path / "submission")
    monkeypatch.setattr(verify, "read_submission", lambda path, config_dir: replace(tiny_submission, path=path))
    monkeypatch.setattr(verify, "rescore", lambda submission: [])
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: False))

    code, _ = call(monkeypatch, tiny_home, folder)

    assert code == 2
    assert "give --yes to agree" in capsys.readouterr().err
    assert in_process == []


def interrupted(plan):
    raise KeyboardInterrupt


def terminated(plan):
    signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize(("run_plan", "code"), [(terminated, 143), (interrupted, 130)])
def test_a_verification_that_is_stopped_says_how_to_go_on_and_ends_with_the_code_of_its_signal(
    tiny_submission, tiny_home, tmp_path, monkeypatch, in_process, capsys, run_plan, code
):
    folder = shutil.copytree(tiny_submission.path, tmp_path / "submission")
    monkeypatch.setattr(verify, "read_submission", lambda path, config_dir: replace(tiny_submission, path=path))
    monkeypatch.setattr(verify, "rescore", lambda submission: [])
    monkeypatch.setattr(verify, "run_plan", run_plan)
    before = signal.getsignal(signal.SIGTERM)

    assert call(monkeypatch, tiny_home, folder, "--yes", "--number=7") == (code, {})
    assert "no process is left; with --number 7 the same command resumes" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before


def test_nothing_of_others_runs_without_bubblewrap_and_rescored_runs_nothing(
    tiny_submission, tiny_home, tmp_path, monkeypatch, in_process, capsys
):
    folder = shutil.copytree(tiny_submission.path, tmp_path / "submission")
    why = "it needs bubblewrap 0.8 or newer, there is none: install the package bubblewrap"
    opened = Isolation(bubblewrap=None, why_not=why, memory=None, graphics=False)
    monkeypatch.setattr(verify, "isolation", lambda folder, limits, graphics: opened)

    for level in ("rerun", "held_out"):
        code, _ = call(monkeypatch, tiny_home, folder, "--number=3", "--yes", f"--level={level}")

        assert (code, in_process) == (2, [])
        assert f"the code of others is not run: {why}; --level rescored runs none" in capsys.readouterr().err
    code, written = call(monkeypatch, tiny_home, folder, "--level=rescored")
    assert (code, written["level"], in_process) == (0, "rescored", [])


def test_seeds_that_were_trained_together_are_drawn_as_their_group(tiny_submission, tmp_path):
    runs = tuple(replace(run, group=(0, 1)) for run in tiny_submission.runs)
    grouped = replace(tiny_submission, runs=runs)

    (cell,) = cells_of(grouped, draw(grouped, 0, 1), tmp_path)

    assert (cell.job.seeds, cell.runs) == ((0, 1), runs)


@pytest.mark.parametrize(
    ("found", "passed"), [([0.8, 0.9], True), ([0.1, 0.2], False), ([0.1], None)], ids=["equal", "lower", "too few"]
)
def test_where_bits_are_not_promised_scores_are_tested_and_the_power_is_stated(
    tiny_submission, monkeypatch, found, passed
):
    values = iter([*found, 0.8, 0.85, 0.9, 0.8, 0.95])
    monkeypatch.setattr(rerun, "scores", lambda *_: defaultdict(lambda: SimpleNamespace(value=next(values))))
    run = tiny_submission.runs[0]
    submission = replace(tiny_submission, runs=(run,) * 5)
    other = rerun.Rerun(RunLog(), "", None, run.agent_bytes)
    results = {replace(run, seed=seed): other for seed in range(1, len(found) + 1)}
    stopped = rerun.Rerun(None, None, "stopped: it took longer than 1 seconds")

    check, *sizes, undecided = rerun.verified(submission, {**results, run: stopped}, ["cpu A there, B here"])

    assert check.passed is passed
    assert ({size.what for size in sizes}, all(size.passed for size in sizes)) == ({rerun.BYTES}, True)
    for share, alike in ((1.09, True), (0.89, False), (1.11, False)):
        grown = other._replace(agent_bytes=int(run.agent_bytes * share))
        size = next(each for each in rerun.checks_of(run, RunLog(), grown, ["numbers"]) if each.what == rerun.BYTES)
        assert size.passed is alike
    assert (undecided.what, undecided.passed) == ("rerun", None)
    assert check.note == "bits differ, as they may with cpu A there, B here"
    assert ("would be found with 80% chance" if passed is not None else "cannot show any drop") in check.found


def test_bits_are_promised_on_one_machine_and_versions_and_named_where_they_are_not(tiny_submission):
    runs = tiny_submission.runs
    other = [replace(run, cpu="Another CPU") for run in runs]
    versions = {**tiny_submission.versions, "torch": "1.0"}

    assert rerun.why_other_bits(tiny_submission, runs) == []
    assert "cpu Another CPU there" in rerun.why_other_bits(tiny_submission, other)[0]
    assert "torch 1.0 there" in rerun.why_other_bits(replace(tiny_submission, versions=versions), runs)[0]
    portable = replace(tiny_submission, config={**tiny_submission.config, "portable": True})
    elsewhere = [replace(run, cpu="Another CPU", machine="x86_64 portable") for run in runs]
    assert rerun.why_other_bits(portable, elsewhere) == []


def test_a_learner_that_is_not_ours_is_called_by_its_entry_point(tiny_submission, tmp_path, monkeypatch):
    (tmp_path / "waiting_learner.py").write_text(ENTRY)
    monkeypatch.syspath_prepend(tmp_path)
    tiny_submission.curriculum.to_json(tmp_path / "curriculum.json")
    sums = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        path = str(tmp_path / "curriculum.json")
        job = Relearning((3,), {}, 1, entry_point="waiting_learner:train", curriculum=path)
        relearn.learn_again(job, folder)
        cell = rerun.RerunCell(folder, job, (), tiny_submission.curriculum, 1.0)
        result = result_of(cell, 3, Outcome(0, None, ""))
        assert (result.failure, result.agent_sha256) == (None, None)
        sums.append(rerun.log_sum(result.log))

    assert sums[0] == sums[1]
    with pytest.raises(ValueError, match="waiting_learner has no function learn"):
        relearn.learn_again(job._replace(entry_point="waiting_learner:learn"), folder)


def test_a_link_in_place_of_a_result_is_a_failure(tiny_home, tiny_submission, tmp_path):
    (cell,) = cells_of(tiny_submission, tiny_submission.runs[:1], tmp_path)
    run_dir_of(cell.folder, 0).parent.mkdir(parents=True)
    run_dir_of(cell.folder, 0).symlink_to(tiny_home / "runs" / "tiny-seed0")

    assert "symbolic link" in result_of(cell, 0, Outcome(0, None, "")).failure


@pytest.mark.parametrize("what", ["folders", "link"])
def test_what_an_entry_point_left_is_removed_before_it_begins_again(tiny_submission, tmp_path, monkeypatch, what):
    method = {**tiny_submission.method, "entry_point": "waiting_learner:train"}
    (cell,) = cells_of(replace(tiny_submission, method=method), tiny_submission.runs[:1], tmp_path / "reruns")
    (run_dir,) = cell.run_dirs
    cell.folder.mkdir(parents=True)
    (tmp_path / "kept").mkdir()
    if what == "folders":
        run_dir.mkdir()
        make_nested(run_dir)
    else:
        run_dir.symlink_to(tmp_path / "kept")
    monkeypatch.setattr(rerun, "run_isolated", lambda *given, **named: Outcome(0, None, ""))

    rerun.learn_again(cell, Limits(1, 1, 1), None)

    assert not os.path.lexists(run_dir) and (tmp_path / "kept").is_dir()


@pytest.mark.slow
@pytest.mark.skipif((isolate.bubblewrap_version() or (0, 0)) < isolate.OLDEST, reason="needs bubblewrap")
def test_a_group_is_rerun_in_a_process_of_its_own(tiny_home, tiny_track, method, tmp_path, monkeypatch):
    settings = [f"agent.{name}" for name in ("num_envs=8", "num_steps=4", "hidden_size=4", "num_minibatches=1")]
    where = [f"--config-dir={tiny_home / 'conf'}", f"hydra.sweep.dir={tmp_path / 'runs'}"]
    assert command_line(monkeypatch, "-m", *where, "track=tiny", "agent=ppo", *settings, "together=true") == 0
    folder = submitted(tmp_path, tiny_track, method, tmp_path / "submission")

    code, written = call(monkeypatch, tiny_home, folder, "--cells=1", "--yes")

    assert (code, written["level"], len(written["cells"])) == (0, "rerun", 2)


@pytest.mark.slow
def test_held_out_runs_reach_the_last_level(tiny_home, tiny_track, method, tmp_path, monkeypatch, in_process, capsys):
    folder = submitted(tiny_home, tiny_track, method, tmp_path / "submission")

    code, written = call(monkeypatch, tiny_home, folder, "--level=held_out", "--number=7", "--yes")

    assert (code, written["level"], len(written["held_out_seeds"])) == (0, "held_out", 5)
    assert "5 runs with other seeds, images and goals" in capsys.readouterr().out


def test_runs_of_more_threads_than_cores_are_refused_and_scores_of_other_numbers_compared(
    tiny_submission, tmp_path, monkeypatch
):
    runs = tuple(replace(run, num_threads=4096) for run in tiny_submission.runs)
    with pytest.raises(ValueError, match=r"had 4096 threads, this machine has .* cores: verify it on a larger one"):
        cells_of(replace(tiny_submission, runs=runs), runs, tmp_path)
    monkeypatch.setattr("ctgraph_rl.log.provenance.NUMBERS", NUMBERS + 1)

    reasons = rerun.why_other_bits(tiny_submission, tiny_submission.runs)

    assert reasons == [f"numbers version {NUMBERS} there, {NUMBERS + 1} here"]


def test_a_verification_that_compared_scores_says_that_it_compared_no_bits(submission):
    checks = [Check("score", "", "", True, level="rerun"), Check("log", "", "", True, run="one", level="rerun")]

    assert [
        json.loads(verify.write_verification(submission, some).read_text())["bits"] for some in (checks, checks[1:])
    ] == [False, True]


def test_a_level_needs_all_checks_and_a_lower_held_out_score_takes_none_away():
    def level(*checks):
        return verify.level_of([Check("", "", "", passed, level=level) for level, passed in checks])

    assert level(("rescored", True), ("rerun", True), ("held_out", True)) == "held_out"
    assert level(("rescored", True), ("rerun", True), ("held_out", False)) == "rerun"
    assert level(("rescored", True), ("rerun", None)) == "rescored"
    assert level(("rescored", True), ("rerun", False), ("rerun", True)) == "none"
    assert level(("rescored", False)) == level() == "none"


def test_a_run_that_cannot_be_finished_here_is_undecided_and_says_why(tiny_submission):
    run = tiny_submission.runs[0]
    stopped = rerun.Rerun(None, None, "stopped: it took longer than 1 seconds")

    (check,) = rerun.checks_of(run, tiny_submission.log(run), stopped)

    assert check.passed is None
    assert "undecided: seed0: rerun: expected it finishes, found stopped" in verify.report(tiny_submission, [check])
    failed_there = replace(run, reason="the loss was nan")
    assert rerun.checks_of(failed_there, RunLog(), stopped)[0].passed is None
    assert rerun.checks_of(failed_there, RunLog(), stopped._replace(failed_alone=True))[0].passed is True


@pytest.mark.parametrize(
    ("mark", "stopped", "alone"),
    [
        ("ValueError: the loss was nan", None, True),
        ("ValueError: the loss was nan", "it took longer than 1 seconds", False),
        ("MemoryError", None, False),
        (None, None, False),
    ],
)
def test_a_failed_run_is_confirmed_by_its_own_failure_alone(tiny_submission, tmp_path, mark, stopped, alone):
    (cell,) = cells_of(tiny_submission, tiny_submission.runs[:1], tmp_path)
    run_dir_of(cell.folder, 0).mkdir(parents=True)
    if mark is not None:
        (run_dir_of(cell.folder, 0) / "failed.txt").write_text(mark)

    result = result_of(cell, 0, Outcome(1, stopped, "ModuleNotFoundError: No module named 'theirs'"))

    assert (result.log, result.failed_alone) == (None, alone)
    assert result.failure


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("--memory=1e300", "--memory must be in [0.001, 1,000,000] GB, got 1e+300"),
        ("--disk=1e-12", "--disk must be in [0.001, 1,000,000] GB, got 1e-12"),
        ("--hours=1e300", "--hours must be a number > 0 and at most 100,000, got 1e+300"),
    ],
)
def test_limits_out_of_range_are_refused_by_the_names_of_their_options(tmp_path, monkeypatch, capsys, given, said):
    assert call(monkeypatch, tmp_path, tmp_path, given) == (2, {})
    assert said in capsys.readouterr().err


def test_all_code_that_runs_is_named(tiny_submission):
    def said(config):
        return verify.code_in_words(replace(tiny_submission, config=config))

    agent = tiny_submission.config["agent"]["_target_"]
    for target in ("ctgraph_rl.disk.os.system", "baselines.nothing", "theirs.Method"):
        got = said({**tiny_submission.config, "method": {"_target_": target}})
        assert f"{agent}, " in got and f"{target} of https" in got
    found = said({"agent": {"_target_": "hydra.utils.get_method", "path": "os.system"}})
    assert found.startswith("os.system of ")


def test_limits_follow_from_what_the_submitted_run_took(tiny_submission, tmp_path):
    given = SimpleNamespace(hours=None, memory=2.0, disk=1.0)
    (cell,) = cells_of(tiny_submission, tiny_submission.runs[:1], tmp_path)

    assert verify.limits_of(cell, given) == Limits(600, 2 * 10**9, 10**9, cell.job.num_threads)
    assert verify.limits_of(cell._replace(seconds=1000.0), given).seconds == 5000
    assert verify.limits_of(cell._replace(seconds=math.inf), given).seconds == 10**5 * 3600
    given.hours = 0.5
    assert verify.limits_of(cell, given).seconds == 1800


@pytest.mark.skipif((isolate.bubblewrap_version() or (0, 0)) < isolate.OLDEST, reason="needs bubblewrap")
def test_modules_of_others_are_found_after_those_that_are_installed(tiny_submission, tmp_path):
    code = tmp_path / "code"
    code.mkdir()
    (code / "waiting_learner.py").write_text("def train(curriculum, seed, run_dir): print('its code ran', seed)")
    for name in ("sitecustomize", "usercustomize", "types", "ctypes", "torch"):
        (code / f"{name}.py").write_text("open('ran', 'w').close()")
    method = {**tiny_submission.method, "entry_point": "waiting_learner:train"}
    theirs = replace(tiny_submission, method=method)
    (cell,) = cells_of(theirs, theirs.runs[:1], tmp_path / "reruns")
    limits = Limits(120, 4 * 10**9, 10**9)
    cell.folder.mkdir(parents=True)

    outcome = rerun.learn_again(cell, limits, isolate.isolation(cell.folder, limits), [code])

    assert (outcome.code, outcome.output) == (0, "its code ran 0\n")
    assert not (cell.folder / "ran").exists()
