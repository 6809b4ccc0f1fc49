"""``ctgraph-rl board``: real submissions become a page and files for programs, and others are left out and named."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
from helpers.submissions import edit, edit_run

from ctgraph_rl import cli
from ctgraph_rl.board import verify
from ctgraph_rl.board.rescore import Check, rescore, scores_of
from ctgraph_rl.board.standings.board_page import write_board
from ctgraph_rl.board.standings.entries import make_entry, read_entries
from ctgraph_rl.board.submission import VERIFICATION, log_name, log_sum, packed, read_submission
from ctgraph_rl.board.verification import verification_of

for package in ("jinja2", "scipy"):
    pytest.importorskip(package)

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.fixture
def board(tiny_home, submission, tmp_path):
    """A board of one submission."""
    return write_board([submission.path], tmp_path / "board", tiny_home / "conf")


def test_an_entry_has_the_numbers_of_its_submission(submission):
    found = make_entry(submission)

    assert (found.name, found.level, found.why_not_ranked) == ("Tiny PPO", "submitted", None)
    assert found.scores == tuple(scores_of(submission, run)["average_performance"] for run in submission.runs)
    assert (found.frames, found.variant) == (256, submission.track.variants[0])
    assert found.agent_bytes == submission.runs[0].agent_bytes and found.hours == submission.method["compute"]["hours"]


def verified(submission, levels=verify.LEVELS, passed=True, **more):
    """What a verification says that has checked these levels; the last of them is the one that it states."""
    checks = [Check("what", "1", "1", passed, level=level)._asdict() for level in levels]
    level = levels[-1] if passed else "none"
    return {"schema": 1, "level": level, "digest": submission.digest, "bits": True, "checks": checks, **more}


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_level_is_that_of_the_verification_of_these_very_files(submission, count):
    file, levels = submission.path / VERIFICATION, verify.LEVELS[:count]

    file.write_text(json.dumps(verified(submission, levels)))
    assert verification_of(submission) == (levels[-1], True, "")
    file.write_text(json.dumps(verified(submission, levels, bits=False)))
    assert verification_of(submission) == (levels[-1], False, "")
    file.write_text(json.dumps(verified(submission, levels, passed=False)))
    assert verification_of(submission).level == "failed"
    file.write_text(json.dumps(verified(submission, levels, digest="0" * 64)))
    assert verification_of(submission) == (
        *("submitted", True),
        "verification.json is of other files; verify the submission again",
    )


def test_the_board_reads_what_a_verification_writes(submission):
    verify.write_verification(submission, [Check("what", "1", "1", True)])

    assert verification_of(submission) == ("rescored", True, "")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("[", "Expecting value: line 1 column 2"),
        ("[1]", "it must be an object, got [1]"),
        ("{}", "its schema must be 1, got None"),
        ({"schema": 2}, "its schema must be 1, got 2"),
        ({"level": ["x"]}, r"its level must be none, rescored, rerun, held_out, got ['x']"),
        ({"level": {}}, "its level must be none, rescored, rerun, held_out, got {}"),
        ({"level": "rerun"}, "its checks give the level held_out, not rerun"),
        ({"checks": []}, "its checks give the level none, not held_out"),
        ({"checks": [{"what": "all", "passed": 1, "level": "rescored"}]}, "its checks must be a list of checks"),
        ({"bits": "no"}, "its bits must be true or false, got 'no'"),
    ],
)
def test_what_is_no_verification_counts_for_nothing_and_the_board_says_why(tiny_home, submission, change, why):
    text = change if isinstance(change, str) else json.dumps(verified(submission) | change)
    (submission.path / VERIFICATION).write_text(text)

    (entry,), problems = read_entries([submission.path], tiny_home / "conf")

    assert (entry.level, problems) == ("submitted", [])
    assert entry.verification.why_none.startswith(f"verification.json counts for nothing, {why}")


def test_a_log_with_returns_that_the_metric_cannot_have_is_left_out_and_named(tiny_home, submission):
    run = submission.runs[1]
    log = submission.log(run)
    for line in log.of_kind("evaluation"):
        line["return_mean"] = 7.0
    content = "".join(json.dumps(line) + "\n" for line in log.measurements).encode()
    (submission.path / log_name(run.run)).write_bytes(packed(content))
    edit_run(submission.path, 1, log_sha256=log_sum(log))

    entries, (problem,) = read_entries([submission.path], tiny_home / "conf")

    assert not entries
    assert problem.reason == f"{submission.path}: the logs give average_performance 7.0, it must be in [0, 1]"


def test_a_log_that_was_exchanged_since_is_left_out_and_named(tiny_home, submission):
    first, second = (submission.path / log_name(run.run) for run in submission.runs)
    first.write_bytes(second.read_bytes())

    entries, (problem,) = read_entries([submission.path], tiny_home / "conf")

    assert not entries and "the log of seed0 is another one than the submission names" in problem.reason


def test_a_submission_to_an_earlier_version_of_a_track_is_in_a_table_of_its_own_and_fails_under_the_new_one(
    tiny_home, submission, tmp_path
):
    conf = shutil.copytree(tiny_home / "conf", tmp_path / "conf")
    assert submission.method["track_version"] == 1
    track = conf / "track" / "tiny.yaml"
    (before,) = read_entries([submission.path], conf)[0]

    track.write_text(track.read_text().replace("version: 1", "version: 2"))
    (after,) = read_entries([submission.path], conf)[0]
    wrong = [check.text for check in rescore(read_submission(submission.path, config_dir=conf)) if not check.passed]
    edit(submission.path, lambda given: given["method"].update(track_version=3))
    (problem,) = read_entries([submission.path], conf)[1]

    assert (before.track.id, after.track.id) == ("tiny-v1", "tiny-v1")
    assert wrong == ["version of the track: expected 1, found 2"]
    assert "the newest version of the track is tiny-v2; it was submitted to tiny-v3: use a package" in problem.reason


def test_all_files_are_written(board):
    folder = board.page.parent

    assert {path.name for path in folder.iterdir()} == {"board.html", "entries.csv", "scores.csv"}
    assert board.problems == [] and [table.title for table in board.tables] == ["tiny-v1, given: boundaries"]
    assert len(list(csv.DictReader((folder / "scores.csv").open()))) == 2 * 2


def test_the_command_says_what_is_left_out_and_why(tiny_home, submission, tmp_path, monkeypatch, capsys):
    shutil.copytree(submission.path, tmp_path / "all" / "twice")
    shutil.copytree(submission.path, tmp_path / "all" / "other")
    edit(tmp_path / "all" / "other", lambda given: given["method"].update(track="forgetting"))
    (tmp_path / "empty").mkdir()
    paths = (str(submission.path), str(tmp_path / "all"), str(tmp_path / "empty"))
    words = ["board", *paths, "--out", str(tmp_path / "out"), "--config-dir", str(tiny_home / "conf")]
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl", *words])

    with pytest.raises(SystemExit) as ended:
        cli.main()

    said = capsys.readouterr()
    assert ended.value.code == 1
    assert said.out == f"board of 1 submission in 1 table: {tmp_path / 'out' / 'board.html'}\n"
    assert "is none of track forgetting-v1" in said.err
    assert "are one submission twice; the second is left out" in said.err
    assert "empty holds no submission: ctgraph-rl submit RUNS --to DIR makes one" in said.err
    assert "3 left out" in (tmp_path / "out" / "board.html").read_text()


def test_without_a_submission_there_is_no_board(tmp_path):
    with pytest.raises(ValueError, match="holds no submission"):
        write_board([tmp_path], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_submission_for_no_track_is_left_out_and_named(submission):
    with pytest.raises(ValueError, match="is for no track: name one in"):
        make_entry(replace(submission, track=None))


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs a browser: apt-get install chromium")
def test_a_browser_filters_and_sorts(board, tmp_path):
    page = board.page.read_text()
    script = """<script>
      const form = document.forms[0], rows = () => [...document.querySelectorAll("tbody tr")];
      const first = rows()[0], again = first.cloneNode(true);
      again.dataset.level = 4; again.children[2].dataset.value = -1; first.parentNode.append(again);
      document.querySelectorAll("thead button")[2].click();
      const sorted = rows()[0] === again;
      form.elements.level.value = "4"; form.dispatchEvent(new Event("input"));
      const filtered = first.hidden && !again.hidden;
      form.elements.given.value = ""; form.elements.steps.value = "1"; form.dispatchEvent(new Event("input"));
      const none = !document.getElementById("none").hidden && document.querySelector("section").hidden;
      document.body.dataset.found = [!form.hidden, sorted, filtered, none].join(" ");
    </script></body>"""
    changed = tmp_path / "changed.html"
    changed.write_text(re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page).replace("</body>", script))
    options = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom")

    dom = subprocess.run([BROWSER, *options, changed.as_uri()], capture_output=True, text=True, timeout=600).stdout

    assert 'data-found="true true true true"' in dom
