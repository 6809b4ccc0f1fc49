"""The table of docs/how-to/resume.md: every fault has its tests, and messages are the real ones; files of strangers."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.paths import TESTS
from helpers.scripted import ONE
from helpers.stopped_runs import with_header

from ctgraph_rl import Block, CTGraph, CTGraphEnv, Curriculum, Evaluation, Observations, OneHot, RunLog
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.log.files import locked
from ctgraph_rl.run import run
from ctgraph_rl.runs.checkpoints import decoded
from ctgraph_rl.runs.config import run_name
from ctgraph_rl.runs.read import find_runs
from curricula.paper import ct_su_b1

ROWS = re.findall(r"^\| (F\d+) \| (.*) \| (.*) \|$", (TESTS.parent / "docs" / "how-to" / "resume.md").read_text(), re.M)


OF_FAULT = json.loads((TESTS / "data" / "fault_tests.json").read_text(encoding="utf-8"))
"""The tests of each fault."""


def test_the_table_has_every_fault_of_the_catalogue():
    assert [row[0] for row in ROWS] == [f"F{number}" for number in range(1, 31)]


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_every_fault_has_tests_that_exist(row):
    for name in OF_FAULT[row[0]]:
        file, _, test = name.partition("::")
        (path,) = TESTS.rglob(f"{file}.py")
        tree = ast.parse(path.read_text(encoding="utf-8"))

        assert test in [node.name for node in tree.body if isinstance(node, ast.FunctionDef)], name


def act(*actions: int) -> None:
    env = CTGraphEnv([ct_su_b1()])
    data = env.reset()
    for action in actions:
        data = env.step(data.set("action", torch.tensor([action])))["next"]


def in_use(folder: Path) -> None:
    with locked(folder), locked(folder):
        pass


def of_another_format(folder: Path) -> None:
    (folder / "1.pt").write_bytes(with_header(b"", format=2))
    decoded(folder / "1.pt")


def torn(folder: Path) -> None:
    (folder / "1.pt").write_bytes(with_header(b"", bytes=7))
    decoded(folder / "1.pt")


def unreadable(folder: Path) -> None:
    (folder / "1.pt").write_bytes(with_header(b"no pickle"))
    decoded(folder / "1.pt")


MESSAGES: dict[str, Callable[[Path], object]] = {
    "F6": torn,
    "F8": in_use,
    "F12": lambda _: CTGraph(1, 0, 1.0),
    "F13": lambda _: replace(ct_su_b1(), goal=(1, 3)),
    "F14": lambda _: Observations(decision_ids=(2, 2), wait_ids=(2, 3), end_ids=(4, 4)),
    "F15": lambda _: CTGraph(10, 30),
    "F16": lambda _: CTGraphEnv([replace(ONE, images=OneHot(10**9))]),
    "F17": lambda _: act(7),
    "F20": lambda _: checked_device("cuda"),
    "F22": unreadable,
    "F28": of_another_format,
}


@pytest.mark.parametrize("fault", MESSAGES)
def test_the_message_is_the_one_in_the_table(fault, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    (seen,) = [row[2] for row in ROWS if row[0] == fault]
    shown = re.findall("`(.*?)`", seen)[0]

    with pytest.raises((ValueError, OSError)) as error:
        MESSAGES[fault](tmp_path)

    assert re.fullmatch(re.escape(shown).replace(re.escape("..."), ".+") + ".*", str(error.value)), str(error.value)


def test_a_run_in_a_directory_that_is_in_use_changes_nothing(compose, tmp_path):
    with locked(tmp_path):
        before = (tmp_path / ".lock").read_text()

        with pytest.raises(BlockingIOError, match="is in use by process"):
            run(compose("overwrite=true"), tmp_path)

        assert (tmp_path / ".lock").read_text() == before
        assert [path.name for path in tmp_path.iterdir()] == [".lock"]


@pytest.mark.parametrize("seed", ["../../../etc/x", "a/b", "/etc", "..", "<b>"])
def test_names_of_others_do_not_become_paths(compose, seed):
    cfg = compose(f"seed='{seed}'", return_hydra_config=True)

    name = run_name(_root_=cfg)

    assert re.fullmatch(r"su_b1_4tasks/lstm_ppo-seed\w+-[0-9a-f]{12}", name)


LINE = {"kind": "evaluation", "moment": "after", "block": 1, "frames": 64, "task": 1, "label": "a", "return_mean": 0.5}
ABOUT = {"kind": "run", "schema": 1, "curriculum": "a", "fingerprint": "b", "config": {"seed": 0}, "trained": [[1]]}

HOSTILE = {
    "nested deeply": b'{"kind": "training", "a": ' + b"[" * 10**5 + b"]" * 10**5 + b"}",
    "nested": b'{"kind": "training", "block": 1, "frames": 1, "a": ' + b"[" * 100 + b"]" * 100 + b"}",
    "a block that no table has room for": {**LINE, "block": 10**12},
    "a task that no table has room for": {**LINE, "task": 10**12},
    "a table that no machine has room for": {**LINE, "block": 10**6, "task": 10**6},
    "a task below 1": {**LINE, "task": 0},
    "a return that is a text": {**LINE, "return_mean": "1"},
    "a return beyond float64": {**LINE, "return_mean": 10**400},
    "a return of infinity": {**LINE, "return_mean": float("inf")},
    "frames that are a list": {**LINE, "frames": []},
    "frames below 0": {**LINE, "frames": -1},
    "a label that is an object": {**LINE, "label": {}},
    "a success rate that is a text": {**LINE, "success_rate": "x"},
    "no task": {key: value for key, value in LINE.items() if key != "task"},
    "no return": {key: value for key, value in LINE.items() if key != "return_mean"},
    "a kind that is a list": {**LINE, "kind": []},
    "seconds that are a text": {**LINE, "seconds": "1"},
    "held out that is a text": {**LINE, "held_out": "no"},
    "training without a block": {"kind": "training", "frames": 1},
}


def written(run_dir: Path, *lines: dict | bytes) -> Path:
    """A finished run's directory with a log of these lines."""
    run_dir.mkdir()
    content = [line if isinstance(line, bytes) else json.dumps(line).encode() for line in lines]
    (run_dir / "run.jsonl").write_bytes(b"\n".join(content) + b"\n")
    (run_dir / "metrics.json").write_text('{"m": {"value": 1, "definition": "d", "undefined": null}}')
    return run_dir


@pytest.mark.parametrize("line", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_line_is_a_value_error_for_readers_and_a_reason_in_tables(tmp_path, line):
    run_dir = written(tmp_path / "run", ABOUT, line, LINE)

    with pytest.raises(ValueError, match=r"run\.jsonl: line 2|is no run's: restore the log"):
        RunLog.read(run_dir / "run.jsonl").performance()
    (found,), problems = find_runs([tmp_path])

    assert found.reason is not None and found.history is None
    assert problems == []


HOSTILE_FIRST = {
    "nested deeply": HOSTILE["nested deeply"],
    "a config that is a list": {**ABOUT, "config": [1]},
    "blocks that are no lists": {**ABOUT, "trained": [1]},
    "a block without tasks": {**ABOUT, "trained": [[]]},
    "a task that no table has room for": {**ABOUT, "trained": [[10**12]]},
    "names that are no texts": {**ABOUT, "tasks": [1]},
    "a schema that is a text": {**ABOUT, "schema": "1"},
    "a seed that is a text": {**ABOUT, "config": {"seed": "1"}},
}


@pytest.mark.parametrize("line", HOSTILE_FIRST.values(), ids=HOSTILE_FIRST)
def test_a_hostile_first_line_is_a_problem_that_names_the_file(tmp_path, line):
    written(tmp_path / "run", line, LINE)

    runs, (problem,) = find_runs([tmp_path])

    assert runs == [] and "run.jsonl" in problem.reason


METRICS = {
    "nested deeply": "[" * 10**5,
    "a number beyond float64": '{"m": {"value": 1' + "0" * 400 + ', "definition": "d", "undefined": null}}',
    "a number with too many digits": '{"m": {"value": ' + "1" * 10**4 + "}}",
    "a list": "[1]",
    "no value": '{"m": {}}',
}


@pytest.mark.parametrize("content", METRICS.values(), ids=METRICS)
def test_hostile_metrics_are_a_reason(tmp_path, content):
    run_dir = written(tmp_path / "run", ABOUT, LINE)
    assert find_runs([tmp_path])[0][0].reason is None
    (run_dir / "metrics.json").write_text(content)

    (found,), _ = find_runs([tmp_path])

    assert found.reason is not None and "metrics.json" in found.reason


def changed(curriculum: Curriculum, **evaluation) -> Curriculum:
    """A curriculum read from JSON that someone changed, with the right fingerprint."""
    content = curriculum.to_json()
    content["evaluation"].update(evaluation)
    own = replace(curriculum, evaluation=replace(curriculum.evaluation, **evaluation))
    return Curriculum.from_json({**content, "fingerprint": own.fingerprint})


def test_a_curriculum_that_asks_for_a_trillion_episodes_is_read_and_never_played():
    small = Curriculum("c", 1, "here", (Block(ONE, 64),), Evaluation(4))

    read = changed(small, num_episodes=10**12)

    with pytest.raises(ValueError, match="are 1,000,000,000,000 rows at once, the limit is 16,777,216"):
        read.evaluation.check(read.tasks)


def test_a_tree_of_depth_40_with_an_id_for_each_state_is_refused_before_its_images_are_made():
    content = Curriculum("c", 1, "here", (Block(ONE, 64),), Evaluation(4)).to_json()
    states, (task,) = 2**41, content["tasks"]
    task["graph"]["depth"], task["goal"], task["images"]["num_images"] = 40, [1] * 40, 4 * states
    task["observations"].update(
        unique_waits=True,
        unique_decisions=True,
        wait_ids=[2, 1 + states],
        decision_ids=[2 + states, 1 + 2 * states],
        end_ids=[2 + 2 * states, 1 + 3 * states],
    )

    with pytest.raises(ValueError, match=r"images need [\d,]{30,} bytes, the limit is 68,719,476,736; use fewer"):
        Curriculum.from_json(content)
