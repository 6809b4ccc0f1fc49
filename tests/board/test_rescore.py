"""Level rescored: what a submission says is what its logs give, and each thing that was edited is found."""

from __future__ import annotations

from ctgraph_rl.board.rescore import rescore


def test_a_submission_that_nobody_edited_passes(tiny_submission):
    checks = rescore(tiny_submission)

    assert [check.text for check in checks if not check.passed] == []
