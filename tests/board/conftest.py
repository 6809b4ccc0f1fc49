"""A tiny track and finished runs of it, which most tests of the board submit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.sweeping import command_line

from ctgraph_rl.board import relearn, rerun, verify
from ctgraph_rl.board.isolate import CGROUP, Isolation, Outcome
from ctgraph_rl.board.method_yaml import TEMPLATE
from ctgraph_rl.board.relearn import Relearning
from ctgraph_rl.board.submission import Submission, read_submission
from ctgraph_rl.board.submit import submit
from ctgraph_rl.board.tracks import Track, track

TRACK = """
# @package _global_
defaults:
  - override /curriculum: su_b1_4tasks

curriculum:
  num_frames: 64

evaluation:
  num_episodes: 2

track:
  version: 1
  title: Tiny
  measures: Nothing, in no time.
  breakthrough: None.
  score: average_performance
  less_given:
    - {boundaries: hidden}

hydra:
  sweeper:
    params:
      seed: range(2)
"""

TINY = ("agent=ppo", "agent.num_envs=8", "agent.num_steps=4", "agent.hidden_size=4", "agent.num_minibatches=1")


@pytest.fixture(scope="session")
def tiny_settings() -> tuple[str, ...]:
    """The settings of the runs."""
    return TINY


@pytest.fixture(scope="session")
def tiny_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``conf/track/tiny.yaml`` and, in ``runs``, the runs of two seeds of the track."""
    home = tmp_path_factory.mktemp("tiny")
    (home / "conf" / "track").mkdir(parents=True)
    (home / "conf" / "track" / "tiny.yaml").write_text(TRACK)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(home)
        for seed in (0, 1):
            where = f"hydra.run.dir=runs/tiny-seed{seed}"
            assert command_line(monkeypatch, "--config-dir=conf", "track=tiny", *TINY, f"seed={seed}", where) == 0
    return home


@pytest.fixture(scope="session")
def tiny_track(tiny_home: Path) -> Track:
    """The track, which takes no time."""
    return track("tiny", tiny_home / "conf")


@pytest.fixture(scope="session")
def method() -> dict[str, Any]:
    """What an author says about a method."""
    about = yaml.safe_load(TEMPLATE)
    code = {"repository": "https://example.org/tiny", "commit": "0123abc", "licence": "MIT"}
    return {**about, "name": "Tiny PPO", "authors": ["A. Author"], "code": code, "tuning": {"how": "not", "seeds": []}}


@pytest.fixture(scope="session")
def tiny_submission(tiny_home: Path, tiny_track: Track, method: dict[str, Any]) -> Submission:
    """A valid submission, which no test changes; ``submission`` is a copy."""
    return submit([tiny_home / "runs"], tiny_home / "submission", method, tiny_track)


@pytest.fixture
def submission(tiny_submission: Submission, tmp_path: Path) -> Iterator[Submission]:
    """A valid submission that a test may change."""
    folder = shutil.copytree(tiny_submission.path, tmp_path / "submission")
    yield read_submission(folder, tiny_submission.track.config_dir)


CLOSED = Isolation(bubblewrap="0.8.0", why_not=None, memory=CGROUP, graphics=False)


@pytest.fixture
def in_process(monkeypatch):
    """Reruns take place in this process; returns the folders in which they did."""
    folders = []

    def run(command, folder, limits, isolated, paths=(), variables=None):
        folders.append(folder)
        try:
            relearn.learn_again(Relearning(**json.loads((folder / rerun.JOB).read_text())), folder)
        except Exception as error:
            return Outcome(1, None, f"{type(error).__name__}: {error}")
        return Outcome(0, None, "")

    monkeypatch.setattr(rerun, "run_isolated", run)
    monkeypatch.setattr(verify, "isolation", lambda folder, limits, graphics: CLOSED)
    return folders
