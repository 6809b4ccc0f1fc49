"""Runs that are stopped by real signals, in this process and in processes of their own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.kill_runs import command, differences
from helpers.sweeping import command_line

from ctgraph_rl.runs.checkpoints import Checkpoints


def kill_runs(checkout: Path, *arguments: str) -> None:
    """``python -m tests.helpers.kill_runs ARGUMENTS``; fails if a run ends differently."""
    result = subprocess.run(
        [sys.executable, "-m", "tests.helpers.kill_runs", *arguments], cwd=checkout, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.slow
def test_runs_of_two_agents_that_are_killed_end_as_if_never_stopped(checkout):
    kill_runs(checkout, "--kills", "4", "--agents", "dqn,lstm_ppo")


def test_a_signal_to_a_run_saves_and_the_same_command_goes_on(monkeypatch, capsys, tmp_path, default_sigterm):
    run_dir, whole, offer = tmp_path / "run", tmp_path / "whole", Checkpoints.offer

    def signalled(checkpoints, *given):
        if checkpoints.files():
            os.kill(os.getpid(), signal.SIGTERM)
        offer(checkpoints, *given)

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "offer", signalled)
        assert command_line(patch, *command("a2c", run_dir)) == 143

    line = "SIGTERM: saving after this update ... saved; the same command resumes from there"
    assert line in capsys.readouterr().err.splitlines()
    assert not (run_dir / "metrics.json").exists() and not (run_dir / ".lock").exists()
    assert [command_line(monkeypatch, *command("a2c", each)) for each in (run_dir, whole)] == [0, 0]
    assert differences(whole, run_dir) == []


def start(run_dir: Path, checkout: Path) -> subprocess.Popen:
    """A run in a process of its own, with the signals of a shell's foreground."""
    arguments = [sys.executable, "-m", "ctgraph_rl.run", *command("a2c", run_dir)]
    env = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}

    def usual_signals() -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)

    return subprocess.Popen(
        arguments, cwd=run_dir.parent, env=env, stderr=subprocess.PIPE, text=True, preexec_fn=usual_signals
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGINT", 130)])
def test_a_signal_to_the_process_of_a_run_saves_and_the_same_command_goes_on(
    checkout, tmp_path, monkeypatch, name, code
):
    run_dir, whole = tmp_path / "run", tmp_path / "whole"
    process = start(run_dir, checkout)
    while process.poll() is None and not Checkpoints(run_dir / "checkpoints").files():
        time.sleep(0.01)
    process.send_signal(getattr(signal, name))

    assert process.wait() == code
    assert process.stderr is not None
    line = f"{name}: saving after this update ... saved; the same command resumes from there"
    assert line in process.stderr.read().splitlines()
    assert not (run_dir / "metrics.json").exists() and not (run_dir / ".lock").exists()

    assert [command_line(monkeypatch, *command("a2c", each)) for each in (run_dir, whole)] == [0, 0]
    assert differences(whole, run_dir) == []
