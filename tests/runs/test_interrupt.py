"""Signals that ask a run to stop."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest

from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.interrupt import Interrupt


@contextmanager
def handled(number: int, handler):
    """As if something else had set the handler of a signal."""
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


def send(number: int) -> None:
    os.kill(os.getpid(), number)


@pytest.fixture(autouse=True)
def usual_handlers():
    """As in a shell's foreground, whatever runs the tests."""
    with handled(signal.SIGINT, signal.default_int_handler), handled(signal.SIGTERM, signal.SIG_DFL):
        yield


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_saves_after_the_update_and_exits_with_its_code_and_one_line(tmp_path, capsys, number, code):
    saved = []
    with pytest.raises(SystemExit) as end, Interrupt() as interrupt:
        checkpoints = Checkpoints(tmp_path, seconds=1e9, interrupt=interrupt)
        for frames in range(10):
            if frames == 5:
                send(number)
            checkpoints.offer(lambda frames=frames: saved.append(frames) or {"frames": frames}, at_block_end=False)

    assert end.value.code == code
    assert saved == [0, 5]
    name = signal.Signals(number).name
    line = f"\n{name}: saving after this update ... saved; the same command resumes from there\n"
    assert capsys.readouterr().err == line


def test_a_second_one_stops_at_once():
    with pytest.raises(KeyboardInterrupt), Interrupt() as interrupt:
        send(signal.SIGINT)
        assert interrupt.is_asked
        send(signal.SIGINT)
        pytest.fail("went on")


def test_handlers_are_those_from_before_when_it_is_left():
    with Interrupt():
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler

    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_one_that_comes_after_the_last_update_stops_what_follows():
    with pytest.raises(SystemExit) as end, Interrupt():
        send(signal.SIGTERM)

    assert end.value.code == 143


def test_an_error_is_not_hidden_by_a_signal():
    with pytest.raises(ZeroDivisionError), Interrupt():
        send(signal.SIGTERM)
        _ = 1 / 0


def test_check_leaves_only_if_asked():
    with pytest.raises(SystemExit), Interrupt() as interrupt:
        interrupt.check()
        send(signal.SIGTERM)
        interrupt.check()
        pytest.fail("went on")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_is_ignored_stays_ignored(number):
    with handled(number, signal.SIG_IGN), Interrupt() as interrupt:
        send(number)

        assert not interrupt.is_asked


def test_a_signal_that_nothing_handles_is_not_taken_for_a_request_to_queue_again():
    with handled(signal.SIGUSR2, signal.SIG_DFL), Interrupt():
        assert signal.getsignal(signal.SIGUSR2) is signal.SIG_DFL


def test_where_a_handler_puts_jobs_into_the_queue_again_it_is_called_after_the_save(tmp_path):
    told = []

    def requeue(number, frame):
        told.append([int(file.stem) for file in Checkpoints(tmp_path).files()])
        raise SystemExit(0)

    with handled(signal.SIGUSR2, requeue), pytest.raises(SystemExit) as end, Interrupt() as interrupt:
        send(signal.SIGUSR2)
        Checkpoints(tmp_path, interrupt=interrupt).offer(lambda: {"frames": 7}, at_block_end=False)

    assert (told, end.value.code) == ([[7]], 0)


def test_in_a_thread_signals_act_as_before():
    asked = []

    def work():
        with Interrupt() as interrupt:
            asked.append(interrupt.is_asked)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()

    assert asked == [False]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def of_submitit(number, frame):
    """What submitit does at SIGUSR2."""
    subprocess.check_call(["scontrol", "requeue", "7"])
    sys.exit(-1)


SCONTROL = """#!/bin/sh
[ $1 = show ] && exec cat {folder}/job
kill -TERM $$ $PPID; kill -USR2 $PPID  # as SLURM: to all processes of the job
{requeue}
"""


@pytest.mark.parametrize(
    ("requeue", "code"),
    [
        ("sleep 0.05; echo Restarts=2 >>FOLDER/requeued", 255),
        ("echo JobState=COMPLETING Restarts=2 >FOLDER/job; kill -KILL $$", 143),  # killed once SLURM had heard it
        ("kill -KILL $$", None),
        ("exit 1", None),
    ],
)
def test_a_second_signal_does_not_end_the_requeue_and_a_job_says_where_it_is_not_in_the_queue(
    tmp_path, monkeypatch, requeue, code
):
    (tmp_path / "job").write_text("JobId=7 JobState=RUNNING Restarts=1")
    script = SCONTROL.format(folder=tmp_path, requeue=requeue.replace("FOLDER", str(tmp_path)))
    (tmp_path / "scontrol").write_text(script)
    (tmp_path / "scontrol").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    bypassed = []

    with (
        handled(signal.SIGUSR2, of_submitit),
        handled(signal.SIGTERM, lambda *_: bypassed.append(1)),
        pytest.raises((SystemExit, RuntimeError)) as end,
        Interrupt() as interrupt,
    ):
        send(signal.SIGTERM)
        interrupt.exit()

    if code is None:
        said = "SLURM did not put job 7 into the queue again, as scontrol requeue failed: the same command resumes the"
        assert isinstance(end.value, RuntimeError) and said in str(end.value)
    else:
        assert isinstance(end.value, SystemExit) and end.value.code % 256 == code
    assert (tmp_path / "requeued").exists() == (code == 255)
    assert bypassed == [] and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.parametrize(("states", "is_requeued"), [({"7_1": "RUNNING"}, True), ({"7_1": "COMPLETING"}, False)])
def test_a_task_of_an_array_goes_back_into_the_queue_whatever_the_state_of_the_others(
    tmp_path, monkeypatch, states, is_requeued
):
    """The number of the last task to start is that of the whole array, and shows all of its tasks."""
    states = {"7": f"COMPLETING, {states['7_1']}", **states}
    shown = "".join(f"    {job}) echo JobState={state} ;;\n" for job, state in states.items())
    (tmp_path / "scontrol").write_text(f'#!/bin/sh\ncase "$3" in\n{shown}esac\n')
    (tmp_path / "scontrol").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    for name, value in {"JOB_ID": "7", "ARRAY_JOB_ID": "7", "ARRAY_TASK_ID": "1"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    requeued = []

    with handled(signal.SIGUSR2, lambda *_: requeued.append(1)), pytest.raises(SystemExit), Interrupt() as interrupt:
        send(signal.SIGTERM)
        interrupt.exit()

    assert bool(requeued) == is_requeued
