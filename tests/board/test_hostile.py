"""Submissions that were made to do harm: `rescored` runs nothing of them, writes nothing for them, and refuses them."""

from __future__ import annotations

import copy
import gzip
import json
import os
import pickle
import shutil
from pathlib import Path
from typing import Any

import pytest
from helpers.submissions import edit, edit_run

import curricula
from ctgraph_rl import Curriculum
from ctgraph_rl.board import relearn
from ctgraph_rl.board.isolate import Outcome
from ctgraph_rl.board.method_yaml import TEMPLATE, read_method
from ctgraph_rl.board.rerun import cells_of, result_of
from ctgraph_rl.board.rescore import oracle_rule, rescore
from ctgraph_rl.board.submission import Submission, log_name, log_sum, packed, read_log, read_submission


def checked(given: Submission) -> None:
    """Do what a verifier does who runs no code."""
    read = read_submission(given.path, given.track.config_dir)
    wrong = [check.text for check in rescore(read) if not check.passed]
    if wrong:
        raise ValueError("; ".join(wrong))


def replace_log(given: Submission, lines: bytes, number: int = 0) -> None:
    """Replace a log, with the sum that it then has."""
    path = given.path / log_name(given.runs[number].run)
    path.write_bytes(packed(lines))
    edit_run(given.path, number, log_sha256=log_sum(read_log(path)))


def lines_of(given: Submission) -> bytes:
    return gzip.decompress((given.path / log_name(given.runs[0].run)).read_bytes())


@pytest.mark.parametrize(
    "name", ["..", ".", "/etc/passwd", "logs/../../x", "a\\b", "x\n", "x\0", "a" * 200, "é", "", "-"]
)
def test_a_run_names_no_file_elsewhere(submission, name):
    edit_run(submission.path, 1, run=name)

    with pytest.raises(ValueError, match="must be a name of a file"):
        checked(submission)


@pytest.mark.parametrize("file", ["submission.json", "logs/seed1.jsonl.gz"])
@pytest.mark.parametrize("what", ["pipe", "device", "folder", "loop"])
def test_what_is_no_file_is_refused_and_nothing_waits_for_it(submission, file, what):
    path = submission.path / file
    path.unlink()
    if what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero" if what == "device" else path)

    with pytest.raises((ValueError, OSError)) as refused:
        checked(submission)

    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe{\x00}\x00", "can't decode"),
        (b"\xef\xbb\xbf{}", "BOM"),
        (b"{} {}", "Extra data"),
        (b'{"a":' * 10**5, "nested more than 32 deep|Expecting"),
        (b"[" + b"{}," * 10**4 + b"{}]", "must be an object of schema"),
        (b'{"schema": Infinity}', "Infinity is no number of JSON"),
        (b'{"schema": 1e999}', "beyond what a float64 holds"),
    ],
)
def test_what_is_no_json_of_one_meaning_is_refused(submission, content, message):
    (submission.path / "submission.json").write_bytes(content)

    with pytest.raises(ValueError, match=message):
        checked(submission)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ({"kind": "evaluation", "block": 1, "frames": 64, "task": 1, "return_mean": "0.5"}, "return_mean must be"),
        ({"kind": "evaluation", "block": 10**6, "frames": 64, "task": 1, "return_mean": 0.5}, "beyond what a file"),
        ({"kind": "evaluation", "block": -1, "frames": 64, "task": 1, "return_mean": 0.5}, "block must be"),
        ({"kind": "training", "block": 1, "frames": float("inf")}, "frames must be"),
        ({"kind": "training", "block": 1, "frames": float("nan")}, "frames must be"),
        ({"kind": ["run"]}, "kind must be a text"),
        ({"kind": "experts", "experts": [{"task": "../../x"}]}, "experts must be"),
    ],
)
def test_a_log_with_an_odd_line_is_refused(submission, line, message):
    content = lines_of(submission) + json.dumps(line).encode() + b"\n"
    path = submission.path / log_name(submission.runs[0].run)
    path.write_bytes(packed(content))

    with pytest.raises(ValueError, match=message):
        checked(submission)


def test_no_log_of_an_expert_is_opened(submission):
    said = {"kind": "experts", "experts": [{"task": task, "run": "../../x"} for task in (1, 1, 2)]}
    first, rest = lines_of(submission).split(b"\n", 1)
    replace_log(submission, b"\n".join([first, json.dumps(said).encode(), rest]))
    name = submission.runs[0].run
    for task in (1, 2):
        os.mkfifo(submission.path / "logs" / f"{name}.expert_{task}.jsonl.gz")

    checked(submission)


class Evil:
    """Makes a file when it is unpickled."""

    def __init__(self, made: Path) -> None:
        self.made = made

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.made),)


def test_a_pickle_is_never_loaded(submission, tmp_path):
    made = tmp_path / "made"
    for name in ("agent.pt", "verification.json.part", "logs/agent.pt", "sitecustomize.py"):
        (submission.path / name).write_bytes(pickle.dumps(Evil(made)))
    checked(submission)
    (cell,) = cells_of(submission, submission.runs[:1], tmp_path / "reruns")
    run_dir = relearn.run_dir_of(cell.folder, 0)
    run_dir.mkdir(parents=True)
    shutil.copy(submission.path / "agent.pt", run_dir)
    (run_dir / "run.jsonl").write_bytes(lines_of(submission))
    (run_dir / "metrics.json").write_text("{}")

    result = result_of(cell, 0, Outcome(0, None, ""))

    assert result.failure
    assert not made.exists()


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.mkdir [{made}]",
        "name: !!python/object/apply:os.mkdir [{made}]",
        "!!python/module:os",
        "_target_: os.mkdir\npath: {made}",
        "name: &a [x]\nauthors: *a",
        "name: " + "[" * 200,
        "? [1, 2]\n: 3",
    ],
)
def test_a_method_file_runs_nothing(tmp_path, text):
    made = tmp_path / "made"
    for before in ("", TEMPLATE):
        (tmp_path / "method.yaml").write_text(before + text.replace("{made}", str(made)))
        with pytest.raises(ValueError, match=r"method\.yaml"):
            read_method(tmp_path / "method.yaml")

    assert not made.exists()


def test_settings_and_entry_points_are_not_built_or_imported(submission, tmp_path):
    made = tmp_path / "made"
    target = {"_target_": "os.mkdir", "path": str(made)}
    (tmp_path / "evil_learner.py").write_text(f"import os; os.mkdir({str(made)!r})")

    def change(given):
        given["config"] |= {"agent": target, "method": target, "detector": target, "cell": target}
        given["method"]["entry_point"] = "evil_learner:train"

    edit(submission.path, change)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        with pytest.raises(ValueError, match="config"):
            checked(submission)

    assert not made.exists()


@pytest.mark.parametrize(
    "wrapper",
    [
        ["torch:save", [["f", "MADE"]]],
        ["os:mkdir", []],
        ["gymnasium.wrappers:RecordVideo", [["video_folder", "MADE"]]],
        "gymnasium:make",
        "gymnasium.wrappers:NoSuchWrapper",
    ],
)
def test_a_curriculum_calls_nothing_that_a_file_names(submission, tmp_path, wrapper):
    made = tmp_path / "made"
    content = json.loads(json.dumps(curricula.load("frozen_lake_4maps").to_json()).replace("MADE", str(made)))
    content["tasks"][0]["wrappers"] = [json.loads(json.dumps(wrapper).replace("MADE", str(made)))]

    with pytest.raises(ValueError, match=r"a file may name only classes of gymnasium\.Wrapper|cannot be found"):
        Curriculum.from_json(content)
    edit(submission.path, lambda given: given.update(curriculum=content))
    with pytest.raises(ValueError, match="has tasks that are no CT-graphs, and is not of track tiny-v1"):
        checked(submission)

    assert not made.exists()


def test_an_environment_with_a_strangers_arguments_is_not_made(submission, monkeypatch):
    published = curricula.load("frozen_lake_4maps")
    content = published.to_json()
    edit(submission.path, lambda given: given["method"].update(track=None))
    edit(submission.path, lambda given: given.update(curriculum=content))
    read = read_submission(submission.path)
    content = copy.deepcopy(content)
    content["tasks"][0]["kwargs"] = [["desc", ["S" * 10**5] * 10]]
    content["fingerprint"] = "0" * 16
    edit(submission.path, lambda given: given.update(curriculum=content))

    assert read.curriculum == published
    with pytest.raises(ValueError, match="is not published: its environments are not made"):
        read_submission(submission.path)


def test_settings_of_a_detector_take_no_memory():
    """Rust ends the whole process where it is asked for more than there is."""
    name = "baselines.detectors.adwin.ADWIN"

    assert oracle_rule({"detector": {"_target_": name, "clock": 10**12, "max_buckets": 10**12}})[0]
    assert not oracle_rule({"detector": {"_target_": "baselines.detectors.oracle.Oracle", "x": 1}})[0]


VALUES = [None, True, -1, 1.5, "x", [], {}, [[]], {"a": 1}, 10**30, "../x", {"_target_": "os.system"}]


def places_in(value: Any, place: tuple = ()) -> list[tuple]:
    """Return the place of every value within another one; of lists, of the first."""
    found = [place] if place else []
    if isinstance(value, dict):
        for key, each in value.items():
            found += places_in(each, (*place, key))
    elif isinstance(value, list) and value:
        found += places_in(value[0], (*place, 0))
    return found


@pytest.mark.slow
def test_every_value_that_is_replaced_is_refused_in_one_line_or_changes_nothing(submission):
    file = submission.path / "submission.json"
    content = json.loads(file.read_text())
    for number, place in enumerate(places_in(content)):
        for value in VALUES[number % 3 :: 3]:
            changed = copy.deepcopy(content)
            inner = changed
            for key in place[:-1]:
                inner = inner[key]
            inner[place[-1]] = value
            file.write_text(json.dumps(changed))
            try:
                checked(submission)
            except (ValueError, OSError) as error:
                assert "\n" not in str(error), (place, value)
