"""A baseline from Python: an agent from the yaml files, the loop over a curriculum and its metrics."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from helpers.kill_runs import equal
from helpers.paths import CHECKOUT
from helpers.scripted import ONE, TWO
from helpers.scripted import curriculum as scripted_curriculum

import ctgraph_rl
from baselines.methods.multitask import Multitask
from ctgraph_rl import Block, learn_curriculum, make_agent, scores
from ctgraph_rl.checks import did_you_mean
from ctgraph_rl.log.run_log import metrics_text
from ctgraph_rl.runs.config import composed
from ctgraph_rl.runs.job import run_job
from curricula import su_b1_4tasks

SMALL = {"num_envs": 16, "num_steps": 8, "hidden_size": 8}
TASKS = scripted_curriculum(Block(ONE, 128), Block(TWO, 128))


def without_time(measurements) -> list[dict]:
    return [{key: value for key, value in m.items() if key != "seconds"} for m in measurements if m["kind"] != "run"]


@pytest.mark.parametrize(
    ("agent", "method", "method_settings"), [("ppo", None, {}), ("lstm_ppo", "ewc", {"coeff": 7.5, "num_samples": 64})]
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
    assert json.loads(metrics_text(scores(log, curriculum))) == json.loads((tmp_path / "metrics.json").read_bytes())


def test_what_is_not_given_is_what_the_yaml_files_say():
    torch.set_num_threads(2)

    agent = make_agent("dqn", TASKS, num_envs=16, buffer_size=64, batch_size=8, num_steps=1)

    assert agent.gamma == composed(["agent=dqn"]).agent.gamma
    assert torch.get_num_threads() == composed([]).num_threads


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("pppo", {}, "unknown agent 'pppo': did you mean 'ppo'?"),
        ("PPO", {}, "unknown agent 'PPO': did you mean 'ppo'?"),
        ("planner", {}, "unknown agent 'planner': choices: a2c, dqn, "),
        (3, {}, "unknown agent 3: choices: a2c, dqn, "),
        ("ppo", {"lr": 0.1}, "agent has no lr: did you mean 'learning_rate'?"),
        ("ppo", {"method": "emc"}, "unknown method 'emc': did you mean 'ewc'?"),
        ("ppo", {"method": "ewc", "method_settings": {"Coef": 1}}, "method has no Coef: did you mean 'coeff'?"),
        ("ppo", {"learning_rate": -1}, "learning_rate must be a number > 0, got -1"),
        ("ppo", {"seed": -1}, "seed must be an integer in "),
        ("ppo", {"device": "gpu"}, "device must be "),
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
