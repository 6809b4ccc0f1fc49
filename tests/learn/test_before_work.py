"""What is misused is refused before any work, with the rule, the value and the fix; what is allowed works."""

from __future__ import annotations

import errno
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.learning import train

from baselines.dqn import DQN
from baselines.ppo import PPO
from ctgraph_rl import (
    Block,
    CTGraph,
    CTGraphEnv,
    Curriculum,
    Evaluation,
    Protocol,
    Recorder,
    RunLog,
    evaluate,
    learn_curriculum,
    load,
)
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.log.files import LOG, METRICS
from ctgraph_rl.log.scores import scores
from ctgraph_rl.policies import OptimalPolicy
from ctgraph_rl.runs import job
from ctgraph_rl.runs.read import find_runs
from ctgraph_rl.runs.train import new_agent
from ctgraph_rl.tasks.configurations import ct_su_b1

TASKS = ct_su_b1((1, 1)), ct_su_b1((1, 2))
HELD_OUT = ct_su_b1((2, 2))
CURRICULUM = Curriculum("two", 1, "a test", tuple(Block(task, 16) for task in TASKS), Evaluation(2))

SIZES = {"num_envs": 2, "num_steps": 4, "hidden_size": 4, "learning_rate": 0.01, "gamma": 0.9, "max_grad_norm": 1.0}
GRADIENT = {"num_layers": 1, "optimiser": "adam", "normalize_advantage": True, "clip_epsilon": 0.2}
EPOCHS = {"entropy_coeff": 0.01, "critic_coeff": 0.5, "num_epochs": 1, "num_minibatches": 1}
REPLAY = {"n_steps": 2, "buffer_size": 64, "batch_size": 4, "num_updates": 1, "target_update_interval": 3}
EXPLORATION = {"eps_init": 0.5, "eps_end": 0.1, "annealing_num_steps": 16, "replay_on_task_change": "clear"}
DOUBLE = {"double": True, "priority_alpha": 0.6, "priority_beta": 0.4}


def ppo(**changes):
    return partial(PPO, **{**SIZES, **GRADIENT, **EPOCHS, **changes})


def dqn(**changes):
    return partial(DQN, **{**SIZES, **REPLAY, **EXPLORATION, **DOUBLE, **changes})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((CURRICULUM, PPO, 0), "make_agent must take two specs and nothing else, PPO: missing"),
        ((CURRICULUM, None, 0), "make_agent must be a function of two specs.*got None"),
        ((CURRICULUM, ppo(), -1), "seed must be an integer"),
        ((CURRICULUM, ppo(), 0, "cuda:99"), "device must be one of"),
        ((None, ppo(), 0), "curriculum must be a Curriculum, got None"),
        ((CURRICULUM, ppo(), "0"), r"seed must be an integer in \[0, 2\*\*63\), got '0'"),
        ((CURRICULUM, lambda *specs: PPO, 0), "PPO is no agent, it lacks num_envs, .*new_agent"),
        ((CURRICULUM, lambda *specs: ppo(), 0), "partial is no agent.*new_agent"),
        ((replace(CURRICULUM, blocks=(Block(TASKS[0], 15),)), ppo(), 0), "num_frames=15 of block 1"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_new_agent_refuses_what_it_cannot_use(arguments, message):
    with pytest.raises(ValueError, match=message):
        new_agent(*arguments)


@pytest.mark.parametrize("device", ["cuda:99", "meta", 3, "nothing", torch.device("meta")], ids=str)
def test_devices_that_are_not_there_are_refused_everywhere(device):
    message = "device must be one of cpu.*on this machine, got"
    uses = (
        lambda: CTGraphEnv(TASKS, device=device),
        lambda: Rows(TASKS, device=device),
        lambda: evaluate(OptimalPolicy, TASKS, 2, device=device),
        lambda: learn_curriculum(CURRICULUM, new_agent(CURRICULUM, ppo(), 0), device=device),
        lambda: load("nowhere", device=device),
    )
    for use in uses:
        with pytest.raises(ValueError, match=message):
            use()


@pytest.mark.parametrize("every", [0, 8, 64])
def test_a_curriculum_that_only_evaluates_held_out_tasks_ends_with_results(tmp_path, every):
    how = Evaluation(2, every=every, at_block_ends=False, tasks="seen", held_out=(HELD_OUT,))
    curriculum = replace(CURRICULUM, evaluation=how)

    train(curriculum, new_agent(curriculum, ppo(), 0), tmp_path, 0)

    metrics = json.loads((tmp_path / METRICS).read_text(encoding="utf-8"))
    assert (metrics["average_performance"]["value"] is None) == (every != 8)
    assert metrics["regret"]["value"] is not None


def test_logs_without_labels_give_the_same_metrics_and_show_task_numbers(tmp_path):
    train(CURRICULUM, new_agent(CURRICULUM, ppo(), 0), tmp_path, 0)
    log = RunLog.read(tmp_path / LOG)
    expected = scores(log, CURRICULUM)

    for measurement in log.measurements:
        measurement.pop("label", None)
    (tmp_path / LOG).write_text("".join(json.dumps(m) + "\n" for m in log.measurements), encoding="utf-8")

    assert scores(RunLog.read(tmp_path / LOG), CURRICULUM) == expected
    assert {regime.task for regime in log.regimes()} == {"task 1", "task 2"}
    (run,), problems = find_runs([tmp_path])
    assert (run.tasks, run.reason, problems) == (["task 1", "task 2"], None, [])


def test_the_log_of_a_larger_curriculum_is_refused():
    log = RunLog()
    log.append("evaluation", moment="before", block=0, frames=0, task=3, label="x", held_out=False, return_mean=0.0)

    with pytest.raises(ValueError, match="the log has task 3 and block 0, two has 2 tasks and 2 blocks"):
        scores(log, CURRICULUM)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (ppo(num_layers=10**6), "num_layers must be at most 1,000, got 1000000"),
        (ppo(hidden_size=10**9), "weights of hidden_size=1000000000 in num_layers=1 need 2,368,000,000,000 bytes"),
        (ppo(hidden_size=2**70), r"hidden_size must be an integer < 2\*\*63"),
        (ppo(gamma=1e-4, gae_lambda=1e-4), r"gamma \* gae_lambda must be >= 1e-06, got 0.0001 \* 0.0001"),
        (ppo(num_epochs=10**9), "num_epochs must be at most 1,000,000"),
        (ppo(clip_epsilon=5.0), "clip_epsilon must be at most 1, got 5.0"),
        (ppo(optimiser=np.array(["adam", "rmsprop"])), "optimiser must be one of"),
        (ppo(normalize_advantage=np.array([True, False])), "normalize_advantage must be true or false"),
        (dqn(priority_alpha=50.0), "priority_alpha must be at most 4, got 50.0"),
        (dqn(n_steps=10**12), "n_steps must be at most 10,000"),
        (dqn(buffer_size=10**15), "replay of buffer_size=1000000000000000 steps need"),
        (dqn(batch_size=10**15), "minibatches of batch_size=1000000000000000 need"),
        (dqn(num_updates=10**12), "num_updates must be at most 1,000,000"),
        (dqn(target_update_interval=2**70), r"target_update_interval must be an integer < 2\*\*63"),
    ],
    ids=lambda value: str(value)[:40] if isinstance(value, str) else "agent",
)
def test_hyperparameters_that_cannot_work_are_refused_with_their_limit(make, message):
    with pytest.raises(ValueError, match=message):
        new_agent(CURRICULUM, make, 0)


@pytest.mark.parametrize("make", [ppo(gamma=1e-3, gae_lambda=1.01e-3), dqn(priority_alpha=4.0)])
def test_hyperparameters_at_their_limits_learn(make):
    assert learn_curriculum(CURRICULUM, new_agent(CURRICULUM, make, 0)).performance().shape == (3, 2)


def test_quantiles_that_no_machine_can_compare_are_refused(compose):
    agent = ("agent=qrdqn_lstm", "agent.num_quantiles=1000000000")

    with pytest.raises(ValueError, match=r"need .* bytes, this machine has"):
        new_agent(CURRICULUM, job.config.target(compose(*agent), "agent"), 0)


@pytest.mark.parametrize("flags", [np.array([True, False]), torch.tensor([True, False])], ids=type)
def test_arrays_are_no_flags_and_no_choices(flags):
    uses = {
        "reward_noise": lambda: replace(TASKS[0], reward_noise=flags),
        "extra_end_step": lambda: replace(TASKS[0], extra_end_step=flags),
        "task_id": lambda: Protocol(task_id=flags),
        "boundaries": lambda: Protocol(boundaries=flags),
        "tasks": lambda: Evaluation(tasks=flags),
        "greedy": lambda: Evaluation(greedy=flags),
        "kernel": lambda: CTGraphEnv(TASKS, kernel=flags),
        "check_actions": lambda: CTGraphEnv(TASKS, check_actions=flags),
    }
    for name, use in uses.items():
        with pytest.raises(ValueError, match=f"{name} must be"):
            use()


def test_ids_of_tasks_are_a_mapping_and_small_enough_to_be_one_hot():
    for ids in (3, [0], {TASKS[0]: 2**40}):
        with pytest.raises(ValueError, match="task_ids must"):
            CTGraphEnv(TASKS, task_ids=ids)


def test_the_optimal_value_of_a_needle_takes_no_memory_for_branches():
    wide = replace(TASKS[0], graph=CTGraph(2**60, 1), goal=(1,))

    assert wide.optimal_value(1.0) == 1.0
    assert wide.optimal_value(0.5) == replace(wide, graph=CTGraph(2, 1)).optimal_value(0.5)


@pytest.mark.parametrize("path", ["x" * 300, "y/" * 2100, "a\0b", 3], ids=["name", "path", "null", "number"])
def test_paths_that_no_file_system_takes_are_refused(path):
    uses = (
        lambda: Recorder(CURRICULUM, path),
        lambda: load(path),
        lambda: RunLog(path),
        lambda: RunLog.read(path),
        lambda: CURRICULUM.to_json(path),
        lambda: Curriculum.from_json(path),
    )
    for use in uses:
        with pytest.raises(ValueError, match=r"path|run_dir|must be a JSON file"):
            use()


def test_a_source_that_is_no_text_is_refused():
    with pytest.raises(ValueError, match="source must be a text, got None"):
        replace(CURRICULUM, source=None)


def test_a_finished_run_in_a_read_only_directory_is_shown(compose, tmp_path, monkeypatch, capsys):
    small = ("agent.num_envs=2", "agent.num_steps=8", "agent.hidden_size=4", "evaluation.num_episodes=2")
    cfg = compose("curriculum=su_b1_4tasks", "curriculum.num_frames=16", "agent=reinforce", *small)
    job.run_job(cfg, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def refused(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(job.Session, "lock", refused)
    monkeypatch.setattr("os.access", lambda path, mode: False)
    job.run_job(cfg, tmp_path)

    assert "this configuration was run before" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    with pytest.raises(OSError, match="Read-only"):
        job.run_job(compose("overwrite=true", *small), Path(tmp_path))
