"""Machines that stop at any operation on a file: what had reached the disk is enough to end as if nothing had happened.

The operations of a whole run are watched. Before and after each of them the folder is kept as the disk may have it
then: of what was not synced all, nothing or any part is lost, of files and of names in folders. From every such state
the same command must end with the results of the run that was never stopped.
"""

from __future__ import annotations

import builtins
import io
import os
import random
import shutil
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import pytest
from helpers.kill_runs import unlike
from helpers.scripted import DECISION_ID, ONE, TWO
from helpers.small_agents import TINY
from helpers.sweeping import sweep
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from ctgraph_rl import Block, Curriculum, Evaluation, RunLog
from ctgraph_rl.log.sums import RESULTS
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.experts import Expert
from ctgraph_rl.runs.job import run_job
from ctgraph_rl.runs.recorder import Recorder
from ctgraph_rl.runs.status import status_of

CHANGES = ("fsync", "replace", "rename", "unlink", "remove", "mkdir", "rmdir", "truncate")
"""Functions of `os` that change files and folders, or make changes last."""

VARIANTS = ("only what was synced", "names in order", "zeros", "any part", "any other part")
"""What survives: the second is ext4, where a renamed file may be empty; in the third it has its length, as on XFS."""

State = dict[str, bytes | None]
"""Content of each file by its path; None for a folder."""


class Disk:
    """Watches what one thread does in a folder, and keeps the states that the disk may have if the machine stops.

    Args:
        root: the folder; what is in it counts as synced.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.states = root, dict[tuple[tuple[str, bytes | None], ...], str]()
        self.files: dict[int, bytes] = {}  # by number, as synced
        self.folders: dict[int, dict[str, int]] = {}  # by number, as synced: names, and the numbers they stand for
        self._pins: dict[int, int] = {}  # open files, so that no number is given again
        self._busy, self._thread = False, threading.get_ident()  # a sweep looks at its cells in another one
        for number in self._found():
            self._sync(number)

    def watch(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Watch all operations of this process until the test ends."""
        for name in CHANGES:
            monkeypatch.setattr(os, name, self._watched(getattr(os, name), name))
        for module in (builtins, io):
            monkeypatch.setattr(module, "open", self._watched(module.open, "open"))

    def _watched(self, act: Callable[..., Any], name: str) -> Callable[..., Any]:
        def watched(*arguments: Any, **how: Any) -> Any:
            if self._busy or threading.get_ident() != self._thread or not self._is_ours(name, arguments[0]):
                return act(*arguments, **how)
            self._quietly(self._keep, f"before {name}")
            done = act(*arguments, **how)
            if name == "fsync":
                self._quietly(self._sync, os.fstat(arguments[0]).st_ino)
            self._quietly(self._keep, f"after {name}")
            return done

        return watched

    def _is_ours(self, name: str, path: Any) -> bool:
        return name != "open" or (isinstance(path, (str, Path)) and os.path.abspath(path).startswith(f"{self.root}/"))

    def _quietly(self, act: Callable[[Any], None], argument: Any) -> None:
        self._busy = True
        try:
            act(argument)
        finally:
            self._busy = False

    def _found(self) -> dict[int, Path]:
        """All that is there by number."""
        found = {path.stat().st_ino: path for path in (self.root, *self.root.rglob("*")) if path.name != ".lock"}
        for number in found.keys() - self._pins:
            self._pins[number] = os.open(found[number], os.O_RDONLY)
        return found

    def _sync(self, number: int) -> None:
        path = self._found().get(number)
        if path is not None and path.is_dir():
            self.folders[number] = _names(path)
        elif path is not None:
            self.files[number] = path.read_bytes()

    def _keep(self, moment: str) -> None:
        found = self._found()
        folders = {number: _names(path) for number, path in found.items() if path.is_dir()}
        files = {number: path.read_bytes() for number, path in found.items() if path.is_file()}
        for variant in VARIANTS:
            chance = random.Random(f"{len(self.states)} {variant}")
            survived = {
                number: _survivors(variant, self.folders.get(number, {}), folders.get(number), chance)
                for number in sorted({*self.folders, *folders})
            }
            state: State = {}
            for path, number in _paths(survived, self.root.stat().st_ino):
                state[path] = None if number in survived else b""
                if number not in survived:
                    synced = self.files.get(number, b"")
                    state[path] = _survivor(variant, synced, files.get(number, synced), chance)
            self.states.setdefault(tuple(sorted(state.items())), f"{moment} {len(self.states)}, {variant}")


def _names(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_ino for path in folder.iterdir() if path.name != ".lock"}


def _survivors(variant: str, synced: dict[str, int], now: dict[str, int] | None, chance: random.Random):
    """The names of a folder that the disk may have."""
    if now is None or variant == VARIANTS[0]:
        return synced
    if "any" not in variant:
        return now
    chosen = {name: chance.choice((synced, now)).get(name) for name in sorted({*synced, *now})}
    return {name: number for name, number in chosen.items() if number is not None}


def _survivor(variant: str, synced: bytes, now: bytes, chance: random.Random) -> bytes:
    """The content of a file that the disk may have."""
    zeros = synced[: len(now)].ljust(len(now), b"\0")
    if "any" not in variant:
        return zeros if variant == "zeros" else synced
    least = len(synced) if now.startswith(synced) else 0
    return chance.choice((synced, now, zeros, now[: chance.randint(least, len(now))]))


def _paths(folders: Mapping[int, dict[str, int]], folder: int, prefix: str = "") -> Iterator[tuple[str, int]]:
    for name, number in folders[folder].items():
        yield f"{prefix}{name}", number
        if number in folders:
            yield from _paths(folders, number, f"{prefix}{name}/")


def put(state: tuple[tuple[str, bytes | None], ...], folder: Path) -> None:
    """Make a folder as the disk had it."""
    folder.mkdir()
    for path, content in state:
        if content is None:
            (folder / path).mkdir()
        else:
            (folder / path).write_bytes(content)


SHORT = ["curriculum=fo_b1_4tasks", "curriculum.num_frames=64", "agent=a2c", "evaluation.num_episodes=2", *TINY]

LEARNED = Curriculum("recorded", 1, "here", (Block(ONE, 96), Block(TWO, 64)), Evaluation(4))


@cache
def configured(*overrides: str) -> DictConfig:
    with hydra.initialize_config_dir(conf_dir(), version_base="1.3"):
        return hydra.compose("config", overrides=[*SHORT, *overrides])


def start(*overrides: str) -> None:
    """Start a run of four blocks, each of two updates."""
    run_dir = Path("runs/one")
    run_dir.mkdir(parents=True, exist_ok=True)
    run_job(configured(*overrides), run_dir)


def checkpoints() -> None:
    """A run with a checkpoint after every update."""
    start("checkpoint_seconds=1e-9")


def experts() -> None:
    """A run with experts."""
    start("experts=true", "experts_dir=runs/experts", "evaluation.every=32")


def overwritten() -> None:
    """A finished run is run again."""
    start("overwrite=true")


def swept() -> None:
    """A sweep of two cells."""
    with pytest.MonkeyPatch.context() as patch:
        GlobalHydra.instance().clear()
        assert sweep(patch, *SHORT, "seed=0,1") == 0


def decide(observations: np.ndarray) -> np.ndarray:
    return observations[:, DECISION_ID].astype(int)


def recorded() -> None:
    """A user's script, which starts again where a recording was not finished."""
    folder = Path("runs/mine")
    if (folder / "metrics.json").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    with Recorder(LEARNED, folder) as recorder:
        recorder.evaluate(decide, 0)
        for frames in LEARNED.ends:
            recorder.training(frames, episodes=3, return_mean=0.5)
            recorder.evaluate(decide, frames)


SCENARIOS: dict[str, tuple[Callable[[], None], Callable[[], None] | None]] = {
    "checkpoints": (checkpoints, None),
    "experts": (experts, None),
    "overwritten": (overwritten, start),
    "swept": (swept, None),
    "recorded": (recorded, None),
}
"""What is watched, and what was there before."""

CASES = {"checkpoints": 16, "experts": 12, "overwritten": 12, "swept": 5, "recorded": 5}
"""Number of states of each, 50 in all."""


@pytest.fixture(scope="module")
def watched(tmp_path_factory) -> Callable[[str], tuple[Path, list[Any]]]:
    """Gives for a scenario the folder of the run that was never stopped, and all states that it may have had."""

    @cache
    def watch(name: str) -> tuple[Path, list[Any]]:
        folder = tmp_path_factory.mktemp(name)
        act, before = SCENARIOS[name]
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()):
            patch.chdir(folder)
            if before is not None:
                before()
            disk = Disk(folder)
            disk.watch(patch)
            act()
        return folder, [*disk.states.items()]

    return watch


def check(watched, name: str, count: int, tmp_path: Path, monkeypatch) -> None:
    """Start the same command in states that chance has chosen, and the last; all must end with the same results."""
    whole, states = watched(name)
    problems = []
    last = min(count, max(3, count // 4))  # as the run says that it is complete
    chosen = [*random.Random(name).sample(states[:-last], count - last), *states[-last:]]
    for number, (state, moment) in enumerate(chosen):
        folder = tmp_path / str(number)
        put(state, folder)
        monkeypatch.chdir(folder)
        with redirect_stdout(io.StringIO()) as said, warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            try:
                SCENARIOS[name][0]()
                problems += [f"{moment}: {each}" for each in unlike(whole, folder)]
            except (Exception, SystemExit) as error:
                problems.append(f"{moment}: {type(error).__name__}: {error}\n{said.getvalue()[-500:]}")
    assert problems == []


def test_a_run_whose_machine_stopped_ends_as_if_it_had_not(watched, tmp_path, monkeypatch):
    check(watched, "checkpoints", 3, tmp_path, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_runs_whose_machine_stopped_end_as_if_it_had_not(watched, tmp_path, monkeypatch, name):
    check(watched, name, CASES[name], tmp_path, monkeypatch)


@pytest.fixture(scope="module")
def complete(tmp_path_factory) -> Path:
    """The folder of a finished run whose checkpoints were not yet removed."""
    folder = tmp_path_factory.mktemp("complete")
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()):
        patch.chdir(folder)
        patch.setattr(Checkpoints, "clear", lambda _: None)
        start()
    return folder


@pytest.fixture
def copied(complete, tmp_path, monkeypatch) -> Path:
    """The directory of that run, which a test may change."""
    shutil.copytree(complete, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    return tmp_path / "copy" / "runs" / "one"


LOST = {
    **{name: lambda _: b"" for name in RESULTS if name != "run.jsonl"},
    "run.jsonl": lambda content: content[: content.rindex(b"\n", 0, -1) + 1],
    "curriculum.json": lambda content: bytes(len(content)),
}
"""What the machine may leave of each file."""


@pytest.mark.parametrize("name", LOST)
def test_a_complete_run_with_a_damaged_file_is_resumed_from_its_checkpoint(copied, complete, capsys, name):
    (copied / name).write_bytes(LOST[name]((copied / name).read_bytes()))

    start()

    said = f"runs/one says that it is complete, but {name} cannot be read or is not what was written: the run is"
    assert f"{said} resumed" in capsys.readouterr().out
    assert unlike(complete, copied.parents[1]) == []


@pytest.mark.parametrize("name", ["agent.pt", "curriculum.json", "metrics.json"])
def test_without_a_checkpoint_a_damaged_run_is_refused_and_left_as_it_is(copied, name):
    shutil.rmtree(copied / "checkpoints")
    (copied / name).write_bytes(b"")
    before = {path: path.read_bytes() for path in copied.rglob("*") if path.is_file()}

    with pytest.raises(
        ValueError, match=rf"complete, but {name} cannot be read .*: restore it, or run again with over"
    ):
        start()

    after = {path: path.read_bytes() for path in copied.rglob("*") if path.is_file()}
    assert {path: after[path] for path in before} == before
    assert status_of(copied).state != "done"


@pytest.mark.parametrize("log", [b"", b'{"kind": "run", "sche', b'{"kind"' + bytes(99)])
def test_a_run_that_lost_its_first_line_starts_again(tmp_path, complete, monkeypatch, capsys, log):
    monkeypatch.chdir(tmp_path)
    run_dir = Path("runs/one")
    run_dir.mkdir(parents=True)
    (run_dir / "run.jsonl").write_bytes(log)
    (run_dir / "curriculum.json").write_bytes(b"")

    start()

    assert "has lost its first line, as the machine stopped: the run starts again" in capsys.readouterr().out
    assert unlike(complete, tmp_path) == []


@pytest.mark.parametrize("log", [b"", bytes(300), b'{"kind": "run", "sche'])
def test_a_recording_that_lost_its_first_line_starts_again(tmp_path, log):
    (tmp_path / "run.jsonl").write_bytes(log)

    Recorder(LEARNED, tmp_path).log.close()

    assert RunLog.begun(tmp_path / "run.jsonl")["curriculum"] == "recorded"


def test_what_follows_a_checkpoint_may_be_anything(copied, complete):
    saved = Checkpoints(copied / "checkpoints").newest()
    (copied / "metrics.json").unlink()
    log = (copied / "run.jsonl").read_bytes()[: int(saved["log"]["bytes"])]
    (copied / "run.jsonl").write_bytes(log + bytes(50) + b'\n{"kind": "training"}\n')

    start()

    assert unlike(complete, copied.parents[1]) == []


@pytest.mark.slow
def test_an_expert_that_lost_its_measurements_is_noticed_and_trained_again(tmp_path, monkeypatch):
    (tmp_path / "whole").mkdir()
    monkeypatch.chdir(tmp_path / "whole")
    experts()
    for name, lines_left in (("all", 0), ("but_the_first_line", 1)):
        monkeypatch.chdir(shutil.copytree(tmp_path / "whole", tmp_path / name))
        Path("runs/one/metrics.json").unlink()
        (log, *_) = sorted(Path("runs/experts").rglob("run.jsonl"))
        log.write_bytes(b"".join(log.read_bytes().splitlines(keepends=True)[:lines_left]))

        with pytest.raises(ValueError, match=r"has lost run\.jsonl: the same command trains it again"):
            _ = Expert(1, "", log.parent).log
        experts()

        assert unlike(tmp_path / "whole", tmp_path / name) == []
