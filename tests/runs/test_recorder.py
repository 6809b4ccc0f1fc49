"""Recorder: policies of any make, measured by a curriculum's protocol."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.scripted import DECISION_ID, ONE, TWO, Scripted, curriculum, decide

from ctgraph_rl import Block, Evaluation, RunLog, learn_curriculum
from ctgraph_rl.log.sums import RESULTS
from ctgraph_rl.runs.read import read_run
from ctgraph_rl.runs.recorder import Recorder
from ctgraph_rl.runs.trackers import csv_logger

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


def test_a_seed_that_a_run_beside_it_has_is_noted(tmp_path, capsys):
    for name, given in (("0", {}), ("1", {}), ("2", {"seed": 2}), ("3", {"about": {"learner": "another"}})):
        Recorder(TASKS, tmp_path / name, **given).close()

    [note] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note")]
    assert note.startswith(f"note: {tmp_path / '0'} has seed 0 of the same learner, so tables count one: give this run")


def test_frames_must_grow_and_a_log_is_not_overwritten(tmp_path):
    recorder = Recorder(TASKS, tmp_path)
    recorder.evaluate(table(1), 12)

    with pytest.raises(ValueError, match="frames must grow: 12 comes after 12"):
        recorder.evaluate(table(1), 12)
    recorder.close()
    with pytest.raises(FileExistsError):
        Recorder(TASKS, tmp_path)


class Learner:
    """A table that takes more decisions the longer it has learned, in batches of 4 frames."""

    def __init__(self) -> None:
        self.batches = 0

    def state_dict(self) -> dict:
        return {"batches": self.batches}

    def learn(self, recorder: Recorder, stop: int | None = None, until: int = TASKS.num_frames) -> None:
        """Learn the rest of a curriculum; a stop is an error after so many frames."""
        self.batches = (recorder.saved or self.state_dict())["batches"]
        if recorder.saved is None:
            recorder.evaluate(table(0), 0)
        for frames in range(recorder.frames + 4, until + 1, 4):
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


def test_overwrite_replaces_a_finished_run(tmp_path):
    for _ in range(2):
        with Recorder(TASKS, tmp_path, overwrite=True) as recorder:
            assert recorder.saved is None
            assert {path.name for path in tmp_path.iterdir()} == {".lock", "run.jsonl", "curriculum.json"}
            Learner().learn(recorder)

    with pytest.raises(FileExistsError, match=r"is of a finished run: .*, or overwrite=True .*, or resume=True"):
        Recorder(TASKS, tmp_path)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_a_finished_run_that_is_resumed_shows_its_results_and_changes_no_file(tmp_path, capsys):
    with Recorder(TASKS, tmp_path) as recorder:
        Learner().learn(recorder)
    learned, before = recorder, contents(tmp_path)

    with Recorder(TASKS, tmp_path, resume=True, logger="csv") as recorder:
        learner = Learner()
        learner.learn(recorder)
        shown = recorder.evaluate(None, 36)
        recorder.checkpoint(learner.state_dict, 36)

    assert (recorder.finished, recorder.frames, learner.batches) == (True, 36, 0)
    assert shown == {m["label"]: m["return_mean"] for m in learned.log.of_kind("evaluation") if m["frames"] == 36}
    assert recorder.metrics == learned.metrics
    assert contents(tmp_path) == before
    assert not any(path.is_dir() for path in tmp_path.iterdir())
    assert capsys.readouterr().out.endswith("finished: its results are shown; overwrite=True runs it again\n")


def test_a_finished_run_is_shown_only_if_it_is_whole_and_was_never_another(tmp_path):
    with Recorder(TASKS, tmp_path) as recorder:
        Learner().learn(recorder)

    shown = Recorder(TASKS, tmp_path, resume=True)
    with pytest.raises(ValueError, match="is finished and has no evaluation after 4 frames"):
        shown.evaluate(table(0), 4)
    with pytest.raises(ValueError, match="holds a run with seed=0 instead of 1"):
        Recorder(TASKS, tmp_path, seed=1, resume=True)
    (tmp_path / "curriculum.json").write_text("{}")
    with pytest.raises(ValueError, match=r"says that it is complete, but curriculum.json cannot be read"):
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


def test_a_recorder_is_copied_only_where_it_writes_no_files(tmp_path):
    alone = Recorder(TASKS)
    copied = deepcopy(alone)

    copied.evaluate(table(1), 0)

    assert (len(alone.log.of_kind("evaluation")), len(copied.log.of_kind("evaluation"))) == (0, 2)
    with pytest.raises(TypeError, match=r"a Recorder that writes into .* has no copies"):
        deepcopy(Recorder(TASKS, tmp_path))


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


@pytest.mark.parametrize("stop", [0, 12, 24])
def test_a_recorder_that_is_closed_early_leaves_a_run_to_be_resumed(tmp_path, capsys, stop):
    with Recorder(TASKS, tmp_path / "run", about={"learner": "a table"}) as recorder:
        if stop:
            Learner().learn(recorder, until=stop)

    said = "is not finished: it needs the evaluation after 36 frames; resume=True resumes it"
    assert said in capsys.readouterr().out
    run = read_run(tmp_path / "run")
    assert (run.reason, run.metrics) == (f"unfinished: {stop} of 36 frames", {})

    with Recorder(TASKS, tmp_path / "run", about={"learner": "a table"}, resume=True) as recorder:
        Learner().learn(recorder)
    assert read_run(tmp_path / "run").reason is None


def test_changing_goals_that_are_only_held_out_need_rows_of_several_episodes():
    changing = replace(TWO, goal_change=(1, 2))

    with pytest.raises(ValueError, match="episodes_per_row > 1"):
        Recorder(replace(TASKS, evaluation=Evaluation(held_out=(changing,))))


def test_an_error_in_the_users_loop_leaves_an_unfinished_run(tmp_path):
    with pytest.raises(RuntimeError), Recorder(TASKS, tmp_path):
        raise RuntimeError("the user's own")

    assert {path.name for path in tmp_path.iterdir()} == {"run.jsonl", "curriculum.json"}
