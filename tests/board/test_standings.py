"""Tables of the board, from made-up submissions: who is ranked beside whom, and what each format says of it."""

from __future__ import annotations

import base64
import csv
import hashlib
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

import curricula
from ctgraph_rl import Protocol
from ctgraph_rl.board.method_yaml import TEMPLATE
from ctgraph_rl.board.standings import board_formats as formats
from ctgraph_rl.board.standings.board_page import html
from ctgraph_rl.board.standings.board_tables import BoardTable, tables
from ctgraph_rl.board.standings.entries import BoardEntry
from ctgraph_rl.board.standings.track_ceilings import ceilings_of, write_ceiling
from ctgraph_rl.board.tracks import Track, track
from ctgraph_rl.board.verification import Verification
from ctgraph_rl.report import statistics

pytest.importorskip("scipy")
pytest.importorskip("jinja2")

SMALL, FORGETTING = track("small"), track("forgetting")

ONE = "one policy for all tasks that look the same, at most"
SEARCH = "best search for a goal that is not known"
MEMORYLESS = "best policy without memory"
OPEN_LOOP = "best sequence of actions without observations"
FRAMES = "frames to the first reward of a random policy, on the hardest task"


def entry(name: str, scores: Sequence[float | None], of: Track = SMALL, variant: int = 0, **more: Any) -> BoardEntry:
    """A submission with these scores, one for each seed."""
    code = {"repository": "https://example.org/repository", "commit": "0123abc", "licence": "MIT"}
    method = yaml.safe_load(TEMPLATE) | {"name": name, "authors": ["A. Author"], "code": code}
    method["bytes_per_task"] = more.pop("bytes_per_task", 0)
    method["compute"]["hours"] = 0.25
    verification = Verification(more.pop("level", "submitted"), *more.pop("verification", ()))
    method["failed"] = more.pop("failed", {})
    about = {"verification": verification, "agent_bytes": 1234, "folder": Path("made"), **more}
    values = dict.fromkeys(("normalised_performance", "average_performance", "forgetting"), tuple(scores))
    digest = hashlib.sha256(name.encode()).hexdigest()
    return BoardEntry(digest, method, of, of.variants[variant], values=values, **about)


def some(low: float, high: float, count: int = 20) -> list[float]:
    """Scores of which every other one is the higher one."""
    return [high if seed % 2 else low for seed in range(count)]


def ranks(table: BoardTable) -> dict[str, str]:
    return {line.name: line.rank for line in table.standings}


def test_a_rank_is_the_range_that_corrected_comparisons_of_all_pairs_leave_open():
    one, other = some(0.75, 1.0), some(1.0, 0.75)
    (table,) = tables([entry("low", [0.25] * 20), entry("one", one), entry("other", other), entry("best", [1.0] * 20)])

    assert ranks(table) == {"best": "1", "one": "2 to 3", "other": "2 to 3", "low": "4"}
    assert [line.score.value for line in table.standings] == [1.0, 0.875, 0.875, 0.25]
    assert table.pairs["one", "other"].p_value == 1.0
    assert all(found.p_value == 0.0001 for pair, found in table.pairs.items() if "low" in pair)
    assert table.pairs["best", "low"].holm == pytest.approx(6e-4)


def test_five_seeds_rank_no_one():
    few = replace(SMALL, seeds=(0, 1, 2, 3, 4))
    (table,) = tables([entry("worse", [0.0] * 5, few), entry("better", [1.0] * 5, few)])

    assert ranks(table) == {"better": "1 to 2", "worse": "1 to 2"}
    assert table.pairs["better", "worse"].p_value == 2 / 2**5


def test_what_is_of_another_track_version_rung_or_protocol_is_in_another_table():
    newer, depths = replace(SMALL, version=2), track("exploration")
    found = tables(
        [
            entry("ids", [1.0] * 20),
            entry("nothing", [0.25] * 20, variant=3),
            entry("newer", [0.5] * 20, newer),
            entry("eight tasks", [0.5] * 10, FORGETTING),
            entry("depth 3", [1.0] * 10, depths, variant=1),
            entry("depth 2", [1.0] * 10, depths),
        ]
    )

    assert [(table.title, ranks(table)) for table in found] == [
        ("small-v1, given: task ids, boundaries", {"ids": "1"}),
        ("small-v1, given: nothing", {"nothing": "1"}),
        ("small-v2, given: task ids, boundaries", {"newer": "1"}),
        ("exploration-v1, depth 2, given: nothing", {"depth 2": "1"}),
        ("exploration-v1, depth 3, given: nothing", {"depth 3": "1"}),
        ("forgetting-v1, given: task ids, boundaries", {"eight tasks": "1"}),
    ]
    assert all(not table.pairs for table in found)


def test_without_all_scores_or_with_a_failed_verification_there_is_no_rank():
    missing = entry("missing", [1.0] * 19 + [None], failed={19: "out of memory"})
    wrong = entry("wrong", [1.0] * 20, level="failed")
    other = entry("whole", [0.5] * 20, verification=(True, "verification.json is of other files"))
    (table,) = tables([missing, wrong, other])

    assert ranks(table) == {"missing": "-", "wrong": "-", "whole": "1"}
    assert formats.notes(table) == [
        "missing has no rank: no score of seed 19.",
        "missing, seed 19 failed: out of memory",
        "wrong has no rank: its verification found differences.",
        "whole: verification.json is of other files.",
    ]


def test_an_interval_is_that_of_the_rules_of_the_package():
    (table,) = tables([entry("half", some(0.5, 1.0))])

    assert table.standings[0].score == statistics.mean(some(0.5, 1.0), bounds=(0.0, 1.0))
    assert table.standings[0].score.method == "mean, Gaffke 95%"


def test_two_methods_of_one_name_are_named_apart():
    found = [entry("same", [1.0] * 20), replace(entry("same", [0.5] * 20), digest="f" * 64)]

    (table,) = tables(found)

    assert list(ranks(table)) == [f"same ({found[0].id})", "same (ffffffffffff)"]


@pytest.mark.parametrize(
    ("curriculum", "expected"),
    [
        (SMALL.variants[0].curriculum, {"optimum": 1.0, ONE: None, "random policy": 1 / 243, FRAMES: 651.0}),
        (SMALL.variants[3].curriculum, {ONE: 1 / 4, MEMORYLESS: 1.0}),
        (replace(curricula.load("ct8_md"), protocol=Protocol("hidden")), {ONE: 4 / 8}),  # 11, 111, 1111, 11111
        (replace(curricula.load("ct28"), protocol=Protocol("hidden")), {ONE: 1.0}),  # images say which family
        (curricula.load("su_b1_changing_goals"), {SEARCH: 5 / 8, MEMORYLESS: None, ONE: None}),
        (curricula.load("su_b1_changing_goals", depth=3), {SEARCH: 9 / 16, "optimum": 1.0}),
        (curricula.load("co_hard"), {MEMORYLESS: 1 / 4, OPEN_LOOP: 0.1**2, SEARCH: None}),
    ],
)
def test_ceilings_are_those_by_hand(curriculum, expected):
    found = ceilings_of(curriculum)

    assert {key: found[key] for key in expected} == {
        key: value if value is None else pytest.approx(value) for key, value in expected.items()
    }


def test_ceilings_have_four_digits_and_numbers_of_frames_whole_ones():
    assert list(map(write_ceiling, (1.0, 0.00411522, 99.96, 651.4, 12_345.0, 9.9e9))) == [
        *("1", "0.004115", "99.96", "651", "12,345", "9.9e+09")
    ]


@pytest.fixture
def made() -> list[BoardTable]:
    """Two tables, with a name that means something in every format."""
    best = entry("<b>A_1</b> & *co* | $x$", [1.0] * 20, level="rerun", bytes_per_task=4096)
    other = entry("other", [0.5] * 20, variant=1, level="held_out", verification=(False,))
    return tables([best, entry("PPO", some(0.0, 1.0)), other])


def test_the_cells_of_a_line_are_those_of_its_submission(made):
    first, second, last = ([*formats.columns(line)] for table in made for line in table.standings)

    assert [cell.head for cell in first][:3] == ["rank", "method", "normalised performance"]
    assert [f"{cell.shown} {cell.interval}".strip() for cell in second] == [
        *("2", "PPO", *["0.50 [0.27, 0.73]"] * 2, "0.50 [0.18, 0.73]"),
        *("20", "0", "1,234", "409,600", "0.25", "submitted"),
    ]
    assert (first[0].shown, first[-1].shown, last[-1].shown) == ("1", "rerun", "held out, scores")


def test_csv_holds_the_numbers_of_each_seed(made):
    best, other, last = csv.DictReader(formats.entries_csv(made).splitlines())

    assert (best["track"], best["given"], best["score"]) == (
        "small-v1",
        "task ids, boundaries",
        "normalised_performance",
    )
    assert (best["best_rank"], other["worst_rank"], best["level"], other["value"]) == ("1", "2", "rerun", "0.5")
    assert last["level"] == "held out, scores"
    scores = list(csv.DictReader(formats.scores_csv(made).splitlines()))
    assert [*scores[0]] == ["submission", "seed", "metric", "value"] and len(scores) == 3 * 3 * 20
    of_other = [row for row in scores[60:120] if row["metric"] == "normalised_performance"]
    assert [(int(row["seed"]), float(row["value"])) for row in of_other] == [*enumerate(some(0.0, 1.0))]


def test_the_page_needs_no_network_and_shows_names_as_text(made):
    page = html(made)

    digest = re.search(r"script-src 'sha256-([\w+/=]+)'", page)[1]
    script = re.search(r"<script>(.*)</script>", page, re.DOTALL)[1]
    assert digest == base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert "default-src 'none'" in page and "&lt;b&gt;A_1&lt;/b&gt;" in page and "<b>A_1" not in page
    assert re.findall(r'(?:src|href)="(?!#)([^"]*)"', page) == ["https://example.org/repository"] * 3
    assert page.count('<tr data-level="') == 3 and '<tr data-level="3" data-bytes="4096" data-steps="409600">' in page
    assert 'data-given="task ids at boundaries"' in page
