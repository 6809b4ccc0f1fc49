"""A program that uses Hydra itself, and calls this package: its Hydra stays as it was."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from helpers.scripted import ONE, TWO
from helpers.scripted import curriculum as scripted_curriculum
from hydra import version
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.basecontainer import BaseContainer

from ctgraph_rl import Block, Recorder, make_agent
from ctgraph_rl.runs.config import composed, curriculum_of

TASKS = scripted_curriculum(Block(ONE, 128), Block(TWO, 128))
SMALL: dict[str, Any] = {"num_envs": 16, "num_steps": 8, "hidden_size": 8}
OWN = "_target_: curricula.su_b1_4tasks\nnum_frames: 256\n"


@pytest.fixture
def users_hydra(monkeypatch):
    """The state of a program in a job of its own Hydra, of an old ``version_base`` and with a resolver of its own."""
    monkeypatch.setattr(Singleton, "_instances", dict(Singleton._instances))
    monkeypatch.setattr(BaseContainer, "_resolvers", dict(BaseContainer._resolvers))
    composed([])  # after which all plugins are known
    version.setbase("1.2")
    JobRuntime.instance().set("name", "mine")
    GlobalHydra.instance().hydra = "the user's"
    HydraConfig.instance().cfg = OmegaConf.create({"hydra": {"mode": None, "job": {"name": "mine"}}})
    OmegaConf.register_new_resolver("now", lambda pattern: "noon", replace=True)
    return state()


def state() -> dict[str, Any]:
    kept = {kind: each for kind, each in Singleton._instances.items() if kind.__name__ != "Plugins"}
    of_each = {kind: deepcopy(vars(each)) for kind, each in kept.items()}
    return {"kept": kept, "of_each": of_each, "resolvers": dict(BaseContainer._resolvers), "path": list(sys.path)}


def test_no_call_of_the_library_changes_the_hydra_of_its_caller(users_hydra, tmp_path):
    (tmp_path / "mine" / "curriculum").mkdir(parents=True)
    (tmp_path / "mine" / "curriculum" / "own.yaml").write_text(OWN)
    (tmp_path / "mine" / "curriculum" / "bad.yaml").write_text(OWN + "nme: 1\n")
    make_agent("ppo", TASKS, **SMALL)
    assert state() == users_hydra
    Recorder(TASKS, tmp_path / "run", logger="csv").close()
    assert state() == users_hydra
    assert curriculum_of("own", tmp_path / "mine").num_frames == 4 * 256
    assert state() == users_hydra
    with pytest.raises(ValueError, match="unknown agent"):
        make_agent("ppoo", TASKS)
    assert state() == users_hydra
    with pytest.raises(HydraException):
        composed(["agent=["])
    assert state() == users_hydra
    with pytest.raises(ValueError, match="nme"):
        curriculum_of("bad", tmp_path / "mine")
    assert state() == users_hydra


def test_threads_compose_one_after_the_other_and_leave_the_hydra_of_their_program(users_hydra):
    with ThreadPoolExecutor(4) as pool:
        made = list(pool.map(lambda seed: composed([f"seed={seed}"]).seed, range(8)))

    assert made == list(range(8))
    assert state() == users_hydra


PROGRAM = """
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig

import curricula
from ctgraph_rl import make_agent


@hydra.main(version_base="1.1", config_path="conf", config_name="own")
def main(cfg):
    make_agent("ppo", curricula.load("su_b1_4tasks"), seed=cfg.seed, num_envs=16, hidden_size=8)
    with Path("result.txt").open("a") as file:
        file.write(f"{HydraConfig.get().job.name} {cfg.seed} ")


main()
"""


@pytest.mark.slow
def test_a_sweep_of_an_application_of_ones_own_runs_each_job_in_its_folder(tmp_path):
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "own.yaml").write_text("seed: 0\n")
    (tmp_path / "program.py").write_text(PROGRAM)

    command = [sys.executable, "-W", "ignore", "program.py", "-m", "seed=0,1,2", "hydra.sweep.dir=out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)

    assert done.returncode == 0, done.stderr
    found = {path.relative_to(tmp_path): path.read_text() for path in tmp_path.rglob("result.txt")}
    assert found == {Path(f"out/{seed}/result.txt"): f"program {seed} " for seed in range(3)}
