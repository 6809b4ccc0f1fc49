"""The objective of a run: the value of a metric, the mean of several runs, or why there is none."""

from __future__ import annotations

import json

import pytest
from helpers.sweeping import command_line

from ctgraph_rl.report.objective import objective_of
from ctgraph_rl.run import run

SHORT = ("curriculum.num_frames=128", "agent=ppo", "agent.num_envs=16", "agent.num_steps=8", "agent.hidden_size=8")


def test_a_run_returns_its_objective(compose, monkeypatch, tmp_path, capsys):
    cfg = compose(*SHORT, "objective=open_loop_ceiling")

    value = run(cfg, tmp_path)

    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert value == metrics["open_loop_ceiling"]["value"] > 0


def test_a_run_without_a_value_of_its_objective_says_why_and_keeps_its_results(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)

    code = command_line(monkeypatch, *SHORT, "objective=detection_delay", "hydra.run.dir=out")

    said = capsys.readouterr().err
    assert code == 1 and (tmp_path / "out" / "metrics.json").exists()
    assert f"error: objective=detection_delay has no value in {tmp_path}/out: the learner gives tasks no labels" in said


def test_the_objective_of_several_runs_is_their_mean(tmp_path):
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder, value in zip(folders, (0.25, 0.75), strict=True):
        folder.mkdir()
        metric = {"value": value, "definition": "a/b", "undefined": None}
        (folder / "metrics.json").write_text(json.dumps({"average_performance": metric}))

    assert objective_of("average_performance", folders) == 0.5


def test_the_objective_of_several_runs_needs_all_values(tmp_path):
    metric = {"value": None, "definition": "a/b", "undefined": "no evaluation"}
    (tmp_path / "metrics.json").write_text(json.dumps({"average_performance": metric}))

    with pytest.raises(ValueError, match=r"objective=average_performance has no value in .*: no evaluation"):
        objective_of("average_performance", [tmp_path])
