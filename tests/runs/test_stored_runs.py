"""Runs that an earlier version made are found under their names, loaded, and resumed bit by bit."""

from __future__ import annotations

import json
import shutil
import tarfile
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.kill_runs import equal
from helpers.made_runs import sum_again
from helpers.paths import DATA
from helpers.sweeping import command_line

import ctgraph_rl
from ctgraph_rl.log import provenance
from ctgraph_rl.log.files import AGENT, CHECKPOINTS, LOG, METRICS
from ctgraph_rl.log.provenance import machine, versions
from ctgraph_rl.runs.checkpoints import Checkpoints

ARCHIVE = DATA / "stored_runs.tar.xz"

with tarfile.open(ARCHIVE) as _archive:
    CELLS: dict[str, dict[str, Any]] = json.load(_archive.extractfile("cells.json"))
"""For each run its command line, and its directory in ``runs`` and ``stopped``."""

every_run_some_slow = pytest.mark.parametrize(
    "cell",
    [
        pytest.param(cell, id=name, marks=[] if number % 8 == 0 else [pytest.mark.slow])
        for number, (name, cell) in enumerate(CELLS.items())
    ],
)


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    """The runs as they were stored, which no test changes: finished in ``runs``, killed in ``stopped``."""
    folder = tmp_path_factory.mktemp("stored")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    for metrics in folder.rglob(METRICS):
        sum_again(metrics.parent)  # they are of before metrics had sums
    return folder


@pytest.fixture(autouse=True)
def numbers_of_then(monkeypatch):
    """The numbers version that the runs were made with; all but those with memory have equal bits since."""
    monkeypatch.setattr(provenance, "NUMBERS", 1)


@pytest.fixture
def command(stored, tmp_path, monkeypatch):
    """Start a run's command where there is a copy of the run: its exit code, and the run's directory."""

    def start(kind: str, cell: dict[str, Any]) -> tuple[int, Path]:
        monkeypatch.chdir(tmp_path)
        run_dir = tmp_path / "runs" / cell["directory"]
        shutil.copytree(stored / kind / cell["directory"], run_dir)
        code = command_line(monkeypatch, *cell["command"])
        assert list(run_dir.parent.iterdir()) == [run_dir]
        return code, run_dir

    return start


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}


def lines(run_dir: Path) -> list[dict[str, Any]]:
    """What was measured, but for the time it took."""
    found = [json.loads(line) for line in (run_dir / LOG).read_text(encoding="utf-8").splitlines()]
    return [{key: value for key, value in line.items() if key != "seconds"} for line in found]


def weights(run_dir: Path) -> dict[str, Any]:
    return torch.load(run_dir / AGENT, weights_only=True)


def made_alike(run_dir: Path) -> bool:
    """Whether a run has this machine's bits: its kind, its number of threads, and versions but for our own."""
    about, here = lines(run_dir)[0], {"versions": versions(), **machine()}
    del about["versions"]["ctgraph_rl"], here["versions"]["ctgraph_rl"]
    return all(about[key] == here[key] for key in here)


@pytest.mark.parametrize("cell", list(CELLS.values())[::8], ids=list(CELLS)[::8])
def test_the_same_command_finds_a_finished_run_and_shows_it(command, stored, capsys, cell):
    code, run_dir = command("runs", cell)

    assert code == 0
    assert "this configuration was run before" in capsys.readouterr().out
    assert files(run_dir) == files(stored / "runs" / cell["directory"])


@every_run_some_slow
def test_the_agents_of_a_finished_and_of_a_stopped_run_are_loaded_as_they_were_saved(stored, cell):
    finished, stopped = (stored / kind / cell["directory"] for kind in ("runs", "stopped"))
    checkpoint = Checkpoints(stopped / CHECKPOINTS).newest()

    assert equal(ctgraph_rl.load(finished).agent.state_dict(), weights(finished))
    assert equal(ctgraph_rl.load(stopped).agent.state_dict(), checkpoint["agent"])
    assert checkpoint["frames"] == 160  # in the middle of the third of four blocks of 64 frames


@every_run_some_slow
def test_the_same_command_resumes_a_stopped_run_which_ends_as_the_one_that_was_never_stopped(command, stored, cell):
    whole = stored / "runs" / cell["directory"]
    before = [line for line in lines(whole) if line.get("frames", 0) <= 160]

    code, run_dir = command("stopped", cell)

    assert code == 0 and (run_dir / METRICS).exists() and not (run_dir / CHECKPOINTS).exists()
    assert lines(run_dir)[: len(before)] == before and len(lines(run_dir)) == len(lines(whole))
    if made_alike(whole) and not any("lstm" in name for name in weights(whole)):
        assert equal(weights(run_dir), weights(whole))
        assert lines(run_dir) == lines(whole)
