"""Level rescored: what a submission says is what its logs give, and everything that was edited is found."""

from __future__ import annotations

import gzip
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.paths import CHECKOUT
from helpers.submissions import edit, edit_run

import curricula
from ctgraph_rl import RunLog
from ctgraph_rl.board import rerun, verify
from ctgraph_rl.board.rescore import RESCORED, Check, rescore, scores_of
from ctgraph_rl.board.submission import Submission, log_sum, packed, read_log, read_submission
from ctgraph_rl.log import provenance

LOG = "logs/seed1.jsonl.gz"


def edit_log(folder: Path, change: Callable[[list[dict]], object], with_sum: bool = False) -> RunLog:
    """Change the lines of a log; with its sum, too, as one who hides it would."""
    lines = [json.loads(line) for line in gzip.decompress((folder / LOG).read_bytes()).splitlines()]
    change(lines)
    (folder / LOG).write_bytes(packed("".join(json.dumps(line) + "\n" for line in lines).encode()))
    if with_sum:
        edit_run(folder, 1, log_sha256=log_sum(read_log(folder / LOG)))
    return read_log(folder / LOG)


def better(lines: list[dict]) -> None:
    lines[-1]["return_mean"] = 1.0


def found(submission: Submission) -> dict[str, str]:
    """What a verification of the files as they are now finds wrong, each with its run and note."""
    checks = rescore(read_submission(submission.path, submission.track.config_dir))
    return {
        check.what: f"{check.run}: {check.expected}; {check.found}; {check.note}"
        for check in checks
        if not check.passed
    }


def test_a_submission_that_was_not_edited_passes(submission):
    assert found(submission) == {}


def test_a_tampered_log_is_found_by_its_sum_and_its_scores_are_no_others_without(submission):
    edit_log(submission.path, better)

    assert found(submission).keys() == {"sum of the log"}
    with pytest.raises(ValueError, match="the log of seed1 is another one than the submission names: restore it"):
        scores_of(submission, submission.runs[1])


def test_the_scores_are_those_of_the_log(submission):
    run = submission.runs[1]
    before = scores_of(submission, run)

    edit_log(submission.path, better, with_sum=True)
    edited = read_submission(submission.path, submission.track.config_dir)

    assert (before["average_performance"], scores_of(edited, edited.runs[1])["average_performance"]) == (0.0, 0.25)


def test_another_curriculum_is_found(submission):
    other = submission.track.variants[0].curriculum
    hidden = next(each for each in submission.track.variants if each.curriculum.fingerprint != other.fingerprint)

    edit(submission.path, lambda given: given.update(curriculum=hidden.curriculum.to_json()))
    assert {"curriculum of the log", "method"} <= found(submission).keys()

    longer = json.loads(json.dumps(other.to_json()))
    longer["blocks"][0]["num_frames"] += 32
    edit(submission.path, lambda given: given.update(curriculum=longer))
    with pytest.raises(ValueError, match=r"fingerprint is .*, but the content has"):
        found(submission)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda given: given["runs"][1].update(seed=5), "seeds"),  # a picked seed in place of the track's
        (lambda given: given["runs"][1].update(seed=150), "seeds"),
        (lambda given: given["runs"][1].update(group=[0, 1]), "group"),
        (lambda given: given["runs"][1].update(seconds=1e6), "seconds"),
        (lambda given: given["runs"][1].update(num_threads=2), "threads"),
        (lambda given: given["config"]["agent"].update(gamma=0.98), "config"),
        (lambda given: given["versions"].update(torch="1"), "versions"),
        (lambda given: given["method"]["given"].update(boundaries="hidden"), "method"),
        (lambda given: given["method"].update(bytes_per_task=10**9), "method"),
        (lambda given: given["method"]["tuning"].update(seeds=[1]), "seeds"),
        (lambda given: given.update(curriculum=curricula.load("su_b1_4tasks").to_json()), "curriculum"),
        (lambda given: given["config"].update(agent=None), "way to run it again"),
        (lambda given: given["config"].update(detector={"_target_": "baselines.detectors.oracle.Oracle"}), "oracle"),
    ],
)
def test_an_edited_value_is_found(submission, change, what):
    edit(submission.path, change)

    assert what in found(submission)


def test_a_log_that_leaves_an_evaluation_out_or_has_one_twice_or_ends_early_is_found(submission):
    edit_log(submission.path, lambda lines: lines.insert(2, lines[2]), with_sum=True)
    assert "evaluations" in found(submission)
    edit_log(submission.path, lambda lines: lines.__delitem__(slice(2, 4)), with_sum=True)
    assert "missing (frames, task, episodes): (0, 2, 2)" in found(submission)["evaluations"]

    edit_log(submission.path, lambda lines: lines.__delitem__(slice(-20, None)))
    assert found(submission)["frames"].startswith("seed1: 256; ")


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

    path = submission.path / "verification.json"
    verify.write_verification(submission, [Check("", "", "", True, level=level) for level in ("rescored", "rerun")])
    with pytest.raises(SystemExit, match="2"):
        verify.main()
    assert f"{path} has the level rerun, --level rescored would replace it" in capsys.readouterr().err

    edit(submission.path, lambda given: given["config"]["agent"].update(gamma=0.98))
    with pytest.raises(SystemExit, match="1"):
        verify.main()
    second = json.loads((submission.path / "verification.json").read_text())
    assert (second["level"], second["digest"] == first["digest"]) == ("none", False)
    assert "- seed0: config: expected equal settings, found agent.gamma=0.99 instead of 0.98" in (
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


def test_logs_of_a_setting_that_is_gone_keep_their_sum():
    """Two stored lines: with `deduplicate`, which agents had, and without."""
    for name in ("adaptation-rl2-depth2", "ppo"):
        stored = read_submission(CHECKOUT / "docs" / "results" / "board" / name)
        run = stored.runs[0]

        assert log_sum(stored.log(run)) == run.log_sha256
