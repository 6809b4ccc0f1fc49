"""Runs in directories that were stopped, damaged, or begun elsewhere: what happens when they are started again."""

from __future__ import annotations

import errno
import json
import os
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.kill_runs import differences
from helpers.learning import train
from helpers.stopped_runs import LEARNED, Stopped, StopsAfter, flip_bit, learn_into, make_agent, stopped_run

from ctgraph_rl import Block, RunLog
from ctgraph_rl.log.provenance import provenance
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.train import new_agent
from ctgraph_rl.tasks.curriculum import Evaluation


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The run that was never stopped."""
    return learn_into(tmp_path_factory.mktemp("whole") / "run")


@pytest.fixture(scope="module")
def begun(tmp_path_factory) -> Path:
    return stopped_run(tmp_path_factory.mktemp("begun") / "run")


@pytest.fixture
def stopped(begun, tmp_path) -> Path:
    """A stopped run that a test may change."""
    return Path(shutil.copytree(begun, tmp_path / "run"))


def newest(run_dir: Path) -> Path:
    return Checkpoints(run_dir / "checkpoints").files()[0]


def about(monkeypatch, **changes) -> None:
    """Let the machine and versions of this process seem others."""
    monkeypatch.setattr("ctgraph_rl.runs.session.provenance", lambda *given: {**provenance(*given), **changes})


def test_a_stopped_run_ends_as_if_never_stopped_and_leaves_no_checkpoint(stopped, whole):
    learn_into(stopped)

    assert differences(whole, stopped) == []
    (restart,) = [json.loads(line) for line in (stopped / "restarts.jsonl").read_text().splitlines()]
    assert restart["frames"] == 64


def test_a_torn_line_and_lines_after_the_checkpoint_are_removed(stopped, whole):
    with (stopped / "run.jsonl").open("ab") as file:
        file.write(b'{"kind": "training", "block": 1, "frames": 96, "seconds": 1}\n{"kind": "train')

    learn_into(stopped)

    assert differences(whole, stopped) == []


def test_a_run_that_is_stopped_again_and_again_ends_the_same(stopped, whole):
    class StopsSoon(Checkpoints):
        def offer(self, state, at_block_end):
            super().offer(state, at_block_end)
            raise Stopped

    starts = 0
    while not (stopped / "metrics.json").exists():
        starts += 1
        try:
            learn_into(stopped, StopsSoon(stopped / "checkpoints"))
        except Stopped:
            continue

    assert starts == 4  # updates at 96, 128 and 160 frames, and the end
    assert differences(whole, stopped) == []


@pytest.mark.parametrize("name", ["agent.pt", "metrics.json"])
def test_a_run_that_is_stopped_while_its_results_are_written_ends_the_same(stopped, whole, monkeypatch, name):
    write = {"agent.pt": "write_whole", "metrics.json": "write_metrics"}[name]
    with monkeypatch.context() as patch:
        patch.setattr(f"ctgraph_rl.runs.session.{write}", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            learn_into(stopped)
    assert not (stopped / "metrics.json").exists()

    learn_into(stopped)

    assert differences(whole, stopped) == []


def test_a_broken_newest_checkpoint_costs_a_warning_and_no_bit(stopped, whole):
    flip_bit(newest(stopped), -1)

    with pytest.warns(UserWarning, match=r"000000000064\.pt is not what was written"):
        learn_into(stopped)

    assert differences(whole, stopped) == []
    assert json.loads((stopped / "restarts.jsonl").read_text())["frames"] == 32


def refused(run_dir: Path, message: str, strict: bool = False) -> None:
    """Starting the run again is refused, and nothing is changed."""
    before = {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=message):
        learn_into(run_dir, Checkpoints(run_dir / "checkpoints", strict=strict))
    assert {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()} == before


def test_strict_refuses_a_broken_newest_checkpoint(stopped):
    flip_bit(newest(stopped), -1)

    refused(stopped, r"000000000064\.pt is not what was written", strict=True)


def test_strict_refuses_other_versions_and_machines_before_anything_is_written(stopped, monkeypatch):
    with (stopped / "run.jsonl").open("ab") as file:
        file.write(b'{"kind": "training", "block": 1, "frames": 96}\n')
    about(monkeypatch, machine="riscv64 RVV")

    refused(stopped, r"was begun with other \{'machine': .*'riscv64 RVV'\]\}; from here on its bits may", strict=True)


def test_else_they_are_a_warning(stopped, monkeypatch, whole):
    about(monkeypatch, versions={"torch": "9"})

    with pytest.warns(UserWarning, match="was begun with other {'versions': "):
        learn_into(stopped)

    assert differences(whole, stopped) == []


def test_a_curriculum_whose_code_has_changed_is_refused(stopped):
    other = replace(LEARNED, blocks=(Block(LEARNED.tasks[1], 96), LEARNED.blocks[1]))

    with pytest.raises(
        ValueError, match=r"was begun with other code: the curriculum \(fingerprint \w+ before, \w+ now\) changed"
    ):
        train(other, new_agent(other, make_agent, 3), stopped, 3)


@pytest.mark.parametrize("log", [None, b"", b'{"kind": "run'])
def test_checkpoints_without_their_log_are_no_reason_to_start_anew(stopped, log):
    if log is None:
        (stopped / "run.jsonl").unlink()
    else:
        (stopped / "run.jsonl").write_bytes(log)

    refused(stopped, r"has checkpoints, but no run\.jsonl of a run: restore it, or start with overwrite=true")


def test_a_log_that_is_shorter_than_at_the_checkpoint_is_refused(stopped):
    content = (stopped / "run.jsonl").read_bytes()
    (stopped / "run.jsonl").write_bytes(content[: content.rindex(b"\n", 0, -1) + 1])

    refused(stopped, r"run\.jsonl has \d+ bytes and the checkpoint needs \d+: restore the file")


def test_a_full_disk_stops_the_log_with_the_sizes_and_the_run_goes_on_from_its_checkpoint(stopped, whole, monkeypatch):
    write = os.write

    def on_a_full_disk(descriptor, line):
        if b'"frames": 128' in line:
            write(descriptor, line[:9])
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(descriptor, line)

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", on_a_full_disk)
        with pytest.raises(
            OSError, match=r"No space left on device: cannot write 0\.0 MB to .*run\.jsonl, .* are free"
        ):
            learn_into(stopped)

    learn_into(stopped)

    assert differences(whole, stopped) == []


def test_what_a_kill_left_of_a_checkpoint_is_removed(stopped):
    half = newest(stopped).with_name("000000000077.pt.part")
    half.write_bytes(b"half")

    with pytest.raises(Stopped):
        learn_into(stopped, StopsAfter(stopped / "checkpoints", frames=96))

    assert not half.exists()


def test_a_run_is_as_large_as_the_docs_say(stopped, whole):
    lines = RunLog.read(whole / "run.jsonl").of_kind("training")
    size = max(len(json.dumps(line)) for line in lines)

    assert size < 500, "bytes of a training line, docs/how-to/resume.md"


@pytest.mark.parametrize("size", [{"num_envs": 2**40}, {"num_steps": 2**40}])
def test_batches_that_no_machine_can_hold_are_refused_before_they_are_made(size):
    class Large:
        num_envs, num_steps = 8, 4
        policy = policy_for = initial_state = start_task = end_task = learn = to = state_dict = None

    agent = Large()
    vars(agent).update(size)

    with pytest.raises(
        ValueError, match=r"batches of num_envs=\d+ x num_steps=\d+ frames need [\d,]+ bytes, this mach"
    ):
        new_agent(LEARNED, lambda *_: agent, 0)


def test_evaluations_of_more_rows_than_fit_are_refused_before_they_are_made():
    wide = replace(LEARNED, evaluation=Evaluation(10**12))

    with pytest.raises(
        ValueError, match=r"num_episodes=10{12} of 2 tasks are 2,000,000,000,000 rows at once, the limit"
    ):
        new_agent(wide, make_agent, 0)


def test_no_warning_is_given_where_nothing_is_wrong(stopped):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        learn_into(stopped)
