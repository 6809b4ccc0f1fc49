"""Sessions that are killed at each of their writes: the same command ends as if nothing had happened."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.kill_runs import unlike
from helpers.scripted import DECISION_ID, ONE, TWO, curriculum
from helpers.sweeping import command_line, sweep

from ctgraph_rl import Block
from ctgraph_rl.runs.experts import begun_with
from ctgraph_rl.runs.recorder import Recorder

pytestmark = pytest.mark.slow

SMALL = (
    *("evaluation.num_episodes=2", "agent=ppo", "agent.hidden_size=4", "agent.num_envs=8", "agent.num_steps=8"),
    *("agent.num_epochs=1", "checkpoint_seconds=1e-9"),
)
TWO_BLOCKS = ("curriculum=ct2_interfering", "curriculum.num_frames=128", *SMALL)
MEMBERS = (
    *("curriculum=l2d2c_2x2", "curriculum.num_frames=64", "curriculum.agent=1", *SMALL, "method=mask_ri"),
    *("method.backbone_seed=9157", "exchange=l2d2c", "exchange.every=1", "exchange.num_members=2"),
)

EVENTS = ("os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir")
"""Of Python's audit hooks, which tell before they happen; beside a file that is opened to be written."""

RECORDED = curriculum(Block(ONE, 12), Block(TWO, 24))


def record(folder: str) -> None:
    """A user's loop, which resumes what it finds."""
    learner = torch.nn.Linear(1, 1, bias=False)
    torch.nn.init.ones_(learner.weight)
    with Recorder(RECORDED, folder, resume=True) as recorder:
        if recorder.saved is not None:
            learner.load_state_dict(dict(recorder.saved))
        for frames in (0, *range(4, 40, 4)):
            if frames <= recorder.frames and (recorder.saved is not None or recorder.finished):
                continue
            if frames:
                learner.weight.data += 1
                recorder.training(frames, episodes=1, return_mean=learner.weight.item())
            if frames in recorder.moments:
                recorder.evaluate(lambda images: images[:, DECISION_ID].astype(np.int64) * 2, frames)
            recorder.checkpoint(learner.state_dict, frames)


def run(patch: pytest.MonkeyPatch, folder: str) -> None:
    assert command_line(patch, *TWO_BLOCKS, f"hydra.run.dir={folder}/one") == 0


def run_seeds(patch: pytest.MonkeyPatch, folder: str) -> None:
    assert sweep(patch, "seed=0,1", "together=true", *TWO_BLOCKS, f"hydra.sweep.dir={folder}") == 0


def run_experts(patch: pytest.MonkeyPatch, folder: str) -> None:
    experts = ("experts=true", f"experts_dir={folder}/experts", f"hydra.sweep.dir={folder}")
    assert sweep(patch, "seed=0,1", "together=true", *TWO_BLOCKS, *experts) == 0


def run_collective(patch: pytest.MonkeyPatch, folder: str) -> None:
    assert command_line(patch, *MEMBERS, f"hydra.run.dir={folder}/one") == 0


SESSIONS: dict[str, tuple[Callable[[pytest.MonkeyPatch, str], None], int]] = {
    "a run": (run, 5),
    "seeds": (run_seeds, 9),
    "experts": (run_experts, 23),
    "a collective": (run_collective, 11),
    "a Recorder": (lambda _, folder: record(f"{folder}/one"), 3),
}
"""Each with the writes from one kill to the next; 1 kills at all."""


class Death:
    """Comes by SIGKILL before a write below a folder."""

    def __init__(self) -> None:
        self.folder = ""
        self.left: int | None = None  # writes, while it is armed
        sys.addaudithook(self)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        is_open = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if self.left is None or not (is_open or event in EVENTS) or not str(arguments[0]).startswith(self.folder):
            return
        if threading.current_thread() is threading.main_thread():
            self.left -= 1
            if self.left <= 0:
                os.kill(os.getpid(), signal.SIGKILL)


DEATH = Death()
"""Python takes no audit hook away again."""


FORKS = get_context("forkserver")
"""Forks a process that has learned nothing, as torch 2.15 refuses to learn in others' forks."""

FORKS.set_forkserver_preload(["ctgraph_rl.runner", "baselines.ppo"])


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)


def start_to_die(name: str, folder: str, write: int, num_threads: int) -> None:
    """Let a session learn into a folder, and die before a write."""
    torch.set_num_threads(num_threads)  # a log says how many
    DEATH.folder = folder
    DEATH.left = write
    with pytest.MonkeyPatch.context() as patch:
        SESSIONS[name][0](patch, folder)


def is_killed(name: str, folder: Path, write: int) -> bool:
    """Start in a separate process, which is killed before a write."""
    process = FORKS.Process(target=start_to_die, args=(name, str(folder), write, torch.get_num_threads()))
    process.start()
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


@pytest.mark.parametrize("name", SESSIONS)
def test_a_session_that_is_killed_at_any_write_ends_as_if_never_stopped(monkeypatch, name):
    session, step = SESSIONS[name]
    folder = Path("runs").absolute()
    folder.mkdir()
    session(monkeypatch, str(folder))
    folder.rename("whole")
    begun = {(0, 1)} if name in ("seeds", "experts") else {()}

    write = 1
    while is_killed(name, folder, write):
        session(monkeypatch, str(folder))
        left = [each for each in unlike(Path("whole"), folder) if not each.endswith(".lock is left")]
        assert left == [], f"killed before write {write}"
        assert {tuple(begun_with(path.parent)) for path in folder.rglob("run.jsonl")} == begun
        for table in ("members.csv", "messages.csv", "helps.csv"):
            for path in Path("whole").rglob(table):
                assert path.read_bytes() == (folder / path.relative_to("whole")).read_bytes()
        shutil.rmtree(folder)
        write += step

    assert write > 25
