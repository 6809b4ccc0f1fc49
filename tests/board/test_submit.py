"""Submissions are made of finished runs of a track; each broken rule is named, and nothing is written then."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.made_runs import sum_again
from helpers.sweeping import command_line

from ctgraph_rl import Recorder, RunLog
from ctgraph_rl.board import submit as module
from ctgraph_rl.board.method_yaml import fact_rules, read_method
from ctgraph_rl.board.rescore import oracle_rule, rescore, scores_of
from ctgraph_rl.board.submission import log_sum, read_submission
from ctgraph_rl.board.submit import submit
from ctgraph_rl.log.files import locked_new
from ctgraph_rl.log.provenance import NUMBERS
from ctgraph_rl.log.saved import sum_of_state
from ctgraph_rl.runs.config import plain


@pytest.fixture
def runs(tiny_home, tmp_path) -> Path:
    """Runs of the tiny track that a test may change."""
    return Path(shutil.copytree(tiny_home / "runs", tmp_path / "runs"))


def edit(run: Path, change: Callable[[dict], object]) -> None:
    """Change the first line of a run's log."""
    first, rest = (run / "run.jsonl").read_text().split("\n", 1)
    about = json.loads(first)
    change(about)
    (run / "run.jsonl").write_text(json.dumps(about) + "\n" + rest)
    sum_again(run)


def test_a_submission_has_a_line_for_each_seed_and_what_the_logs_give(tiny_submission, tiny_home, tiny_track):
    made, run_dir = tiny_submission, tiny_home / "runs" / "tiny-seed1"
    second, log = made.runs[1], RunLog.read(run_dir / "run.jsonl")

    assert (second.run, second.seed, second.finished, second.group) == ("seed1", 1, True, ())
    assert made.curriculum == tiny_track.curriculum
    assert second.log_sha256 == log_sum(log) == log_sum(made.log(second))
    assert second.agent_sha256 == sum_of_state(torch.load(run_dir / "agent.pt", weights_only=True))
    assert {"seed": 1, **made.config} == log.measurements[0]["config"]
    assert made.versions == log.measurements[0]["versions"]
    metrics = json.loads((run_dir / "metrics.json").read_text())
    assert scores_of(made, second) == {name: metrics[name]["value"] for name in ("average_performance", "forgetting")}
    assert (made.method["track"], made.method["given"]["task_id"]) == ("tiny", "hidden")
    assert made.method["compute"]["hours"] == round(sum(run.seconds for run in made.runs) / 3600, 4)


def test_the_sum_of_a_log_leaves_out_times_versions_and_the_machine_and_nothing_else(tiny_submission):
    log = tiny_submission.log(tiny_submission.runs[0])
    before = log_sum(log)
    first, last = log.measurements[0], log.measurements[-1]

    first.update({"seconds": 9.0, "versions": {}, "machine": "other", "cpu": "other", "num_threads": 9})
    first["config"]["protocol"]["guide_frames"] = None  # the value for "as before" of a setting that was added
    last["seconds"] = 99.0
    assert log_sum(log) == before

    last["return_mean"] += 1e-12
    assert log_sum(log) != before


def test_the_sum_of_a_state_depends_on_names_types_shapes_and_bits():
    states = [
        {"w": torch.zeros(2)},
        {"v": torch.zeros(2)},
        {"w": torch.zeros(2, dtype=torch.int32)},
        {"w": torch.zeros(1, 2)},
        {"w": -torch.zeros(2)},
        {"w": [torch.zeros(2)]},
        {"w": torch.zeros(2), "n": 1},
        {"w": torch.zeros(2), "n": 1.0},
        {"w": torch.zeros(2), "n": []},
    ]

    assert len({sum_of_state(state) for state in states}) == len(states)
    assert sum_of_state({"a": 1, "b": torch.ones(3)[::2]}) == sum_of_state({"b": torch.ones(2), "a": 1})


def other_setting(run: Path) -> None:
    edit(run, lambda about: about["config"]["agent"].update(gamma=0.5))


def other_curriculum(run: Path) -> None:
    edit(run, lambda about: about.update(fingerprint="0123456789abcdef"))


def other_seed(run: Path, seed: int = 7) -> None:
    edit(run, lambda about: about["config"].update(seed=seed))


def other_code(run: Path) -> None:
    edit(run, lambda about: about.update(sources={"my_agent": "0123456789abcdef"}))


def other_numbers(run: Path) -> None:
    for each in run.parent.iterdir():
        edit(each, lambda about: about.update(numbers=0))


def other_version(run: Path) -> None:
    edit(run, lambda about: about["versions"].update(torch="1.0"))


def unknown_code(run: Path) -> None:
    for each in run.parent.iterdir():
        edit(each, lambda about: about.update(sources=None))


def unfinished(run: Path) -> None:
    (run / "metrics.json").unlink()


def failed(run: Path) -> None:
    unfinished(run)
    (run / "failed.txt").write_text("FloatingPointError: the loss is nan\n")


def damage(run: Path) -> None:
    (run / "curriculum.json").write_text("{}")


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (other_setting, "runs are of several configurations, agent.gamma=0.99 and 0.5: submit those of one"),
        (other_curriculum, r"runs are of several curricula, su_b1_4tasks \(modified\) \(fingerprint"),
        (other_seed, "seeds 1 are missing: track tiny-v1 has seeds 0, 1; seeds 7 are of no submission"),
        (
            lambda run: other_seed(run, 100),
            "seeds 1 are missing: .*; seeds 100 are for tuning: track tiny-v1",
        ),
        (other_code, "runs are of different code, my_agent differs between them: run all with one"),
        (
            other_numbers,
            rf"has changed since the runs, ctgraph_rl \(numbers version 0 before, {NUMBERS} now\): run again",
        ),
        (other_version, r"runs are of different versions, torch .* and 1.0: run all with one"),
        (unknown_code, "do not say of which source they are: run again from files, and with Recorder"),
        (
            unfinished,
            r"seed1 has no results \(unfinished: 256 of 256 frames\): finish it, or account for it: failed: {1: why}",
        ),
        (failed, r"tiny-seed1 has no results \(failed: FloatingPointError: the loss is nan\): finish it"),
        (damage, "tiny-seed1 has files that are not as they were written, curriculum.json: run it again"),
        (shutil.rmtree, "seeds 1 are missing: track tiny-v1 has seeds 0, 1"),
    ],
)
def test_runs_that_are_no_submission_are_refused_and_nothing_is_written(runs, tiny_track, method, broken, message):
    broken(runs / "tiny-seed1")

    with pytest.raises(ValueError, match=message):
        submit([runs], runs.parent / "made", method, tiny_track)

    assert [path.name for path in runs.parent.iterdir()] == ["runs"]


def test_a_modified_curriculum_is_refused_without_and_with_a_track(runs, tiny_track, method):
    other = replace(tiny_track, rungs=(("curriculum.num_frames=128",),), config_dir=tiny_track.config_dir)

    with pytest.raises(ValueError, match=r"su_b1_4tasks \(fingerprint .*\) is not the published one, it was modified"):
        submit([runs], runs.parent / "made", method)
    with pytest.raises(ValueError, match=r"has fingerprint .*, track tiny-v1 has .*: run ctgraph-rl -m track=tiny"):
        submit([runs], runs.parent / "made", method, other)


def test_only_chooses_runs_by_a_setting(runs, tiny_track, method):
    other = shutil.copytree(runs / "tiny-seed1", runs / "other")
    other_setting(other)

    made = submit([runs], runs.parent / "made", method, tiny_track, {"agent.gamma": 0.99})

    assert [run.run for run in made.runs] == ["seed0", "seed1"]
    with pytest.raises(ValueError, match=r"no run is left by --only; there are agent.gamma=0.5, 0.99"):
        submit([runs], runs.parent / "more", method, tiny_track, {"agent.gamma": 0.7})


def test_all_broken_rules_are_in_one_error(runs, tiny_track, method):
    failed(runs / "tiny-seed0")
    other_setting(runs / "tiny-seed1")
    other_seed(runs / "tiny-seed1")
    tuned = {**method, "tuning": {"how": "by hand", "seeds": [0]}}

    parts = ("several configurations.*", "has no results.*", "seeds 0 are among tuning.seeds.*", "seeds 1 are missing")
    with pytest.raises(ValueError, match="".join(parts)):
        submit([runs], runs.parent / "made", tuned, tiny_track)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (
            {"given": {"boundaries": "hidden", "task_id": None, "guide_frames": None}},
            "given.boundaries is 'hidden', the",
        ),
        ({"compute": {"hardware": None, "hours": 5, "tuning_hours": None}}, "compute.hours is 5, the logs of the runs"),
        (
            {"bytes_per_task": 10**9},
            r"3,000,000,000 bytes for 3 further tasks, the agents of the runs have [\d,]+",
        ),
        ({"failed": {0: "why"}}, "failed has seed 0, but .*tiny-seed0 is finished: remove the seed from failed"),
        ({"failed": {5: "why"}}, "failed has seeds 5, of which there is no run"),
    ],
)
def test_a_method_that_contradicts_its_runs_is_refused(tiny_home, tiny_track, method, tmp_path, part, message):
    with pytest.raises(ValueError, match=message):
        submit([tiny_home / "runs"], tmp_path / "made", {**method, **part}, tiny_track)


@pytest.mark.parametrize(
    ("method", "settings", "reads"),
    [
        ("detector", {}, "Oracle is an oracle, which reads the true tasks: it is a reference for others, submit runs"),
        ("mask_sc", {"selection": "parent"}, "method=MaskSC is an oracle, which reads the tasks' goals and images"),
        ("mask_amsc", {"competence": "evaluation"}, "is an oracle, which reads evaluations of the task that ends"),
        ("mask_sc", {"selection": "similarity"}, None),
        ("packnet", {}, None),
        ("finetune", {}, None),
    ],
)
def test_a_learner_that_reads_what_only_an_oracle_knows_is_refused(compose, method, settings, reads):
    names = ("detector=oracle",) if method == "detector" else (f"method={method}",)
    holds, message = oracle_rule(plain(compose(*names, *(f"method.{key}={value}" for key, value in settings.items()))))

    assert holds == (reads is None)
    assert reads is None or reads in message


@pytest.mark.parametrize("part", ["method", "detector"])
@pytest.mark.parametrize(
    "name", ["detectors.Oracle", "detectors.seen.Oracle", "methods.self_labelled.Oracle", "none.N"]
)
def test_a_class_of_ours_by_another_name_than_that_of_its_module_is_refused(part, name):
    holds, message = oracle_rule({part: {"_target_": f"baselines.{name}"}})

    assert (holds, f"{part}=baselines.{name} is no method or detector of baselines" in message) == (False, True)


def test_a_failed_run_that_is_accounted_for_is_a_line_with_its_reason(runs, tiny_track, method):
    failed(runs / "tiny-seed1")

    made = submit([runs], runs.parent / "made", {**method, "failed": {1: "the loss was nan"}}, tiny_track)

    assert [(run.reason, run.agent_sha256 is None) for run in made.runs] == [(None, False), ("the loss was nan", True)]
    assert made.method["failed"] == {1: "the loss was nan"} and [run.run for run in made.finished] == ["seed0"]


def test_what_fails_while_it_is_written_leaves_nothing_and_what_is_there_is_never_replaced(
    runs, tiny_track, method, monkeypatch
):
    made = runs.parent / "made"
    made.mkdir()
    with pytest.raises(FileExistsError, match="made exists: choose another folder, nothing is overwritten"):
        submit([runs], made, method, tiny_track)
    made.rmdir()
    with locked_new(made), pytest.raises(BlockingIOError, match=f"made is in use by process {os.getpid()} on"):
        submit([runs], made, method, tiny_track)

    def full(*parts: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "submission_text", full)
    with pytest.raises(OSError, match="No space left"):
        submit([runs], made, method, tiny_track)
    assert [path.name for path in runs.parent.iterdir()] == ["runs"]


def learn(curriculum, seed, run_dir):
    """The entry point of a learner that is not of this package; it learns nothing."""
    about = {"learner": "a table"}
    with Recorder(curriculum, run_dir, seed, about, code=[Table]) as recorder:
        for frames in recorder.moments:
            recorder.evaluate(Table(), frames)


class Table:
    """Decides at once, which fails at every wait state."""

    def predict(self, observation, state, start, deterministic):
        return np.ones(len(observation), dtype=np.int64), state


def test_a_learner_of_others_is_submitted_with_the_entry_point_that_runs_it_again(tiny_track, method, tmp_path):
    for seed in tiny_track.seeds:
        learn(tiny_track.curriculum, seed, tmp_path / "runs" / str(seed))

    with pytest.raises(ValueError, match=r"no agent can be built .* set entry_point: module:function in"):
        submit([tmp_path / "runs"], tmp_path / "made", method, tiny_track)
    made = submit([tmp_path / "runs"], tmp_path / "made", {**method, "entry_point": "test_submit:learn"}, tiny_track)

    assert [(run.run, run.agent_sha256, run.agent_bytes) for run in made.runs] == [
        ("seed0", None, None),
        ("seed1", None, None),
    ]
    assert made.config == {"learner": "a table"}
    learn(made.curriculum, 1, tmp_path / "again")
    assert log_sum(RunLog.read(tmp_path / "again" / "run.jsonl")) == made.runs[1].log_sha256


def test_the_command_prints_a_template_that_reads_once_it_is_filled_in(tiny_home, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl submit", "--template"])
    module.main()
    template = capsys.readouterr().out
    (tmp_path / "method.yaml").write_text(template)
    with pytest.raises(ValueError, match=r"name must be a text, got None; .*authors must .*; code.repository must"):
        read_method(tmp_path / "method.yaml")

    lines = {"name: null": "name: Tiny", "authors: []": "authors: [A]", "licence: null": "licence: MIT"}
    lines |= {
        "repository: null": "repository: https://a.org/b",
        "commit: null": "commit: '0123456'",
        "how: null": "how: -",
    }
    for before, after in lines.items():
        template = template.replace(before, after.replace("how: -", "how: not tuned"))
    (tmp_path / "method.yaml").write_text(template)
    words = [str(tiny_home / "runs"), "--to", str(tmp_path / "made"), "--method", str(tmp_path / "method.yaml")]
    more = ["--track", "tiny", "--config-dir", str(tiny_home / "conf")]
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl submit", *words, *more])
    module.main()

    said = capsys.readouterr().out.splitlines()
    assert said[:2] == ["submission of Tiny for track tiny-v1, on su_b1_4tasks", "runs: 2"]
    assert said[2] == f"digest: {read_submission(tmp_path / 'made', config_dir=tiny_home / 'conf').digest}"


def test_a_run_with_experts_is_submitted_without_their_logs(
    tiny_home, tiny_track, tiny_settings, method, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    one = replace(tiny_track, seeds=(0,))
    words = ("--config-dir", str(tiny_home / "conf"), "track=tiny", "experts=true", "seed=0", "hydra.run.dir=runs/one")
    assert command_line(monkeypatch, *words, *tiny_settings) == 0

    made = replace(submit([Path("runs")], Path("made"), method, one), track=one)

    (run,) = made.runs
    stored = json.loads(Path("runs/one/metrics.json").read_text())
    assert scores_of(made, run)["average_performance"] == stored["average_performance"]["value"]
    assert [path.name for path in Path("made/logs").iterdir()] == ["seed0.jsonl.gz"]
    assert [check.text for check in rescore(made) if not check.passed] == []
    log = made.log(run)
    assert len(log.of_kind("experts")[0]["experts"]) == 4
    log.measurements = [line for line in log.measurements if line["kind"] != "experts"]
    assert log_sum(log) == run.log_sha256


def test_what_a_method_keeps_is_compared_with_the_largest_agent_of_its_runs():
    method = {"given": {}, "compute": {"hours": None}, "bytes_per_task": 100}
    runs = [SimpleNamespace(agent_bytes=number) for number in (299, None, 300, 1)]

    rules = fact_rules(method, {"given": {}, "compute": {"hours": 0.0}}, runs, num_tasks=4)

    assert rules[-1][0]
    assert not fact_rules(method, {"given": {}, "compute": {"hours": 0.0}}, runs[:2], num_tasks=4)[-1][0]
