"""docs/results/lifelong.md, "In short" and "What epochs change": what they say holds of the raw results."""

from __future__ import annotations

import math
from statistics import fmean

import pytest
from helpers.paths import CHECKOUT

pytestmark = pytest.mark.slow

FOLDER = CHECKOUT / "docs" / "results"
PAGE = " ".join((FOLDER / "lifelong.md").read_text(encoding="utf-8").split())
METHODS = ("finetune", "mask_lc", "ewc_published", "mask_ri", "mask_blc")
TABLES = ("masks_ct8_md", "masks_ct8", "masks_ct12")


@pytest.fixture(scope="module")
def measured():
    """The scores of the runs of a method, by the table, the number of epochs and the method."""
    from studies.lifelong import comparison, pairs

    found = {}
    for table in comparison.MASKS:
        for num, name in ((8, f"epochs/{table}"), (1, table)):
            for (method, _), lines in comparison.groups(comparison.read(name), "method", "seed").items():
                if method in METHODS:
                    scores = comparison.scores(lines) | {"while learning": pairs.while_learning(lines)}
                    found.setdefault((table, num, method), []).append(scores)
    return found


@pytest.fixture
def values(measured):
    """A column of a table, for a number of epochs and a method: a value for each run."""
    return lambda table, epochs, method, column: [scores[column] for scores in measured[table, epochs, method]]


@pytest.mark.parametrize(
    ("table", "with_one", "with_eight", "sentence"),
    [
        (
            "masks_ct8_md",
            (20, {3, 4, 5}),
            (5, {0, 1}),
            "On CT8 multi-depth each of its 20 runs with one epoch knows three to five tasks at the end. Each of the "
            "five with 8 epochs knows none or one.",
        ),
        (
            "masks_ct8",
            (10, {8}),
            (5, {2, 4, 5, 7}),
            "On CT8 each of ten knows all eight, and each of five two to seven.",
        ),
        (
            "masks_ct12",
            (10, {12}),
            (5, {2, 3, 4, 5}),
            "On CT12 each of ten knows all twelve, and each of five two to five.",
        ),
    ],
)
def test_ewc_keeps_what_it_learned_with_one_epoch_only(values, table, with_one, with_eight, sentence):
    one, eight = (values(table, epochs, "ewc_published", "known at the end") for epochs in (1, 8))
    learned = [fmean(values(table, epochs, "ewc_published", "tasks learned")) for epochs in (1, 8)]

    assert [(len(found), set(found)) for found in (one, eight)] == [with_one, with_eight]
    assert abs(learned[0] - learned[1]) <= 0.2
    assert sentence in PAGE


def test_a_clear_separation_is_as_probable_as_the_page_says():
    assert f"2 of {math.comb(25, 5):,} cases (CT8 multi-depth) and 2 of {math.comb(15, 5):,}." in PAGE


@pytest.mark.parametrize("table", TABLES)
def test_ppo_alone_has_less_with_one_epoch_while_learning(values, table):
    one, eight = (fmean(values(table, epochs, "finetune", "while learning")) for epochs in (1, 8))

    assert one < eight
    assert "Fine-tuned PPO learns less with one epoch." in PAGE


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("method", ["mask_lc", "mask_ri", "mask_blc"])
def test_masks_keep_all_that_they_learned_with_both(values, table, method):
    for epochs in (1, 8):
        learned, known = (values(table, epochs, method, column) for column in ("tasks learned", "known at the end"))
        assert known == learned
    assert "Masks keep all that they learned with both." in PAGE
