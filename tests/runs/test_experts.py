"""Single-task experts: trained once, kept by fingerprint, named in the log, compared with."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import replace

import pytest
from helpers.scripted import ONE, TWO
from helpers.sweeping import command_line

from ctgraph_rl import Block, Curriculum, Evaluation, Protocol, RunLog
from ctgraph_rl.log import files
from ctgraph_rl.log.provenance import NUMBERS, versions
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.run import run
from ctgraph_rl.runs import job
from ctgraph_rl.runs.experts import directory_name, expert_curriculum, find_or_train

SETTINGS = {"agent": {"gamma": 0.9}, "seed": 0}
ONE_SEED = {0: SETTINGS}


def curriculum(*blocks: Block, **changes) -> Curriculum:
    return Curriculum("mine", 1, "here", blocks or (Block(ONE, 12), Block(TWO, 24), Block(ONE, 36)), **changes)


def write_result(trained: list):
    """Stands for learning: keeps what is learned and writes a result."""

    def learn(alone, run_dirs, session):
        for run_dir in run_dirs.values():
            trained.append(alone)
            finish(run_dir)
        return {}

    return learn


def finish(run_dir) -> None:
    (run_dir / "run.jsonl").write_text('{"kind": "run"}\n')
    write_metrics(run_dir / "metrics.json", {})


def test_an_expert_has_its_task_alone_for_the_frames_of_its_first_block():
    evaluation = Evaluation(7, every=6, tasks="seen", held_out=(replace(ONE, goal_reward=2.0),))
    told = Protocol("one_hot", num_task_ids=9, task_ids=(4, 2))

    alone = expert_curriculum(curriculum(evaluation=evaluation, protocol=told), TWO)

    assert alone.blocks == (Block(TWO, 24),)
    assert alone.evaluation == Evaluation(7, every=6)
    assert alone.protocol == Protocol("one_hot", num_task_ids=9, task_ids=(2,))
    assert expert_curriculum(curriculum(), ONE).blocks == (Block(ONE, 12),)


def test_hidden_boundaries_mean_nothing_to_a_single_task():
    hidden = curriculum(protocol=Protocol(boundaries="hidden"))

    assert expert_curriculum(hidden, ONE) == expert_curriculum(curriculum(), ONE)


def test_an_expert_of_tasks_that_share_a_block_is_refused():
    with pytest.raises(ValueError, match="experts need blocks of one task each"):
        expert_curriculum(curriculum(Block((ONE, TWO), 12)), ONE)


def test_no_expert_is_trained_twice(tmp_path):
    trained, told = [], []

    first = find_or_train(curriculum(), write_result(trained), tmp_path, ONE_SEED, told.append)[0][0]
    again = find_or_train(curriculum(Block(TWO, 24)), write_result(trained), tmp_path, ONE_SEED, told.append)[0][0]

    assert [alone.tasks for alone in trained] == [(ONE,), (TWO,)]
    assert again[0].run_dir == first[1].run_dir
    assert [expert.task for expert in first] == [1, 2]
    assert ["found in" in line for line in told] == [False, False, True]
    assert {path.name for path in tmp_path.iterdir()} == {expert.run_dir.name for expert in first}


@pytest.mark.parametrize(
    "change", [{"settings": {**SETTINGS, "seed": 1}}, {"evaluation": Evaluation(3)}, {"num_frames": 48}]
)
def test_another_seed_evaluation_or_budget_is_another_expert(tmp_path, change):
    trained = []
    find_or_train(curriculum(Block(ONE, 24)), write_result(trained), tmp_path, ONE_SEED, print)

    other = curriculum(Block(ONE, change.get("num_frames", 24)), evaluation=change.get("evaluation", Evaluation()))
    find_or_train(other, write_result(trained), tmp_path, {0: change.get("settings", SETTINGS)}, print)

    assert len(trained) == 2


def test_an_expert_that_was_stopped_is_gone_on_with(tmp_path):
    begun = []

    def stop(alone, run_dirs, session):
        [run_dir] = run_dirs.values()
        begun.append(run_dir)
        (run_dir / "run.jsonl").write_text("half")
        raise KeyboardInterrupt

    def go_on(alone, run_dirs, session):
        [run_dir] = run_dirs.values()
        assert (run_dir / "run.jsonl").read_text() == "half"
        write_metrics(run_dir / "metrics.json", {})
        return {}

    with pytest.raises(KeyboardInterrupt):
        find_or_train(curriculum(Block(ONE, 12)), stop, tmp_path, ONE_SEED, print)
    [expert] = find_or_train(curriculum(Block(ONE, 12)), go_on, tmp_path, ONE_SEED, print)[0][0]

    assert begun == [expert.run_dir]
    assert sorted(path.name for path in expert.run_dir.iterdir()) == ["metrics.json", "run.jsonl"]


def test_a_run_trains_its_experts_and_says_which_it_used(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    short = ["curriculum=ct2_interfering", "curriculum.num_frames=256", "agent=ppo", "evaluation.every=128"]
    small = ["agent.num_envs=16", "agent.num_steps=8", "agent.num_minibatches=2", "evaluation.num_episodes=4"]

    codes = [
        command_line(monkeypatch, *short, *small, "experts=true", f"hydra.run.dir={name}", *more)
        for name, more in (("a", []), ("b", ["overwrite=true"]))
    ]

    said = capsys.readouterr().out
    logs = [RunLog.read(tmp_path / name / "run.jsonl") for name in "ab"]
    (used,) = logs[0].of_kind("experts")
    metrics = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert codes == [None, None] or codes == [0, 0]
    assert said.count("learns into runs/experts/") == said.count("found in runs/experts/") == 2
    assert [expert["task"] for expert in used["experts"]] == [1, 2]
    assert all((tmp_path / expert["run"] / "run.jsonl").exists() for expert in used["experts"])
    assert logs[1].of_kind("experts")[0]["experts"] == used["experts"]
    transfer = metrics["continual_world_forward_transfer"]
    assert transfer["undefined"] is None or "the expert leaves nothing" in transfer["undefined"]


def test_an_expert_that_another_process_trains_is_waited_for_and_not_trained_again(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "SECONDS_BETWEEN_ATTEMPTS", 0.01)
    alone = expert_curriculum(curriculum(Block(ONE, 12)), ONE)
    run_dir = tmp_path / directory_name(alone, SETTINGS)
    run_dir.mkdir()
    waited, theirs = [], []

    with ExitStack() as other:
        other.enter_context(files.locked(run_dir))

        def waiting():
            waited.append(1)
            if len(waited) == 3:
                finish(run_dir)
                theirs.append((run_dir / "metrics.json").read_text())
                other.close()

        learn = lambda *_: pytest.fail("trained twice")  # noqa: E731
        found, _ = find_or_train(curriculum(Block(ONE, 12)), learn, tmp_path, ONE_SEED, print, waiting=waiting)

    [expert] = found[0]
    assert len(waited) == 3
    assert [(expert.run_dir / "metrics.json").read_text()] == theirs


def test_an_expert_is_kept_by_agent_seed_device_threads_and_versions(compose, monkeypatch, tmp_path):
    asked = []

    def find(*arguments, **_):
        asked.append(arguments[3])
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "find_or_train", find)
    cfg = compose("agent=dqn", "agent.gamma=0.5", "seed=3", "experts=true")
    with pytest.raises(KeyboardInterrupt):
        job.run_job(cfg, tmp_path)

    agent = {**asked[0][3].pop("agent")}
    assert (agent["_target_"], agent["gamma"]) == (cfg.agent._target_, 0.5)
    made = {"seed": 3, "device": "cpu", "num_threads": 1, "versions": versions(), "numbers": NUMBERS}
    assert asked == [{3: made}]


def test_experts_that_cannot_be_are_refused_before_anything_is_written(compose, tmp_path):
    drift = ["curriculum=axes", "curriculum.switch=drift", "agent=ppo"]

    with pytest.raises(ValueError, match="experts need blocks of one task each"):
        run(compose(*drift, "experts=true", f"experts_dir={tmp_path / 'experts'}"), tmp_path)

    assert list(tmp_path.iterdir()) == []
