"""A baseline from Python: an agent from the yaml files, the loop over a curriculum and its metrics."""

from __future__ import annotations

import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.kill_runs import equal
from helpers.paths import CHECKOUT
from helpers.scripted import ONE, TWO
from helpers.scripted import curriculum as scripted_curriculum
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.version import VersionBase
from omegaconf import OmegaConf
from omegaconf.basecontainer import BaseContainer

import ctgraph_rl
from baselines.cells.gru import GRU
from baselines.methods.multitask import Multitask
from ctgraph_rl import Block, Recorder, learn_curriculum, make_agent, scores
from ctgraph_rl.checks import did_you_mean
from ctgraph_rl.log.sums import metrics_of
from ctgraph_rl.runs.config import composed, curriculum_of, with_names
from ctgraph_rl.runs.job import run_job
from curricula import su_b1_4tasks

SMALL = {"num_envs": 16, "num_steps": 8, "hidden_size": 8}
TASKS = scripted_curriculum(Block(ONE, 128), Block(TWO, 128))


def without_time(measurements) -> list[dict]:
    return [{key: value for key, value in m.items() if key != "seconds"} for m in measurements if m["kind"] != "run"]


@pytest.mark.parametrize(
    ("agent", "method", "method_settings"),
    [
        pytest.param("ppo", None, {}, marks=pytest.mark.slow),
        ("a2c", "ewc", {"coeff": 7.5, "num_samples": 64}),
    ],
)
def test_three_lines_of_python_give_the_bits_of_the_command_line(tmp_path, agent, method, method_settings):
    changes = [f"agent.{key}={value}" for key, value in {**SMALL, "learning_rate": 0.01}.items()]
    changes += [f"method={method}" for _ in range(method is not None)]
    changes += [f"method.{key}={value}" for key, value in method_settings.items()]
    run_job(composed([f"agent={agent}", "seed=3", "curriculum.num_frames=256", *changes]), tmp_path)
    curriculum = su_b1_4tasks(num_frames=256)

    learner = make_agent(
        agent, curriculum, 3, method=method, method_settings=method_settings, **SMALL, learning_rate=0.01
    )
    log = learn_curriculum(curriculum, learner, 3)

    stored = ctgraph_rl.RunLog.read(tmp_path / "run.jsonl")
    assert without_time(log.measurements) == without_time(stored.measurements)
    assert equal(learner.state_dict(), torch.load(tmp_path / "agent.pt", weights_only=True))
    measured = metrics_of((tmp_path / "metrics.json").read_bytes())
    assert {name: each["value"] for name, each in measured.items()} == {
        name: metric.value for name, metric in scores(log, curriculum).items()
    }


def test_what_is_not_given_is_what_the_yaml_files_say():
    torch.set_num_threads(2)

    agent = make_agent("dqn", TASKS, num_envs=16, buffer_size=64, batch_size=8, num_steps=1)

    assert agent.settings.gamma == composed(["agent=dqn"]).agent.gamma
    assert isinstance(make_agent("lstm_ppo", TASKS, cell="gru", **SMALL).trunk.module[1], GRU)
    assert torch.get_num_threads() == composed([]).num_threads


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("pppo", {}, "unknown agent 'pppo': did you mean 'ppo'?"),
        ("PPO", {}, "unknown agent 'PPO': did you mean 'ppo'?"),
        ("planner", {}, "unknown agent 'planner': choices: a2c, cavia, dqn, "),
        (3, {}, "unknown agent 3: choices: a2c, cavia, dqn, "),
        ("ppo", {"lr": 0.1}, "agent has no lr: did you mean 'learning_rate'?"),
        ("ppo", {"method": "emc"}, "unknown method 'emc': did you mean 'ewc'?"),
        ("ppo", {"method": "ewc", "method_settings": {"Coef": 1}}, "method has no Coef: did you mean 'coeff'?"),
        ("ppo", {"learning_rate": -1}, "learning_rate must be a number > 0, got -1"),
        ("ppo", {"seed": -1}, "seed must be an integer in "),
        ("ppo", {"device": "gpu"}, "device must be "),
        ("ppo", {"cell": "gru"}, "PPO has no memory and takes no cell"),
        ("ppo", {"method": "mask_ri"}, "needs task ids, which are hidden"),
        ("ppo", {"method": "multitask"}, "Multitask learns another curriculum: replace yours by Multitask"),
        ("ppo", {"config_dir": "nowhere"}, "config_dir must be a directory, got nowhere"),
        ("ppo", {"num_envs": 48}, "num_frames=128 of block 1, 2 must be a multiple of num_envs=48; nearest: 96 or 144"),
    ],
)
def test_unknown_names_and_settings_are_refused_with_what_was_probably_meant(name, changes, message):
    with pytest.raises(ValueError) as refused:
        make_agent(name, TASKS, **changes)

    assert message in str(refused.value)


def test_the_curriculum_that_a_method_makes_is_learned():
    joint = Multitask().prepare(TASKS)

    log = learn_curriculum(joint, make_agent("ppo", joint, method="multitask", num_envs=16, num_steps=8))

    assert len(scores(log, joint)) == len(scores(learn_curriculum(TASKS, make_agent("ppo", TASKS, **SMALL)), TASKS))


def test_files_of_the_user_are_agents_and_methods_too(tmp_path):
    folder = Path(tmp_path, "agent")
    folder.mkdir()
    (folder / "mine.yaml").write_text("defaults: [ppo]\nhidden_size: 5\n")

    agent = make_agent("mine", TASKS, config_dir=tmp_path, num_envs=16)

    assert agent.num_envs == 16 and any(5 in weights.shape for weights in agent.parameters())


def test_the_python_of_its_page_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (CHECKOUT / "docs" / "how-to" / "train_in_python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)

    exec("\n".join(blocks), {})

    assert "tensor(" in capsys.readouterr().out
    assert Path("runs/mine/metrics.json").exists() and Path("runs/mine/tracker").is_dir()


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("lr", "did you mean 'learning_rate'?"),
        ("Learning-Rate", "did you mean 'learning_rate'?"),
        ("steps", "did you mean 'num_steps'?"),
        ("num", "choices: learning_rate, num_steps, num_envs"),
    ],
)
def test_a_near_name_is_found_whatever_its_case_and_by_initials_and_parts(word, message):
    assert did_you_mean(word, ["learning_rate", "num_steps", "num_envs"]) == message


HYDRAS_OWN = "hydra.instantiate_override"
"""A resolver that Hydra 1.4 registers again with each object that it makes."""

OWN_YAML = "_target_: curricula.su_b1_4tasks\nnum_frames: 256\n"


@pytest.fixture
def users_hydra(monkeypatch):
    """The state of a program in a job of its own Hydra, of an old ``version_base`` and with a resolver of its own."""
    changed = ("GlobalHydra", "HydraConfig", "JobRuntime", "VersionBase")
    others = {kind: each for kind, each in Singleton._instances.items() if kind.__name__ not in changed}
    monkeypatch.setattr(Singleton, "_instances", others)
    monkeypatch.setattr(BaseContainer, "_resolvers", dict(BaseContainer._resolvers))
    composed([])  # after which all plugins are known
    VersionBase.instance().version_base = "1.2"
    JobRuntime.instance().set("name", "mine")
    GlobalHydra.instance().hydra = "the user's"
    HydraConfig.instance().cfg = OmegaConf.create({"hydra": {"mode": None, "job": {"name": "mine"}}})
    OmegaConf.register_new_resolver("now", lambda pattern: "noon", replace=True)
    return state()


def state() -> dict[str, Any]:
    kept = {kind: each for kind, each in Singleton._instances.items() if kind.__name__ != "Plugins"}
    of_each = {kind: deepcopy(vars(each)) for kind, each in kept.items()}
    resolvers = {name: each for name, each in BaseContainer._resolvers.items() if name != HYDRAS_OWN}
    return {"kept": kept, "of_each": of_each, "resolvers": resolvers, "path": list(sys.path)}


def test_no_call_of_the_library_changes_the_hydra_of_its_caller(users_hydra, tmp_path):
    (tmp_path / "mine" / "curriculum").mkdir(parents=True)
    (tmp_path / "mine" / "curriculum" / "own.yaml").write_text(OWN_YAML)
    (tmp_path / "mine" / "curriculum" / "bad.yaml").write_text(OWN_YAML + "nme: 1\n")
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
    with ThreadPoolExecutor(2) as pool:
        made = list(pool.map(lambda seed: composed([f"seed={seed}"]).seed, range(3)))

    assert made == list(range(3))
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


def test_a_file_that_cannot_be_composed_is_a_value_error(tmp_path):
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent" / "mine.yaml").write_text("defaults: [nothing]\n")

    with pytest.raises(ValueError, match="nothing"):
        with_names({"agent": "mine"}, tmp_path)
