"""Folders of strangers: each broken one is one line for its owner, and never an end for others."""

from __future__ import annotations

import gzip
import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.submissions import edit_run, make_nested

from ctgraph_rl.board.rescore import rescore
from ctgraph_rl.board.standings.entries import read_entries
from ctgraph_rl.board.submission import read_submission
from ctgraph_rl.runs.read import find_runs


def sparse(folder: Path) -> None:
    with (folder / "submission.json").open("wb") as file:
        file.truncate(10 * 2**30)


def logged(folder: Path, kind: str = "experts", **fields: object) -> None:
    """Add a line to a log."""
    path = next((folder / "logs").iterdir())
    line = json.dumps({"kind": kind, **fields}).encode() + b"\n"
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()) + line))


def replaced(folder: Path, before: str, after: str) -> None:
    path = folder / "submission.json"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "key twice": (
        lambda folder: replaced(folder, '"schema": 2', '"schema": 2, "schema": 2'),
        "key 'schema' occurs twice in one object",
    ),
    "no number of JSON": (lambda folder: replaced(folder, '"schema": 2', '"schema": NaN'), "NaN is no number of JSON"),
    "long number": (
        lambda folder: replaced(folder, '"schema": 2', '"schema": ' + "1" * 400),
        "an integer has 400 digits, the limit is 40",
    ),
    "nested": (
        lambda folder: (folder / "submission.json").write_text("[" * 10**5),
        "submission.json nested more than 32 deep",
    ),
    "sparse file": (sparse, "has 10,737,418,240 bytes, the limit is 16,777,216"),
    "digits that are not ASCII": (
        lambda folder: edit_run(folder, seed="\u0661"),
        "must be an integer >= 0",
    ),
    "experts: 5": (lambda folder: logged(folder, experts=5), "experts must be a list of objects with a task"),
    "together: 5": (lambda folder: logged(folder, together=5), "together must be a list of seeds"),
    "versions: 5": (lambda folder: logged(folder, versions=5), "versions must be an object of texts"),
}


@pytest.fixture
def copy(tiny_submission, tmp_path):
    """A copy of a submission that a test may break; Python cannot remove what some do to it."""
    folder = shutil.copytree(tiny_submission.path, tmp_path / "board" / "broken")
    yield folder
    subprocess.run(["rm", "-rf", str(folder)], check=True)


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_submission_is_refused_in_one_line(tiny_submission, copy, name):
    breaks, message = BROKEN[name]
    breaks(copy)

    with pytest.raises(ValueError) as refused:
        broken = read_submission(copy, tiny_submission.track.config_dir)
        rescore(broken)
        assert broken.digest

    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "name",
    ["key twice", "nested", "sparse file"],
)
def test_a_broken_submission_is_no_end_for_others(tiny_submission, tiny_home, copy, name):
    shutil.copytree(tiny_submission.path, copy.parent / "whole")
    BROKEN[name][0](copy)

    entries, problems = read_entries([copy.parent], tiny_home / "conf")

    assert [entry.folder for entry in entries] == [copy.parent / "whole"]
    assert {"broken" in str(problem.path) for problem in problems} == {True}
    assert all("\n" not in problem.reason for problem in problems)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("metrics.json", b"[]", "does not hold metrics of ours"),
        ("metrics.json", b"[" * 10**5, "nested more than 32 deep"),
        ("metrics.json", b'{"a": {"value": 1' + b"0" * 400 + b"}}", "an integer has 401 digits"),
        ("metrics.json", b'{"a": {"value": "x", "definition": [], "undefined": {}}}', "does not hold metrics of ours"),
        ("run.jsonl", b'{"kind": "training", "block": 1, "frames": 64, "return_mean": 1e308}\n', "return_mean must be"),
        ("run.jsonl", b'{"kind": "experts", "experts": 5}\n', "experts must be a list"),
    ],
)
def test_a_broken_run_is_one_line_and_no_end_for_others(tiny_home, tmp_path, file, content, message):
    shutil.copytree(tiny_home / "runs", tmp_path / "runs")
    path = tmp_path / "runs" / "tiny-seed0" / file
    path.write_bytes(path.read_bytes() + content if file == "run.jsonl" else content)

    runs, problems = find_runs([tmp_path / "runs"])

    reasons = [run.reason for run in runs if run.reason is not None] + [problem.reason for problem in problems]
    assert len(reasons) == 1
    assert message in reasons[0]
    assert [run.seed for run in runs if run.reason is None] == [1]


def test_folders_within_too_many_others_are_no_end_for_runs_beside_them(tiny_home, tmp_path):
    shutil.copytree(tiny_home / "runs", tmp_path / "runs")
    make_nested(tmp_path / "runs" / "tiny-seed0")
    try:
        runs, problems = find_runs([tmp_path / "runs"])
    finally:
        subprocess.run(["rm", "-rf", str(tmp_path / "runs")], check=True)

    assert [run.seed for run in runs] == [0, 1]
    assert ["is more than 32 folders deep" in problem.reason for problem in problems] == [True]
