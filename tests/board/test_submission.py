"""A submission is read without trust in who wrote it."""

from __future__ import annotations

import shutil
import zlib

import pytest
from helpers.paths import CHECKOUT

from ctgraph_rl.board.method_yaml import EXAMPLE
from ctgraph_rl.board.submission import COLUMNS, FILES, METRIC_COLUMNS, VERIFICATION, read_submission

pytest.importorskip("pyarrow")


def test_the_page_of_the_format_lists_every_file_column_and_key():
    page = (CHECKOUT / "docs" / "reference" / "submissions.md").read_text(encoding="utf-8")
    keys = [f"{key}.{part}" for key, value in EXAMPLE.items() for part in value or [""] if isinstance(value, dict)]
    plain = [key for key, value in EXAMPLE.items() if not isinstance(value, dict) or not value]

    for columns in (COLUMNS, METRIC_COLUMNS):
        assert "\n".join(f"| `{name}` | {meaning} |" for name, meaning in columns.items()) in page
    for name in (*FILES, VERIFICATION, *plain, *(key.removesuffix(".") for key in keys)):
        assert f"`{name}`" in page


def test_the_digest_is_of_all_files_but_verifications_and_hidden_ones(submission):
    before = submission.digest

    (submission.path / "verification.json").write_text("{}")
    (submission.path / ".DS_Store").write_text("")
    assert read_submission(submission.path, submission.track).digest == before

    (submission.path / "logs" / "code.py").write_text("")
    assert read_submission(submission.path, submission.track).digest != before


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("method.yaml", "name: [", r"method.yaml must be YAML: .* expected the node content"),
        (
            "method.yaml",
            "- 1",
            r"method.yaml: it must hold name, authors and so on, got \[1\]; ctgraph-rl submit",
        ),
        ("method.yaml", "nam: x", "name is missing; .*unknown key nam: did you mean 'name'"),
        ("config.yaml", "seed: 1", "config.yaml must leave out the seed, which runs.csv lists"),
        ("versions.txt", "torch", r"versions.txt must have lines such as torch==2.9.0, got \['torch'\]"),
        ("runs.csv", "run,seed\n", "runs.csv must have the columns run, seed, curriculum, .*, got run, seed"),
        ("metrics.csv", None, r"submission lacks metrics.csv: ctgraph-rl submit RUNS --to DIR writes all of them"),
        ("logs/tiny-seed0.jsonl.gz", None, "lacks logs/tiny-seed0.jsonl.gz, which runs.csv names"),
    ],
)
def test_what_is_no_submission_is_refused_with_the_file(submission, file, content, message):
    path = submission.path / file
    path.unlink()
    if content is not None:
        path.write_text(content)

    with pytest.raises(ValueError, match=message):
        read_submission(submission.path, submission.track)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("tiny-seed1,", "../tiny-seed1,", r"line 3: run must be a name of a file, got '../tiny-seed1'"),
        ("tiny-seed1,1,", "tiny-seed1,0,", "runs.csv has a seed twice: 0"),
        ("tiny-seed1,1,", "tiny-seed0,1,", "runs.csv lines 2 and 3 are both of tiny-seed0"),
        ("tiny-seed1,1,", "tiny-seed1,x,", "line 3: seed must be an integer >= 0, got 'x'"),
        (",{seconds}", "," + 400 * "9", r"line 2: seconds must be a number in 0..1,000,000,000, got '9999"),
        (",{seconds}", ",1000000000.1", r"line 2: seconds must be a number in 0..1,000,000,000, got '1000000000.1'"),
        ("finished,", "done,", "line 2: state must be finished or failed, got 'done'"),
        ("agent_sha256", "sha256", "runs.csv must have the columns run, seed"),
    ],
)
def test_a_line_of_runs_csv_out_of_range_is_refused(submission, before, after, message):
    path = submission.path / "runs.csv"
    path.write_text(path.read_text().replace(before.format(seconds=submission.runs[0].seconds), after, 1))

    with pytest.raises(ValueError, match=message):
        read_submission(submission.path, submission.track)


def test_links_are_refused_and_no_log_is_unpacked_beyond_its_limit(submission, monkeypatch):
    run, log = submission.runs[0], submission.path / "logs" / "tiny-seed0.jsonl.gz"

    monkeypatch.setattr("ctgraph_rl.board.submission.MOST_BYTES", 1000)
    with pytest.raises(ValueError, match=r"tiny-seed0.jsonl.gz (has|holds more than) .*1,000"):
        submission.log(run)
    monkeypatch.undo()
    whole = log.read_bytes()
    log.write_bytes(whole[:-20])
    with pytest.raises(ValueError, match="ends too early: restore it"):
        submission.log(run)
    log.write_bytes(zlib.compress(b"no gzip"))
    with pytest.raises(ValueError, match="is no file of gzip"):
        submission.log(run)

    shutil.move(log, submission.path / "elsewhere")
    log.symlink_to(submission.path / "elsewhere")
    with pytest.raises(ValueError, match=r"has links, logs/tiny-seed0.jsonl.gz: put the files in their place"):
        read_submission(submission.path, submission.track)
