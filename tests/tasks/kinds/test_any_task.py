"""Tasks that are no CT-graphs through the command line, and everything that reads the runs."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.paths import CHECKOUT
from helpers.sweeping import command_line

import curricula
from ctgraph_rl import Block, Curriculum, Evaluation, Protocol, Recorder, evaluate, learn_curriculum, load, make_agent
from ctgraph_rl.board.held_out import other_curriculum
from ctgraph_rl.board.standings.track_ceilings import ceilings_of
from ctgraph_rl.compare import main as compare
from ctgraph_rl.policies import OptimalPolicy
from ctgraph_rl.report.bounds_of_runs import bounds_of_curriculum
from ctgraph_rl.report.page import main as report
from ctgraph_rl.tasks.kinds.gym_task import GymTask
from ctgraph_rl.tasks.switch import Drift

PAGE = CHECKOUT / "docs" / "reference" / "own_env_base.md"
TINY = ("agent.num_envs=8", "agent.num_steps=8", "agent.hidden_size=8", "agent.num_epochs=1")
LAKES = ("curriculum=frozen_lake_4maps", "curriculum.num_frames=128", "evaluation.num_episodes=4", *TINY)


@pytest.fixture(scope="module")
def lakes(tmp_path_factory) -> Path:
    """The folder with the runs of two seeds on lakes, and what the sweep printed under ``out.txt``."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        folder = tmp_path_factory.mktemp("lakes")
        monkeypatch.chdir(folder)
        assert command_line(monkeypatch, "-m", *LAKES, "agent=ppo", "method=ewc", "seed=0,1", "together=true") == 0
    return folder


def run_dirs(folder: Path) -> list[Path]:
    return sorted(path.parent for path in folder.rglob("metrics.json"))


@pytest.mark.slow
def test_a_sweep_of_lakes_measures_the_optimum_and_says_what_it_cannot(lakes):
    metrics = [json.loads((each / "metrics.json").read_text()) for each in run_dirs(lakes)]

    assert len(metrics) == 2
    assert metrics[0]["optimal_performance"]["value"] == pytest.approx(0.98587, abs=1e-5)
    assert metrics[0]["average_performance"]["value"] is not None
    assert metrics[0]["stage_reached"]["undefined"] == "it is known of CT-graphs alone, and tasks are of GymTask"


@pytest.mark.slow
def test_a_report_a_comparison_and_load_read_runs_of_lakes(lakes, tmp_path, monkeypatch):
    runs = [str(each) for each in run_dirs(lakes)]
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl report", *runs, "--out", str(tmp_path / "report")])
    report()
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl compare", *runs])
    with pytest.raises(SystemExit, match="1"):  # as their seeds differ
        compare()
    trained = load(run_dirs(lakes)[0])
    task = trained.curriculum.tasks[0]
    ends = evaluate(trained.policy_for(task), [task], 3, curriculum=trained.curriculum)

    assert "Trees are missing: they are of CT-graphs, and its tasks are of GymTask." in _text(tmp_path / "report")
    assert list(ends["episode_reward"].shape) == [1, 3, 1]
    assert "outcome" not in ends.keys()  # noqa: SIM118, a TensorDict iterates over rows


def _text(folder: Path) -> str:
    return " ".join(path.read_text() for path in folder.rglob("*.md"))


def test_an_environment_of_a_user_learns_from_the_command_line(tmp_path, monkeypatch, capsys):
    text = PAGE.read_text()
    for name, code in re.findall(r"`([\w/]+\.(?:py|yaml))`:\n\n```\w+\n(.*?)```", text, re.DOTALL):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    short = ("curriculum.num_frames=2048", "agent.num_envs=32", "agent.num_steps=32", "agent.hidden_size=16")

    code = command_line(monkeypatch, "--config-dir", "my_conf", "curriculum=corridors", "agent=ppo", *short)

    out = capsys.readouterr().out
    [run_dir] = run_dirs(tmp_path)
    assert code == 0
    assert "note: Corridor cannot be saved within an episode" in out
    assert json.loads((run_dir / "metrics.json").read_text())["optimal_performance"]["value"] == 1
    [first, _] = json.loads((run_dir / "curriculum.json").read_text())["tasks"]
    assert first == {"type": "my_task.Corridor", "right": True}


def test_the_board_shows_the_optimum_of_lakes_and_holds_out_seeds_alone():
    lakes = curricula.load("frozen_lake_4maps")

    assert ceilings_of(lakes) == {"optimum": pytest.approx(0.986, abs=5e-4)}
    assert other_curriculum(lakes, "key").fingerprint == lakes.fingerprint
    assert bounds_of_curriculum(lakes).returns["right-firm"] == (0, 1)


CONTINUOUS = Curriculum(
    "pendulum", 1, "-", (Block(GymTask("Pendulum-v1", max_episode_steps=9), 64),), Evaluation(num_episodes=2)
)
LAKE = GymTask("FrozenLake-v1", max_episode_steps=20)


def test_a_learner_of_ones_own_with_continuous_actions_is_measured():
    with Recorder(CONTINUOUS) as recorder:
        still = recorder.evaluate(lambda observation: np.zeros((len(observation), 1), dtype=np.float32), 0)

    assert list(still) == ["Pendulum-v1"]
    assert still["Pendulum-v1"] < 0


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (lambda: make_agent("ppo", CONTINUOUS), r"agents of baselines choose from discrete actions, .* float32 \[1\]"),
        (lambda: make_agent("rl2", curricula.load("frozen_lake_4maps")), "RL2 needs CT-graphs"),
        (lambda: evaluate(OptimalPolicy, [LAKE], 1), "OptimalPolicy plays only CT-graphs"),
        (lambda: _learn(protocol=Protocol(guide_frames=64)), "protocol.guide_frames=64 needs CT-graphs, not GymTask"),
        (lambda: _learn(blocks=(Block((LAKE, replace(LAKE, label="b")), 64, Drift(1)),)), "which GymTask has not"),
    ],
)
def test_what_only_ct_graphs_can_do_is_refused_with_the_reason(refused, message):
    with pytest.raises(ValueError, match=message):
        refused()


def test_a_curriculum_of_an_extra_that_is_not_installed_names_the_extra(monkeypatch):
    monkeypatch.setattr("curricula.gym.find_spec", lambda name: None)

    with pytest.raises(ValueError, match=r"minigrid_3tasks needs MiniGrid: install it by pip install"):
        curricula.load("minigrid_3tasks")


def _learn(**changes: object) -> None:
    curriculum = replace(Curriculum("lake", 1, "-", (Block(LAKE, 64),), Evaluation(num_episodes=2)), **changes)
    learn_curriculum(curriculum, make_agent("a2c", curriculum, num_envs=8, num_steps=8))


def test_a_state_is_offered_at_announced_boundaries_alone_where_episodes_do_not_repeat():
    lake = replace(LAKE, repeats=False)
    curriculum = Curriculum("lake", 1, "-", (Block(lake, 128), Block(replace(lake, label="b"), 64)), Evaluation(2))
    agent, offered = make_agent("a2c", curriculum, num_envs=8, num_steps=4), []
    torch.manual_seed(0)

    learn_curriculum(curriculum, agent, checkpoint=lambda state, ends: offered.append((state()["frames"], ends)))

    assert offered == [(128, True), (192, True)]
