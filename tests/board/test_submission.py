"""A submission is read without trust in who wrote it."""

from __future__ import annotations

import gzip
import json
import re
import subprocess
import sys
import zlib

import pytest
from helpers.paths import CHECKOUT
from helpers.submissions import edit, edit_run

from ctgraph_rl.board.method_yaml import EXAMPLE
from ctgraph_rl.board.submission import PARTS, RUN, SUBMISSION, VERIFICATION, read_submission


def test_the_page_of_the_format_lists_every_file_and_key():
    page = (CHECKOUT / "docs" / "reference" / "submissions.md").read_text(encoding="utf-8")
    keys = [f"{key}.{part}" for key, value in EXAMPLE.items() for part in value or [""] if isinstance(value, dict)]
    plain = [key for key, value in EXAMPLE.items() if not isinstance(value, dict) or not value]

    listed = re.findall(r"^\| `([a-z0-9_]+)` \| \w", page, re.MULTILINE)
    assert listed[: len(PARTS) + len(RUN)] == [*PARTS, *RUN]
    for name in (SUBMISSION, VERIFICATION, *plain, *(key.removesuffix(".") for key in keys)):
        assert f"`{name}`" in page


def test_the_digest_is_that_of_the_file_that_has_the_sums_of_all_logs(submission):
    (submission.path / "verification.json").write_text("{}")
    (submission.path / "logs" / "code.py").write_text("")
    assert read_submission(submission.path, submission.track.config_dir).digest == submission.digest

    edit_run(submission.path, log_sha256="0" * 64)
    assert read_submission(submission.path, submission.track.config_dir).digest != submission.digest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda given: given.pop("method"), "must be an object of schema, method, config, versions, curriculum, runs"),
        (lambda given: given.update(more=1), "must be an object of schema, method"),
        (lambda given: given.update(schema=3), "schema must be 2, got 3"),
        (lambda given: given["method"].pop("name"), "name is missing"),
        (lambda given: given["method"].update(nam="x"), "unknown key nam: did you mean 'name'"),
        (lambda given: given["config"].update(seed=1), "config must leave out the seed, which the runs have"),
        (lambda given: given.update(config=[1]), r"config must be settings, got \[1\]"),
        (lambda given: given.update(versions={"torch": 2}), "versions must be texts by name, got"),
        (lambda given: given.update(runs=[]), r"runs must be a list of 1..10,000, got \[\]"),
        (lambda given: given["curriculum"].pop("blocks"), "blocks"),
    ],
)
def test_what_is_no_submission_is_refused_with_the_file_and_the_key(submission, change, message):
    edit(submission.path, change)

    with pytest.raises(ValueError, match=f"submission.json .*{message}"):
        read_submission(submission.path, submission.track.config_dir)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"run": "../seed1"}, r"run of '../seed1' must be a name of a file, got '../seed1'"),
        ({"run": "seed0"}, "names a run twice: seed0"),
        ({"seed": 0}, "has a seed twice: 0"),
        ({"seed": "1"}, "seed of 'seed1' must be an integer >= 0, got '1'"),
        ({"seed": True}, "seed of 'seed1' must be an integer >= 0, got True"),
        ({"seconds": 1e9 + 0.1}, r"seconds of 'seed1' must be a number in 0..1,000,000,000, got 1000000000.1"),
        ({"reason": 5}, "reason of 'seed1' must be a text or null, got 5"),
        ({"group": [0, "x"]}, "group of 'seed1' must be a list of seeds"),
        ({"log_sha256": "x"}, "log_sha256 of 'seed1' must be 64 hexadecimal digits"),
        ({"agent_sha256": ""}, "agent_sha256 of 'seed1' must be 64 hexadecimal digits or null"),
        ({"agent_bytes": -1}, "agent_bytes of 'seed1' must be an integer >= 0 or null, got -1"),
        ({"experts": ["0" * 64]}, "experts of 'seed1' must be empty"),
        ({"more": 1}, "a run must have run, seed, reason"),
    ],
)
def test_a_run_out_of_range_is_refused(submission, values, message):
    edit_run(submission.path, 1, **values)

    with pytest.raises(ValueError, match=f"submission.json .*{message}"):
        read_submission(submission.path, submission.track.config_dir)


def test_without_a_file_it_names_the_file_is_named(submission):
    (submission.path / "logs" / "seed0.jsonl.gz").unlink()
    with pytest.raises(ValueError, match=r"lacks logs/seed0.jsonl.gz, which submission.json names"):
        read_submission(submission.path, submission.track.config_dir)

    (submission.path / SUBMISSION).unlink()
    with pytest.raises(ValueError, match=r"holds no submission, it lacks submission.json: ctgraph-rl submit RUNS --to"):
        read_submission(submission.path, submission.track.config_dir)


def test_no_log_is_unpacked_beyond_its_limit_and_a_torn_one_is_refused(submission, monkeypatch):
    run = submission.runs[0]
    log = submission.path / "logs" / "seed0.jsonl.gz"

    with monkeypatch.context() as small:
        small.setattr("ctgraph_rl.board.submission.MOST_BYTES_OF_A_LOG", 1000)
        with pytest.raises(ValueError, match=r"seed0.jsonl.gz (has|holds more than) .*1,000"):
            submission.log(run)
    whole = log.read_bytes()
    for content in (whole[:-20], zlib.compress(b"no gzip"), whole + b"more"):
        log.write_bytes(content)
        with pytest.raises(ValueError, match=r"is no file of gzip: .*; restore it"):
            submission.log(run)
    log.unlink()
    log.symlink_to(submission.path / "verification.json")
    with pytest.raises(ValueError, match="lacks logs/seed0"):
        read_submission(submission.path, submission.track.config_dir)


BOMBS = {
    "grows": bytes(2**28),
    "small records": b"{}\n" * (2**26 // 3),
    "small values": b'{"kind": "training", "a": [' + b"{}," * (2**26 // 3 - 20) + b"{}]}\n",
}

READ = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[2]), int(sys.argv[2])))
from pathlib import Path
from ctgraph_rl.board.submission import read_log
try:
    read_log(Path(sys.argv[1]))
except ValueError as error:
    print(error)
status = Path("/proc/self/status").read_text()  # getrusage counts what the parent took, too
print(status.partition("VmHWM:")[2].split()[0])
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_before_it_takes_more_than_its_limit(tmp_path, name):
    path = tmp_path / "log.jsonl.gz"
    path.write_bytes(gzip.compress(BOMBS[name], 1))
    done = subprocess.run([sys.executable, "-c", READ, str(path), str(2**34)], capture_output=True, text=True)

    assert done.returncode == 0, done.stderr
    said, kibibytes = done.stdout.splitlines()
    assert "holds more than 67,108,864 bytes" in said or "of memory, the limit is 4,294,967,296" in said
    assert int(kibibytes) * 1024 < 10**9


def test_small_records_count_by_the_memory_that_they_take(monkeypatch):
    from ctgraph_rl.log import run_log

    monkeypatch.setattr(run_log, "MOST_MEMORY", 10_000)
    line = json.dumps({"kind": "training", "block": 1, "frames": 64}).encode() + b"\n"

    assert len(run_log.RunLog.of_content(line * 10, "run.jsonl").measurements) == 10
    with pytest.raises(ValueError, match=r"run.jsonl would take [\d,]+ bytes of memory, the limit is 10,000"):
        run_log.RunLog.of_content(line * 20, "run.jsonl")
