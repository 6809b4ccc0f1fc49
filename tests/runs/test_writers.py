"""Two writers of one directory: the second is refused with who the first is, and starts once that is gone."""

from __future__ import annotations

import gc
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from helpers.made_runs import make_run
from helpers.scripted import ONE, curriculum
from helpers.stopped_runs import learn_into

from ctgraph_rl import Block
from ctgraph_rl.collective import report as page_on_collectives
from ctgraph_rl.collective.job import run_collective
from ctgraph_rl.log.files import LOCK, Locks
from ctgraph_rl.profile import profile_page
from ctgraph_rl.report.page import write_report
from ctgraph_rl.runs.job import run_as_one, run_job
from ctgraph_rl.runs.recorder import Recorder

TASKS = curriculum(Block(ONE, 12))

ISOLATED = ("agent=ppo", "curriculum=l2d2c_2x2", "method=mask_ri", "exchange=isolated", "exchange.num_members=2")

WRITERS: dict[str, Callable[..., object]] = {
    "run": lambda folder, compose: run_job(compose("agent=ppo"), folder),
    "group": lambda folder, compose: run_as_one([(compose("agent=ppo"), folder)]),
    "collective": lambda folder, compose: run_collective(compose(*ISOLATED), folder),
    "train": lambda folder, compose: learn_into(folder),
    "Recorder": lambda folder, compose: Recorder(TASKS, folder),
    "Recorder that resumes": lambda folder, compose: Recorder(TASKS, folder, resume=True),
    "Recorder that replaces": lambda folder, compose: Recorder(TASKS, folder, overwrite=True),
    "profile": lambda folder, compose: profile_page.write_profile([], [], folder),
    "page on collectives": lambda folder, compose: page_on_collectives.write_report([], folder),
    "report": lambda folder, compose: write_report([make_run(folder.parent, 0)], folder),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_every_writer_is_refused_where_another_is_and_changes_nothing(tmp_path, monkeypatch, compose, writer):
    folder = tmp_path / "run"
    folder.mkdir()
    (tmp_path / "other").mkdir()
    monkeypatch.setattr(profile_page, "profile_scores", lambda *_: {"PPO": {}})
    monkeypatch.setattr(page_on_collectives, "find_collectives", lambda _: [])
    said = rf"run is in use by process {os.getpid()} on {socket.gethostname()} since 2.*: it is this process"

    for others in ([], [tmp_path / "other"]):
        with closing(Locks()) as locks:
            for each in (*others, folder):
                locks.add(each)
            before = (folder / LOCK).read_text()
            with pytest.raises(BlockingIOError, match=said):
                WRITERS[writer](folder, compose)

            assert [path.name for path in folder.iterdir()] == [LOCK]
            assert (folder / LOCK).read_text() == before


def stop(folder: Path, **how: bool) -> None:
    """A recorded run that an error stops after its first checkpoint."""
    with pytest.raises(ZeroDivisionError), Recorder(TASKS, folder, **how) as recorder:  # type: ignore[arg-type]
        recorder.checkpoint(dict, 4)
        _ = 1 / 0


def test_a_recorder_that_is_closed_changes_no_file_of_the_next_writer(tmp_path):
    first = Recorder(TASKS, tmp_path)
    first.close()
    calls = (
        lambda: first.checkpoint(dict, 0),
        lambda: first.evaluate(lambda images: [0] * len(images), 0),
        lambda: first.training(1),
    )

    with Recorder(TASKS, tmp_path, resume=True):
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        for call in calls:
            with pytest.raises(ValueError, match="is closed: a Recorder with resume=True"):
                call()
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_recorder_that_writes_keeps_all_others_out_until_it_ends_by_an_error_or_is_closed(tmp_path, compose):
    stop(tmp_path)
    stop(tmp_path, overwrite=True)
    recorder = Recorder(TASKS, tmp_path, resume=True)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    for how in ({}, {"resume": True}, {"overwrite": True}):
        with pytest.raises(BlockingIOError, match="it is this process, close its Recorder or del it"):
            Recorder(TASKS, tmp_path, **how)
    with pytest.raises(BlockingIOError):
        run_job(compose("agent=ppo"), tmp_path)

    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    for frames in TASKS.moments:
        recorder.evaluate(lambda images: [0] * len(images), frames)
    recorder.close()
    recorder.close()
    assert not (tmp_path / LOCK).exists()
    shown = [Recorder(TASKS, tmp_path, resume=True) for _ in range(2)]
    assert [each.finished for each in shown] == [True, True]


def test_a_recorder_that_is_refused_or_forgotten_leaves_no_lock(tmp_path):
    stop(tmp_path)
    with pytest.raises(FileExistsError):
        Recorder(TASKS, tmp_path)
    with pytest.raises(ValueError, match="holds a run with seed=0 instead of 1"):
        Recorder(TASKS, tmp_path, seed=1, resume=True)
    recorder = Recorder(TASKS, tmp_path, resume=True)
    del recorder
    gc.collect()

    assert Recorder(TASKS, tmp_path, resume=True).frames == 4


HOLD = """
import os, signal, sys
from ctgraph_rl import Block
from ctgraph_rl.runs.recorder import Recorder
sys.path.append(sys.argv[2])
from helpers.scripted import ONE, curriculum
recorder = Recorder(curriculum(Block(ONE, 12)), sys.argv[1])
recorder.checkpoint(dict, 4)
if os.fork() == 0:  # as a worker of environments
    os.close(1)
    signal.pause()
print("writes", flush=True)
signal.pause()
"""


@pytest.mark.slow
def test_a_recorder_starts_once_one_of_another_process_was_killed_whose_workers_live_on(tmp_path, checkout):
    command = [sys.executable, "-c", HOLD, str(tmp_path), str(checkout / "tests")]
    env = {**os.environ, "PYTHONPATH": str(checkout)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env) as process:
        assert process.stdout is not None and process.stdout.readline() == "writes\n"
        workers = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        try:
            said = rf"in use by process {process.pid} on {socket.gethostname()} since .*; wait for it, or stop it$"
            with pytest.raises(BlockingIOError, match=said):
                Recorder(TASKS, tmp_path, resume=True)
            process.kill()
            process.wait()

            assert len(workers) == 1
            assert Recorder(TASKS, tmp_path, resume=True).frames == 4
        finally:
            process.kill()
            for worker in workers:
                os.kill(int(worker), signal.SIGKILL)
