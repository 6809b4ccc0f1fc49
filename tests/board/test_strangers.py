"""Folders of strangers: each broken one is one line for its owner, and never an end for others."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from ctgraph_rl.board.rescore import rescore
from ctgraph_rl.board.standings.entries import read_entries
from ctgraph_rl.board.submission import read_submission
from ctgraph_rl.log.sums import SUMS
from ctgraph_rl.runs.read import find_runs

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(['*' + before] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


def sparse(folder: Path) -> None:
    with (folder / "more").open("wb") as file:
        file.truncate(10 * 2**30)


def nested(folder: Path) -> None:
    """Make folders within each other, more than Python's own functions can walk."""
    where = os.open(folder, os.O_RDONLY)
    for _ in range(1100):
        os.mkdir("x", dir_fd=where)
        inner = os.open("x", os.O_RDONLY, dir_fd=where)
        os.close(where)
        where = inner
    os.close(where)


def second_line(folder: Path) -> None:
    """State a better score before the true one."""
    path = folder / "metrics.csv"
    lines = path.read_text().splitlines(keepends=True)
    true = next(line for line in lines if ",average_performance," in line)
    cells = true.split(",")
    path.write_text("".join([lines[0], ",".join([*cells[:3], "0.99", *cells[4:]]), *lines[1:]]))


def second_line_that_spreadsheets_read(folder: Path) -> None:
    """State a better score of a run whose name has the mark by which spreadsheets read a text."""
    path = folder / "metrics.csv"
    lines = path.read_text().splitlines(keepends=True)
    true = next(line for line in lines if ",average_performance," in line)
    path.write_text("".join([lines[0], "'" + true, *lines[1:]]))


def further_member(folder: Path) -> None:
    path = next((folder / "logs").iterdir())
    path.write_bytes(path.read_bytes() + gzip.compress(b'{"kind": "more"}\n'))


def odd_name(folder: Path) -> None:
    Path(os.fsdecode(os.fsencode(folder) + b"/\xff")).write_text("")


def logged(folder: Path, kind: str = "experts", **fields: object) -> None:
    """Add a line to a log."""
    path = next((folder / "logs").iterdir())
    line = json.dumps({"kind": kind, **fields}).encode() + b"\n"
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()) + line))


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "alias bomb": (lambda folder: (folder / "config.yaml").write_text(BOMB), "anchors (&name) are not read"),
    "base 60": (
        lambda folder: (folder / "method.yaml").write_text("name: " + ":".join(["59"] * 20_000)),
        "is a number to some programs, a text to others",
    ),
    "long file": (lambda folder: (folder / "method.yaml").write_text("a: " + "1:" * 200_000), "the limit is 65,536"),
    "sparse file": (sparse, "has files of more than 1,073,741,824 bytes, more: remove them"),
    "nested folders": (nested, "has folders within more than 32 others"),
    "second line": (second_line, "are both of tiny-seed0, average_performance: leave one out"),
    "second line behind a mark": (
        second_line_that_spreadsheets_read,
        "are both of tiny-seed0, average_performance: leave one out",
    ),
    "lines that other programs do not see": (
        lambda folder: (folder / "versions.txt").write_text(
            (folder / "versions.txt").read_text().replace("\n", "\x0b")
        ),
        "must have a line # machine==KIND",
    ),
    "further member": (further_member, "has more after its end"),
    "name that is not UTF-8": (odd_name, r"has names that are not UTF-8"),
    "digits that are not ASCII": (
        lambda folder: (folder / "runs.csv").write_text(
            (folder / "runs.csv").read_text().replace("tiny-seed1,1,", "tiny-seed1,\u0661,", 1)
        ),
        "seed must be an integer >= 0",
    ),
    "experts: 5": (lambda folder: logged(folder, experts=5), "experts must be a list of objects with a task"),
    "together: 5": (lambda folder: logged(folder, together=5), "together must be a list of seeds"),
    "versions: 5": (lambda folder: logged(folder, versions=5), "versions must be an object of texts"),
    "long label": (
        lambda folder: logged(
            folder, "evaluation", block=0, frames=0, task=1, return_mean=0.0, moment="before", label="x" * 2**17
        ),
        "logs a text in label has 131,072 bytes, the limit is 65,536",
    ),
    "versions twice": (
        lambda folder: (folder / "versions.txt").write_text((folder / "versions.txt").read_text() + "torch==1\n"),
        "versions.txt has a name twice",
    ),
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
        broken = read_submission(copy, tiny_submission.track)
        rescore(broken)
        assert broken.digest

    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "name",
    [
        "second line",
        "nested folders",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("alias bomb", "name that is not UTF-8")),
    ],
)
def test_a_broken_submission_is_no_end_for_others(tiny_submission, tiny_home, copy, name):
    shutil.copytree(tiny_submission.path, copy.parent / "whole")
    BROKEN[name][0](copy)

    entries, problems = read_entries([copy.parent], tiny_home / "conf")

    assert [entry.folder for entry in entries] == [copy.parent / "whole"]
    assert {"broken" in str(problem.path) for problem in problems} == {True}
    assert all("\n" not in problem.reason for problem in problems)


def test_a_table_that_unpacks_to_much_is_a_difference(submission):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    path = submission.path / "evaluations.parquet"
    rows = parquet.read_table(path)
    many = pyarrow.table({name: rows.column(name).take([0] * 30_000) for name in rows.column_names})
    parquet.write_table(many, path)

    (check,) = [each for each in rescore(submission) if each.what == "evaluations.parquet"]

    assert (check.passed, check.note[:11]) == (False, "it has 30,0")


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
    (tmp_path / "runs" / "tiny-seed0" / SUMS).unlink()

    runs, problems = find_runs([tmp_path / "runs"])

    reasons = [run.reason for run in runs if run.reason is not None] + [problem.reason for problem in problems]
    assert len(reasons) == 1
    assert message in reasons[0]
    assert [run.seed for run in runs if run.reason is None] == [1]


def test_folders_within_too_many_others_are_no_end_for_runs_beside_them(tiny_home, tmp_path):
    shutil.copytree(tiny_home / "runs", tmp_path / "runs")
    nested(tmp_path / "runs" / "tiny-seed0")
    try:
        runs, problems = find_runs([tmp_path / "runs"])
    finally:
        subprocess.run(["rm", "-rf", str(tmp_path / "runs")], check=True)

    assert [run.seed for run in runs] == [0, 1]
    assert ["is more than 32 folders deep" in problem.reason for problem in problems] == [True]
