"""Level rescored: what a submission says is what its logs give, and everything that was edited is found."""

from __future__ import annotations

import gzip
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from ctgraph_rl import RunLog
from ctgraph_rl.board import rerun, verify
from ctgraph_rl.board import rescore as module
from ctgraph_rl.board.rescore import RESCORED, rescore
from ctgraph_rl.board.submission import Submission, log_sum, packed, read_log, read_submission
from ctgraph_rl.log import provenance
from ctgraph_rl.log.tables import evaluations_parquet

pytest.importorskip("pyarrow")

LOG = "logs/tiny-seed1.jsonl.gz"


def edit(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))


def edit_log(folder: Path, change: Callable[[list[dict]], object], with_sum: bool = False) -> RunLog:
    """Change the lines of a log; with its sum, too, as one who hides it would."""
    before = log_sum(read_log(folder / LOG))
    lines = [json.loads(line) for line in gzip.decompress((folder / LOG).read_bytes()).splitlines()]
    change(lines)
    (folder / LOG).write_bytes(packed("".join(json.dumps(line) + "\n" for line in lines).encode()))
    if with_sum:
        edit(folder / "runs.csv", before, log_sum(read_log(folder / LOG)))
    return read_log(folder / LOG)


def better(lines: list[dict]) -> None:
    lines[-1]["return_mean"] = 1.0


def found(submission: Submission) -> dict[str, str]:
    """What a verification of the files as they are now finds wrong, each with its run and note."""
    checks = rescore(read_submission(submission.path, submission.track))
    return {
        check.what: f"{check.run}: {check.expected}; {check.found}; {check.note}"
        for check in checks
        if not check.passed
    }


def test_a_submission_that_was_not_edited_passes_on_any_kind_of_machine(submission, monkeypatch):
    assert found(submission) == {}

    monkeypatch.setattr(module, "machine", lambda: {"machine": "other", "num_threads": 1})
    assert found(submission) == {}


def test_a_tampered_log_is_found_by_its_sum_and_with_its_sum_by_metrics_and_evaluations(submission):
    log = edit_log(submission.path, better)
    first = found(submission)

    edit(submission.path / "runs.csv", submission.runs[1].log_sha256, log_sum(log))
    second = found(submission)

    assert first.keys() == {"sum of the log", *second}
    assert second["average_performance in metrics.csv"].startswith("tiny-seed1: 0.25; 0.0;")
    assert "row 40 of evaluations.parquet" in second


def test_a_changed_metric_is_found_to_its_last_digit(submission, monkeypatch):
    value = submission.metrics["tiny-seed1"]["memoryless_ceiling"]["value"]
    near = repr(float(value) + 2e-16)
    assert near != value
    path = submission.path / "metrics.csv"

    edit(path, f"tiny-seed1,1,memoryless_ceiling,{value}", f"tiny-seed1,1,memoryless_ceiling,{near}")
    assert found(submission) == {"memoryless_ceiling in metrics.csv": f"tiny-seed1: {value}; {near}; "}
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(module, "machine", lambda: {"machine": "other", "num_threads": 1})
        assert found(submission) == {}  # another kind of machine may round otherwise

        edit(path, f"memoryless_ceiling,{near}", "memoryless_ceiling,0.9")
        assert found(submission).keys() == {"memoryless_ceiling in metrics.csv"}


@pytest.mark.parametrize(
    ("metric", "missed"), [("zero_shot_transfer", False), ("forgetting", True), ("average_performance", True)]
)
def test_a_metric_that_no_run_states_is_missed_where_a_board_shows_it(submission, metric, missed):
    path = submission.path / "metrics.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if f",{metric}," not in line))

    assert ({f"{metric} in metrics.csv"} == found(submission).keys()) is missed


def test_a_changed_evaluation_is_found_with_its_row(submission):
    logs = [submission.log(run) for run in submission.runs]
    better(logs[1].measurements)

    (submission.path / "evaluations.parquet").write_bytes(evaluations_parquet(logs))
    assert found(submission) == {"row 40 of evaluations.parquet": ": return_mean=0.0; return_mean=1.0; "}
    (submission.path / "evaluations.parquet").write_bytes(b"no table")
    assert "a file that cannot be read" in found(submission)["evaluations.parquet"]


def test_another_curriculum_is_found_whichever_file_has_it(submission):
    other = submission.track.variants[0].curriculum
    hidden = next(each for each in submission.track.variants if each.curriculum.fingerprint != other.fingerprint)
    path = submission.path / "curriculum.json"

    path.unlink()
    hidden.curriculum.to_json(path)
    assert {"curriculum of the log", "curriculum of runs.csv", "method.yaml"} <= found(submission).keys()

    path.unlink()
    longer = yaml.safe_load(json.dumps(other.to_json()))
    longer["blocks"][0]["num_frames"] += 32
    path.write_text(json.dumps(longer))
    with pytest.raises(ValueError, match=r"fingerprint is .*, but the content has"):
        found(submission)


@pytest.mark.parametrize(
    ("file", "before", "after", "what"),
    [
        ("runs.csv", "tiny-seed1,1,", "tiny-seed1,5,", "seeds"),  # a picked seed in place of the track's
        ("runs.csv", "tiny-seed1,1,", "tiny-seed1,150,", "seeds"),
        ("runs.csv", "finished,,,", "finished,,0 1,", "group"),
        ("runs.csv", "finished,", "failed,", "failed seeds of method.yaml"),
        ("runs.csv", ",su_b1_4tasks,", ",a_harder_one,", "name of the curriculum in runs.csv"),
        ("runs.csv", ",{seconds}", ",1{seconds}", "seconds of runs.csv"),
        ("runs.csv", "finished,,", "finished,no,", "reason of runs.csv"),
        ("config.yaml", "gamma: 0.99", "gamma: 0.98", "config.yaml"),
        ("versions.txt", "torch==", "torch==1", "versions.txt"),
        ("method.yaml", "boundaries: announced", "boundaries: hidden", "method.yaml"),
        ("method.yaml", "bytes_per_task: 0", "bytes_per_task: 1000000000", "method.yaml"),
        ("method.yaml", "seeds: []", "seeds: [1]", "seeds"),
        ("metrics.csv", "tiny-seed0,0,average_performance,", "tiny-seed2,0,average_performance,", "metrics.csv"),
    ],
)
def test_an_edited_file_is_found(submission, file, before, after, what):
    seconds = submission.runs[0].seconds

    edit(submission.path / file, before.format(seconds=seconds), after.format(seconds=seconds))

    assert what in found(submission)


def test_a_log_that_leaves_an_evaluation_out_or_has_one_twice_or_ends_early_is_found(submission):
    edit_log(submission.path, lambda lines: lines.insert(2, lines[2]), with_sum=True)
    assert "evaluations" in found(submission)
    edit_log(submission.path, lambda lines: lines.__delitem__(slice(2, 4)), with_sum=True)
    assert "missing (frames, task, episodes): (0, 2, 2)" in found(submission)["evaluations"]

    edit_log(submission.path, lambda lines: lines.__delitem__(slice(-20, None)))
    assert found(submission)["frames"].startswith("tiny-seed1: 256; ")


def test_the_command_writes_what_it_found_and_exits_with_1_where_something_differs(
    submission, tiny_home, monkeypatch, capsys
):
    words = [str(submission.path), "--level", "rescored", "--config-dir", str(tiny_home / "conf")]
    monkeypatch.setattr(sys, "argv", ["verify", *words])
    verify.main()
    text = (submission.path / "verification.json").read_text()
    first = json.loads(text)

    assert [json.loads(line.rstrip(",")) for line in text.splitlines() if '"what"' in line] == first["checks"]
    assert (first["level"], first["digest"]) == (RESCORED, submission.digest)
    assert (first["versions"], first["machine"]) == (provenance.versions(), provenance.machine()["machine"])
    assert "all passed; level rescored" in capsys.readouterr().out

    edit(submission.path / "config.yaml", "gamma: 0.99", "gamma: 0.98")
    with pytest.raises(SystemExit, match="1"):
        verify.main()
    second = json.loads((submission.path / "verification.json").read_text())
    assert (second["level"], second["digest"] == first["digest"]) == ("none", False)
    assert "- tiny-seed0: config.yaml: expected equal settings, found agent.gamma=0.99 instead of 0.98" in (
        capsys.readouterr().out.splitlines()
    )


def test_numbers_of_the_first_line_of_a_log_count_and_three_differing_values_are_shown(monkeypatch):
    monkeypatch.setattr("ctgraph_rl.log.provenance.NUMBERS", 2)
    log = SimpleNamespace(
        measurements=[{"kind": "run", "numbers": 2}, {"kind": "training", **dict.fromkeys("abcd", 1)}]
    )
    other = SimpleNamespace(
        measurements=[{"kind": "run", "numbers": 2}, {"kind": "training", **dict.fromkeys("abcd", 2)}]
    )
    submission = SimpleNamespace(log=lambda run: log, config={"device": "cuda"}, versions={})
    run = SimpleNamespace(machine="", cpu="")

    assert rerun.why_other_bits(submission, [run])[0] == "device cuda"
    assert rerun.first_difference(log, other) == "first in line 2, training: a 1 and 2, b 1 and 2, c 1 and 2"
