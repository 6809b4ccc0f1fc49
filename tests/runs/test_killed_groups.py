"""Groups of seeds that are killed at each write of their first checkpoints and of their end."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from helpers.kill_runs import unlike
from helpers.sweeping import sweep

from ctgraph_rl.runs import session
from ctgraph_rl.runs.experts import begun_with

pytestmark = pytest.mark.slow

PPO = (
    *("curriculum=ct2_interfering", "curriculum.num_frames=128", "evaluation.num_episodes=2", "agent.hidden_size=8"),
    *("agent=ppo", "agent.num_envs=8", "agent.num_steps=8", "agent.num_epochs=1", "together=true"),
)

EVENTS = ("os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir")
"""Of Python's audit hooks, which tell before they happen; beside a file that is opened to be written."""


class Killed(BaseException):
    """The process is dead."""


class Death:
    """Comes before a write below a folder; the writes after it fail too, so that no handler of an error does any."""

    def __init__(self) -> None:
        self.folder = ""
        self.left: int | None = None  # writes, while it is armed
        self.kill: Callable[[], object] = self.fail
        sys.addaudithook(self)

    def fail(self) -> None:
        raise Killed

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        is_open = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if self.left is None or not (is_open or event in EVENTS) or not str(arguments[0]).startswith(self.folder):
            return
        if threading.current_thread() is threading.main_thread():
            self.left -= 1
            if self.left <= 0:
                self.kill()


DEATH = Death()
"""Python takes no audit hook away again."""


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    DEATH.folder = str(tmp_path / "runs")
    yield
    DEATH.left = None


@contextmanager
def death_at(name: str, write: int) -> Iterator[None]:
    """Death before a write, counted from the first call of a function of `session` until that returns."""
    module = session if hasattr(session, name) else session.Session
    original = getattr(module, name)

    def armed(*given: Any, **how: Any) -> Any:
        setattr(module, name, original)
        DEATH.left = write
        found = original(*given, **how)
        DEATH.left = None
        return found

    setattr(module, name, armed)
    try:
        yield
    finally:
        setattr(module, name, original)
        DEATH.left = None


def run_killed(monkeypatch, name: str, write: int, *settings: str) -> bool:
    """Whether a sweep dies before a write of a function."""
    with death_at(name, write):
        try:
            sweep(monkeypatch, *settings)
        except Killed:
            return True
    return False


def run_killed_for_good(monkeypatch, name: str, write: int, *settings: str) -> bool:
    """The same by SIGKILL, in a separate process."""
    process = os.fork()
    if not process:
        DEATH.kill = lambda: os.kill(os.getpid(), signal.SIGKILL)
        run_killed(monkeypatch, name, write, *settings)
        os._exit(0)
    _, status = os.waitpid(process, 0)
    return os.waitstatus_to_exitcode(status) == -signal.SIGKILL


def assert_whole(folder: str, seeds: list[int]) -> None:
    """The runs are one group, as if never stopped, and nothing is left of the kill."""
    found = sorted(path.parent for path in Path("runs").rglob("run.jsonl"))
    assert [begun_with(run) for run in found] == [seeds] * len(seeds)
    assert [each for each in unlike(Path(folder), Path("runs")) if not each.endswith(".lock is left")] == []


@pytest.mark.parametrize(("killed", "step"), [(run_killed, 1), (run_killed_for_good, 4)])
def test_a_group_that_is_killed_at_any_write_of_its_first_checkpoints_ends_as_one_group(
    monkeypatch, capsys, killed, step
):
    settings = ("seed=0,1,2", *PPO)
    assert sweep(monkeypatch, *settings, "hydra.sweep.dir=whole") == 0
    said = set()

    write = 1
    while killed(monkeypatch, "offer_all", write, *settings):
        capsys.readouterr()
        assert sweep(monkeypatch, *settings) == 0
        said.add("begins again" in capsys.readouterr().err)
        assert_whole("whole", [0, 1, 2])
        shutil.rmtree("runs")
        write += step

    assert write > 8
    assert said == {False, True}  # where no checkpoint was written, nothing begins again


@pytest.mark.parametrize(("killed", "step"), [(run_killed, 1), (run_killed_for_good, 9)])
def test_a_group_that_is_killed_at_any_write_of_its_end_ends_as_one_group(monkeypatch, killed, step):
    settings = ("seed=0,1", *PPO)
    assert sweep(monkeypatch, *settings, "hydra.sweep.dir=whole") == 0
    with monkeypatch.context() as patch:
        patch.setattr(session.RunMember, "finish", lambda *_: DEATH.fail())
        with pytest.raises(Killed):
            sweep(monkeypatch, *settings)
    Path("runs").rename("ended")

    write = 1
    shutil.copytree("ended", "runs")
    while killed(monkeypatch, "learn", write, *settings):
        assert sweep(monkeypatch, *settings) == 0
        assert_whole("whole", [0, 1])
        shutil.rmtree("runs")
        shutil.copytree("ended", "runs")
        write += step

    assert write > 40
