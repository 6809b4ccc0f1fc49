"""docs/results/lifelong.md, "What epochs change": what it says holds of the raw results."""

from __future__ import annotations

import math
import re
import sys
from statistics import fmean

import pytest
from helpers.paths import CHECKOUT

FOLDER = CHECKOUT / "docs" / "results"
PAGE = " ".join((FOLDER / "lifelong.md").read_text(encoding="utf-8").split())
METHODS = ("finetune", "mask_lc", "ewc_published", "mask_ri", "mask_blc")


@pytest.fixture(scope="module")
def measured():
    """The scores of the runs of a method, by the number of epochs and the method."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(str(FOLDER))
        epochs, comparison, pairs = (__import__(name) for name in ("epochs", "comparison", "pairs"))
        found = {}
        for num, name in ((8, epochs.eight("masks_ct8_md")), (1, "masks_ct8_md")):
            for (method, _), lines in comparison.groups(comparison.read(name), "method", "seed").items():
                if method in METHODS:
                    scores = comparison.scores(lines) | {"while learning": pairs.while_learning(lines)}
                    found.setdefault((num, method), []).append(scores)
        yield found
        for name in ("epochs", "comparison", "pairs", "raw"):
            sys.modules.pop(name, None)


def values(measured, epochs: int, method: str, column: str) -> list[float]:
    return [scores[column] for scores in measured[epochs, method]]


@pytest.mark.parametrize("method", METHODS)
def test_a_line_has_both_columns_for_8_epochs_and_for_one(measured, method):
    (line,) = re.findall(rf"\| `{method}` ((?:\| [^|]*\(n = \d+\) ){{4}})", PAGE)

    shown = re.findall(r"\| ([\d.]+) [^|]*\(n = (\d+)\)", line)
    columns = [(column, epochs) for column in ("tasks learned", "known at the end") for epochs in (8, 1)]
    expected = [values(measured, epochs, method, column) for column, epochs in columns]
    assert shown == [(f"{fmean(found):.2f}", str(len(found))) for found in expected]


def test_ewc_keeps_what_it_learned_with_one_epoch_only(measured):
    one, eight = (values(measured, epochs, "ewc_published", "known at the end") for epochs in (1, 8))
    learned = [fmean(values(measured, epochs, "ewc_published", "tasks learned")) for epochs in (1, 8)]

    assert (len(one), set(one), len(eight), set(eight)) == (20, {3, 4, 5}, 5, {0, 1})
    assert abs(learned[0] - learned[1]) <= 0.2
    assert f"a probability of 2 in {math.comb(25, 5):,}" in PAGE
    assert "EWC learns about as many tasks with both, and keeps them with one epoch only: each of its 20 runs" in PAGE


def test_ppo_alone_has_less_with_one_epoch(measured):
    for column in ("while learning", "known at the end", "tasks learned"):
        assert fmean(values(measured, 1, "finetune", column)) < fmean(values(measured, 8, "finetune", column))
    assert "PPO alone has less with one epoch, while learning and at the end" in PAGE


@pytest.mark.parametrize("method", ["mask_lc", "mask_ri", "mask_blc"])
def test_masks_keep_all_that_they_learned_with_both(measured, method):
    for epochs in (1, 8):
        assert values(measured, epochs, method, "known at the end") == values(measured, epochs, method, "tasks learned")
    assert "masks keep all that they learned with both" in PAGE
