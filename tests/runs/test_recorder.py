"""Recorder: policies of any make, measured by a curriculum's protocol."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.oracles import surjective
from helpers.scripted import DECISION_ID, ONE, TWO, Scripted, curriculum, decide
from stable_baselines3 import PPO

import curricula
from ctgraph_rl import Block, Curriculum, Evaluation, Protocol, RunLog, learn_curriculum
from ctgraph_rl.policies import NavigationPolicy
from ctgraph_rl.runs.recorder import Recorder
from ctgraph_rl.runs.trackers import csv_logger
from ctgraph_rl.runs.train import RESULTS
from ctgraph_rl.sb3 import SB3VecEnv

TASKS = curriculum(Block(ONE, 12), Block(TWO, 24))


def table(decision: int):
    """A lookup table: waits, and takes one decision."""
    return lambda observation: observation[:, DECISION_ID].astype(np.int64) * decision


def without_time(measurements) -> list[dict]:
    return [{key: value for key, value in m.items() if key != "seconds"} for m in measurements]


def test_a_policy_of_arrays_is_measured_as_the_same_policy_in_our_loop():
    ours = learn_curriculum(TASKS, Scripted(decide(2)), seed=3)
    recorder = Recorder(TASKS, seed=3)

    found = [recorder.evaluate(table(2), frames) for frames in recorder.moments]

    assert recorder.moments == (0, 12, 36)
    assert found == [{"goal1": 0.0, "goal2": 1.0}] * 3
    assert without_time(recorder.log.of_kind("evaluation")) == without_time(ours.of_kind("evaluation"))
    assert recorder.log.performance().tolist() == ours.performance().tolist()


def test_it_writes_the_files_of_a_run(tmp_path):
    with Recorder(TASKS, tmp_path / "mine", about={"learner": "a table"}) as recorder:
        for decision, frames in enumerate(recorder.moments, 1):
            recorder.evaluate(table(min(decision, 2)), frames)
            if frames:
                recorder.training(frames, return_mean=0.5, episodes=3)

    log = RunLog.read(tmp_path / "mine" / "run.jsonl")
    run, metrics = log.of_kind("run")[0], json.loads((tmp_path / "mine" / "metrics.json").read_text())
    assert (run["fingerprint"], run["config"]) == (TASKS.fingerprint, {"seed": 0, "learner": "a table"})
    assert (run["tasks"], run["trained"]) == (["goal1", "goal2"], [[1], [2]])
    assert {path.name for path in (tmp_path / "mine").iterdir()} == set(RESULTS) - {"agent.pt"}
    assert [(m["block"], m["return_mean"], m["episodes"]) for m in log.of_kind("training")] == [
        (1, 0.5, 3),
        (2, 0.5, 3),
    ]
    assert metrics["average_performance"]["value"] == 0.5
    assert metrics["forward_transfer"]["value"] == 1.0  # after block 1 the table has the second task's decision


def test_a_policy_with_memory_is_given_its_state_and_the_starts_of_episodes():
    starts = []

    def remember(observation, state, start):
        steps = np.where(start, 0, 0 if state is None else state + 1)
        starts.append(start.copy())
        return np.where(steps == 2, 1, 0), steps  # home, wait, decision

    found = Recorder(TASKS).evaluate(remember, 0)

    assert found == {"goal1": 1.0, "goal2": 0.0}
    assert starts[0].all() and not any(start.any() for start in starts[1:])


def test_task_ids_are_shown_with_the_observations():
    told = Curriculum("told", 1, "here", TASKS.blocks, Evaluation(5), Protocol("one_hot", num_task_ids=4))

    def by_task(observation):
        assert observation["task_id"].shape == (10, 4)
        decision = 1 + observation["task_id"].argmax(1)
        return observation["observation"][:, DECISION_ID].astype(np.int64) * decision

    assert Recorder(told).evaluate(by_task, 0) == {"goal1": 1.0, "goal2": 1.0}


def test_a_policy_for_each_task_id_plays_its_own_task():
    given = Curriculum("given", 1, "here", TASKS.blocks, Evaluation(5), Protocol("at_boundaries", task_ids=(2, 1)))

    found = Recorder(given).evaluate(policy_for=table)  # decision 2 for the first task, 1 for the second

    assert found == {"goal1": 0.0, "goal2": 0.0}
    assert Recorder(given).evaluate(policy_for=lambda number: table(3 - number)) == {"goal1": 1.0, "goal2": 1.0}


def test_evaluation_leaves_random_numbers_of_torch_as_they_were():
    recorder = Recorder(TASKS)
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)

    recorder.evaluate(lambda observation: torch.randint(0, 3, (len(observation),)).numpy(), 0)

    assert torch.equal(torch.rand(3), expected)


def test_moments_of_the_users_own_are_evaluations_during_a_block():
    recorder = Recorder(TASKS)

    for frames in (5, 12, 13, 36):
        recorder.evaluate(table(1), frames)

    evaluations = recorder.log.of_kind("evaluation")
    assert [m["moment"] for m in evaluations[::2]] == ["during", "after", "during", "after"]
    assert [m["block"] for m in evaluations[::2]] == [1, 1, 2, 2]


def test_a_missing_evaluation_makes_what_needs_it_undefined():
    recorder = Recorder(TASKS)

    for frames in (0, 36):
        recorder.evaluate(table(2), frames)

    assert recorder.metrics["average_performance"].value == 0.5
    assert recorder.metrics["backward_transfer"].value is None
    assert recorder.metrics["backward_transfer"].undefined


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": table(1), "frames": 37}, "frames must be an integer in 0..36, the curriculum's, got 37"),
        ({"policy": table(1), "frames": 1.5}, "frames must be an integer"),
        ({"policy": None}, "give either policy or policy_for"),
        ({"policy": 3}, "policy must be a function, or an object with predict, got int"),
        ({"policy": lambda a, b: a}, "not 2 arguments"),
        ({"policy": lambda observation: observation[:, 0] * 0.5}, "must return 10 integer actions.*float64"),
        ({"policy": lambda observation: 0}, "must return 10 integer actions"),
        ({"policy": lambda observation: np.full(10, 7)}, "values in 0..2, got"),
    ],
)
def test_what_is_no_policy_or_out_of_range_is_refused(arguments, message):
    recorder = Recorder(TASKS)

    with pytest.raises(ValueError, match=message):
        recorder.evaluate(**arguments)


def test_frames_must_grow_and_a_log_is_not_overwritten(tmp_path):
    recorder = Recorder(TASKS, tmp_path)
    recorder.evaluate(table(1), 12)

    with pytest.raises(ValueError, match="frames must grow: 12 comes after 12"):
        recorder.evaluate(table(1), 12)
    with pytest.raises(FileExistsError):
        Recorder(TASKS, tmp_path)


class Learner:
    """A table that takes more decisions the longer it has learned, in batches of 4 frames."""

    def __init__(self) -> None:
        self.batches = 0

    def state_dict(self) -> dict:
        return {"batches": self.batches}

    def learn(self, recorder: Recorder, stop: int | None = None) -> None:
        """Learn the rest of a curriculum; a stop is an error after so many frames."""
        self.batches = (recorder.saved or self.state_dict())["batches"]
        if recorder.saved is None:
            recorder.evaluate(table(0), 0)
        for frames in range(recorder.frames + 4, TASKS.num_frames + 1, 4):
            self.batches += 1
            recorder.training(frames, loss=1 / self.batches)
            if frames in recorder.moments:
                recorder.evaluate(table(1 + (self.batches > 3)), frames)
            recorder.checkpoint(self.state_dict, frames)
            if frames == stop:
                recorder.training(frames + 4, loss=7.0)
                raise InterruptedError


@pytest.mark.parametrize("stop", [4, 12, 20])
def test_a_run_that_was_stopped_is_resumed_and_ends_as_if_it_had_never_been(tmp_path, stop):
    with Recorder(TASKS, tmp_path / "whole") as recorder:
        Learner().learn(recorder)
    with pytest.raises(InterruptedError), Recorder(TASKS, tmp_path / "run", checkpoint_seconds=0) as recorder:
        Learner().learn(recorder, stop)

    with Recorder(TASKS, tmp_path / "run", resume=True) as recorder:
        reached = recorder.frames, recorder.saved
        with pytest.raises(ValueError, match=f"frames must grow: {stop} comes after {stop}"):
            recorder.training(stop)
        Learner().learn(recorder)

    whole, run = (RunLog.read(tmp_path / name / "run.jsonl").measurements for name in ("whole", "run"))
    assert reached == (stop, {"batches": stop // 4})
    assert without_time(whole) == without_time(run)
    assert (tmp_path / "run" / "performance.csv").read_bytes() == (tmp_path / "whole" / "performance.csv").read_bytes()
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({}, FileExistsError, r"is of a run that was stopped: choose .*, or overwrite=True .*, or resume=True"),
        ({"resume": True, "seed": 1}, ValueError, "holds a run with seed=0 instead of 1: give what it was begun with"),
        ({"resume": True, "curriculum": curriculum(Block(ONE, 12))}, ValueError, r"holds a run of .* \(fingerprint"),
        ({"resume": True, "about": {"lr": 1}}, ValueError, "holds a run with lr=None instead of 1"),
        ({"resume": True, "overwrite": True}, ValueError, "give either overwrite or resume"),
        ({"resume": "yes"}, ValueError, "resume must be true or false, got 'yes'"),
        ({"run_dir": None, "resume": True}, ValueError, "overwrite, resume and logger need a run_dir"),
        ({"overwrite": True, "logger": "cvs"}, ValueError, "unknown logger 'cvs': did you mean 'csv'"),
        ({"overwrite": True, "logger": 3}, ValueError, "logger must be a name such as 'csv', a function of a folder"),
    ],
)
def test_a_directory_with_a_run_is_resumed_or_replaced_only_as_it_is_said(tmp_path, changes, error, message):
    with pytest.raises(InterruptedError), Recorder(TASKS, tmp_path) as recorder:
        Learner().learn(recorder, 4)
    before = (tmp_path / "run.jsonl").read_bytes()

    with pytest.raises(error, match=message):
        Recorder(**{"curriculum": TASKS, "run_dir": tmp_path, **changes})

    assert (tmp_path / "run.jsonl").read_bytes() == before


def test_overwrite_replaces_a_finished_run_that_resume_does_not(tmp_path):
    for _ in range(2):
        with Recorder(TASKS, tmp_path, overwrite=True) as recorder:
            assert [recorder.saved, *(path.name for path in tmp_path.iterdir())] == [None, "run.jsonl"]
            Learner().learn(recorder)

    with pytest.raises(FileExistsError, match="is of a finished run: choose another run_dir, or overwrite=True"):
        Recorder(TASKS, tmp_path, resume=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (({}, 4), "state must be a function that makes the state, such as model.state_dict"),
        ((dict, 3), r"frames must be an integer in 4..36, got 3"),
        ((lambda: {"path": object()}, 4), "holds tensors and plain Python values"),
    ],
)
def test_a_checkpoint_that_could_not_be_resumed_from_is_refused(tmp_path, arguments, message):
    recorder = Recorder(TASKS, tmp_path)
    recorder.training(4)

    with pytest.raises(ValueError, match=message):
        recorder.checkpoint(*arguments)


@pytest.mark.parametrize("logger", ["csv", csv_logger])
def test_a_logger_has_measurements_as_they_are_made_and_all_of_a_resumed_run(tmp_path, logger):
    values = tmp_path / "tracker" / "scalars" / "train" / "loss.csv"
    with pytest.raises(InterruptedError), Recorder(TASKS, tmp_path, logger=logger) as recorder:
        Learner().learn(recorder, 4)
    first = values.read_text()

    with Recorder(TASKS, tmp_path, logger=logger, resume=True) as recorder:
        Learner().learn(recorder)

    assert first.splitlines() == ["4,1.0", "8,7.0"]
    assert [line.partition(",")[0] for line in values.read_text().splitlines()] == [str(4 * i) for i in range(1, 10)]


def test_what_json_cannot_hold_is_refused_before_anything_is_written(tmp_path):
    for about, message in (
        ({"x": object()}, "about must be plain JSON values by name"),
        (["x"], "about must be plain JSON values by name"),
        ({"seed": 9}, "about must leave out the seed"),
    ):
        with pytest.raises(ValueError, match=message):
            Recorder(TASKS, tmp_path / "mine", about=about)

    assert list(tmp_path.iterdir()) == []


def test_training_takes_scalars_of_any_make_in_order_of_frames():
    recorder = Recorder(TASKS)

    recorder.training(6, loss=np.float32(0.5), entropy=torch.tensor(2.0), return_mean=None)

    (line,) = recorder.log.of_kind("training")
    assert [(type(line[name]), line[name]) for name in ("loss", "entropy")] == [(float, 0.5), (float, 2.0)]
    for frames, values, message in (
        (6, {}, "frames must grow: 6 comes after 6"),
        (12, {"loss": "low"}, "loss must be numbers or None"),
        (12, {"loss": np.zeros(2)}, "loss must be numbers or None"),
        (12, {"block": 2}, "block are fields of every line"),
    ):
        with pytest.raises(ValueError, match=message):
            recorder.training(frames, **values)
    assert len(recorder.log.of_kind("training")) == 1


def test_an_evaluation_that_failed_can_be_made_again():
    recorder = Recorder(TASKS)
    with pytest.raises(ValueError, match="integer actions"):
        recorder.evaluate(lambda observation: np.zeros(len(observation)), 0)

    assert recorder.evaluate(table(1), 0) == {"goal1": 1.0, "goal2": 0.0}


@pytest.mark.parametrize("learned", [None, 12])
def test_a_recorder_that_is_closed_early_writes_its_files(tmp_path, learned):
    with Recorder(TASKS, tmp_path) as recorder:
        if learned:
            recorder.training(learned, episodes=2, return_mean=0.5, success_rate=0.5)

    written = json.loads((tmp_path / "metrics.json").read_text())
    assert written["average_performance"]["value"] is None
    assert written["regret"]["value"] == (1.0 if learned else None)


def test_a_policy_for_each_task_id_needs_a_protocol_that_gives_it_and_tasks_that_have_one():
    held_out = Curriculum("held", 1, "here", (Block(ONE, 12),), Evaluation(held_out=(TWO,)), Protocol("at_boundaries"))

    for told, message in (
        (TASKS, "task ids, which are hidden in this protocol"),
        (held_out, "held-out tasks, which have no task id"),
    ):
        with pytest.raises(ValueError, match=message):
            Recorder(told).evaluate(policy_for=table)


def test_changing_goals_that_are_only_held_out_need_rows_of_several_episodes():
    changing = replace(TWO, goal_change=(1, 2))

    with pytest.raises(ValueError, match="episodes_per_row > 1"):
        Recorder(replace(TASKS, evaluation=Evaluation(held_out=(changing,))))


def test_arguments_with_a_default_are_left_to_the_policy():
    def act(observation, decision=2, scale=1):
        return table(decision * scale)(observation)

    assert Recorder(TASKS).evaluate(act, 0) == {"goal1": 0.0, "goal2": 1.0}


@pytest.mark.parametrize("greedy", [True, False])
def test_a_model_is_greedy_where_the_protocol_says_so(greedy):
    asked = []

    class Model:
        def predict(self, observation, state, episode_start, deterministic):
            asked.append(deterministic)
            return table(1)(observation), state

    Recorder(replace(TASKS, evaluation=Evaluation(5, greedy=greedy))).evaluate(Model(), 0)

    assert set(asked) == {greedy}


def test_an_error_in_the_users_loop_leaves_an_unfinished_run(tmp_path):
    with pytest.raises(RuntimeError), Recorder(TASKS, tmp_path):
        raise RuntimeError("the user's own")

    assert [path.name for path in tmp_path.iterdir()] == ["run.jsonl"]


def test_a_reference_policy_is_given_as_its_class():
    one = Curriculum("one", 1, "here", (Block(surjective(), 8),), Evaluation(50))

    found = Recorder(one).evaluate(NavigationPolicy, 0)

    assert 0.0 < next(iter(found.values())) < 1.0


def test_a_model_without_a_place_for_task_ids_is_refused_with_the_fix():
    told = Curriculum("told", 1, "here", TASKS.blocks, Evaluation(5), Protocol("one_hot"))
    model = PPO("MlpPolicy", SB3VecEnv(2, ONE), n_steps=8, batch_size=16)

    with pytest.raises(ValueError, match=r"shows a task_id that PPO has no place for: .*protocol=Protocol\(\)"):
        Recorder(told).evaluate(model, 0)


def test_stable_baselines3_is_measured_by_the_protocol(tmp_path):
    published = curricula.su_b1_4tasks(num_frames=512)
    envs = SB3VecEnv(32, published.tasks[0], task_pool=published.tasks)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=64, n_epochs=1, seed=0)

    with Recorder(published, tmp_path / "sb3", about={"learner": "PPO of Stable-Baselines3"}) as recorder:
        recorder.evaluate(model, 0)
        for block, frames in zip(published.blocks, published.ends, strict=True):
            envs.env_method("set_tasks", block.rows(32))
            model.learn(block.num_frames)
            recorder.evaluate(model, frames)

    assert recorder.log.performance().shape == (5, 4)
    assert recorder.metrics["average_performance"].value == 0.0  # without memory, a little training: at most luck
    assert (tmp_path / "sb3" / "performance.csv").read_text().count("\n") == 6
