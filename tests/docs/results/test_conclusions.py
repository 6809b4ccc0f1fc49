"""What pages of results conclude is computed from raw results: of opposite ones it is not said."""

from __future__ import annotations

from importlib import import_module

import pytest
from helpers.conclusions.sentences import Sentences
from helpers.opposite import Table, empty, mirror, shuffle, write_changed
from helpers.paths import CHECKOUT
from studies import raw

SCORES = ("greedy_return", "greedy_success", "sampled_return", "sampled_success")
RETURNS = tuple(map(str, range(1, 13)))

TABLES = {
    "adaptation": [
        Table("adaptation", ("success",), ("agent", "gate")),
        Table("adaptation_swap", ("success",), ("agent",)),
    ],
    "baselines": [
        *(Table(name, SCORES, ("agent",)) for name in ("baselines_b1", "baselines_b1_instances", "depth_ladder")),
        Table("rnd_depth", SCORES, ("depth",)),
        Table("rl2_search", ("greedy_success",), ("depth",)),
        Table("main_job", ("return_mean",), ("label",)),
    ],
    "collectives": [
        Table("collectives", ("final_return",), ("num_members", "exchange")),
        Table("collective_blocks", ("final_return",), ("num_members", "exchange")),
        Table("selecting", ("evaluated",), ("method",)),
    ],
    "lifelong": [
        Table(folder + name, RETURNS[: 12 if name == "masks_ct12" else 8], ("method",))
        for name in ("masks_ct8", "masks_ct12", "masks_ct8_md")
        for folder in ("", "epochs/")
    ],
}
QUICK = "collectives"
PAGES = [pytest.param(page, marks=() if page == QUICK else pytest.mark.slow) for page in TABLES]


def sentences_of(page: str) -> Sentences:
    """The sentences of a page that are checked."""
    return import_module(f"helpers.conclusions.{page}").says


def not_said(sentences: Sentences) -> set[str]:
    """The sentences that raw results do not say."""
    found = set()
    for sentence, holds in sentences.of.items():
        try:
            if not holds():
                found.add(sentence)
        except (ArithmeticError, LookupError, ValueError):
            found.add(sentence)
    return found


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_concludes_is_not_said_of_opposite_or_empty_results(page, tmp_path, monkeypatch):
    says = sentences_of(page)
    found = {}
    for change in (mirror, shuffle, empty):
        write_changed(TABLES[page], change, tmp_path / change.__name__)
        with monkeypatch.context() as patch:
            patch.setattr(raw, "HERE", tmp_path / change.__name__)
            found[change] = not_said(says)

    assert not_said(says) == set()
    assert found[mirror] | found[shuffle] == set(says.of)
    assert found[empty] == set(says.of)


@pytest.mark.parametrize("page", TABLES)
def test_a_page_has_each_sentence_that_is_checked(page):
    text = (CHECKOUT / "docs" / "results" / f"{page}.md").read_text(encoding="utf-8")

    assert [sentence for sentence in sentences_of(page).of if sentence not in " ".join(text.split())] == []
