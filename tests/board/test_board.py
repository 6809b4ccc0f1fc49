"""``ctgraph-rl board``: real submissions become a page and files for programs, and others are left out and named."""

from __future__ import annotations

import csv
import hashlib
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import date

import pytest

from ctgraph_rl import cli
from ctgraph_rl.board.standings.entries import entry_of, level_of
from ctgraph_rl.board.standings.page import write_board
from ctgraph_rl.board.submission import VERIFICATION

for package in ("jinja2", "scipy", "pyarrow"):
    pytest.importorskip(package)

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.fixture
def board(tiny_home, submission, tmp_path):
    """A board of one submission."""
    return write_board([submission.path], tmp_path / "board", tiny_home / "conf", date(2026, 1, 2))


def test_an_entry_has_the_numbers_of_its_submission(submission):
    found = entry_of(submission)

    assert (found.name, found.level, found.why_not_ranked) == ("Tiny PPO", "submitted", None)
    assert found.scores == tuple(
        float(submission.metrics[run.run]["average_performance"]["value"]) for run in submission.runs
    )
    assert (found.seeds, found.frames, found.variant) == ((0, 1), 256, submission.track.variants[0])
    assert found.agent_bytes == submission.runs[0].agent_bytes and found.hours == submission.method["compute"]["hours"]


@pytest.mark.parametrize("level", ["rescored", "rerun", "held_out"])
def test_a_level_is_that_of_the_verification_of_these_very_files(submission, level):
    file = submission.path / VERIFICATION

    file.write_text(json.dumps({"level": level, "digest": submission.digest}))
    assert level_of(submission) == level
    file.write_text(json.dumps({"level": level, "digest": "0" * 64}))
    assert level_of(submission) == "submitted"
    file.write_text(json.dumps({"level": "none", "digest": submission.digest}))
    assert level_of(submission) == "failed"
    file.write_text("[")
    with pytest.raises(ValueError, match="has no level; verify the submission again"):
        level_of(submission)


def test_all_files_are_written_and_describe_each_other(board):
    folder = board.page.parent

    assert {path.name for path in folder.iterdir()} == {
        *("board.html", "board.md", "board.json", "tables.tex"),
        *("entries.csv", "scores.csv", "croissant.json", "model-index.yaml"),
    }
    assert board.problems == [] and [table.title for table in board.tables] == ["tiny-v1, given: boundaries"]
    assert len(list(csv.DictReader((folder / "scores.csv").open()))) == 2 * 2


def test_the_metadata_is_what_croissant_asks_for(board):
    folder = board.page.parent
    about = json.loads((folder / "croissant.json").read_text())

    assert about["@type"] == "sc:Dataset" and about["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    required = ("@context", "description", "license", "name", "url", "creator", "datePublished")
    assert all(about[key] for key in required) and about["datePublished"] == "2026-01-02"
    assert re.fullmatch(r"\d+\.\d+\.\d+\w*", about["version"]) and re.fullmatch(r"\w+", about["name"])
    fields = {field["@id"]: field for records in about["recordSet"] for field in records["field"]}
    names = [each["@id"] for part in ("distribution", "recordSet") for each in about[part]] + list(fields)
    assert len(set(names)) == len(names) == 2 + 2 + sum(len(each["field"]) for each in about["recordSet"])
    for file in about["distribution"]:
        content = (folder / file["contentUrl"]).read_bytes()
        assert file["@type"] == "cr:FileObject" and file["encodingFormat"] == "text/csv"
        assert (file["sha256"], file["contentSize"]) == (hashlib.sha256(content).hexdigest(), f"{len(content)} B")
        extracted = [f["source"]["extract"]["column"] for f in fields.values() if file == _file_of(f, about)]
        assert extracted == content.decode().splitlines()[0].split(",")
    assert {field["dataType"] for field in fields.values()} <= {"sc:Text", "sc:Integer", "sc:Float"}
    assert all(field["@type"] == "cr:Field" and field["description"] for field in fields.values())
    assert fields["scores/submission"]["references"]["field"]["@id"] in fields
    assert about["recordSet"][0]["key"]["@id"] in fields


def _file_of(field, about):
    return next(file for file in about["distribution"] if file["@id"] == field["source"]["fileObject"]["@id"])


def test_the_command_says_what_is_left_out_and_why(tiny_home, submission, tmp_path, monkeypatch, capsys):
    shutil.copytree(submission.path, tmp_path / "all" / "twice")
    shutil.copytree(submission.path, tmp_path / "all" / "other")
    other = tmp_path / "all" / "other" / "method.yaml"
    other.write_text(other.read_text().replace("track: tiny", "track: forgetting"))
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
        entry_of(replace(submission, track=None))


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

    dom = subprocess.run([BROWSER, *options, changed.as_uri()], capture_output=True, text=True, timeout=120).stdout

    assert 'data-found="true true true true"' in dom
