"""docs/results/plasticity.md: made from the raw results beside it, and what is computed from them, on made-up ones."""

from __future__ import annotations

import random
import re

import pytest
from helpers.opposite import write
from helpers.paths import CHECKOUT
from studies import raw
from studies.plasticity import page

PAGE = CHECKOUT / "docs" / "results" / "plasticity.md"


def lines_of(condition: str, areas: list[float], rank: list[float] | None = None) -> list[dict[str, object]]:
    """A line for the second block of each seed; all metrics are 0 but the effective rank on fresh images."""
    lines = []
    for seed, area in enumerate(areas):
        for block in (1, 2):
            line = {"curriculum": page.CONFLICT, "condition": condition, "seed": seed, "block": block, "area": area}
            line |= {"reached": area >= 0.5, **dict.fromkeys(page.COLUMNS, 0)}
            lines.append(line | {"rank_effective_fresh": 0 if rank is None else rank[seed]})
    return lines


@pytest.fixture
def results(tmp_path, monkeypatch):
    """Replaces the raw results of runs."""
    monkeypatch.setattr(raw, "HERE", tmp_path)
    return lambda *parts: write(page.NAME, [line for part in parts for line in part], tmp_path)


def test_the_page_is_made_from_the_raw_results():
    assert page.page() == PAGE.read_text(encoding="utf-8")


def test_students_interval_covers_as_nearly_all_areas_are_between_the_bounds():
    areas = []
    for curriculum in page.COMPARED:
        for condition in page.LABELS:
            areas += map(page.area, page.later_blocks(curriculum, condition).values())

    assert len(areas) == 240 and sum(0.05 < area < 0.95 for area in areas) == 228


def test_the_guide_names_the_methods_that_gain():
    gained = {}
    for curriculum in page.COMPARED:
        found = page.nine_against(curriculum, "none")
        gained[curriculum] = {name for name, each in found.items() if each.holm <= 0.05 and each.difference.value > 0}
    guide = (raw.HERE.parent / "how-to/plasticity.md").read_text(encoding="utf-8")
    _, both, one = guide.split("\n\n")[2].splitlines()

    methods = {"fire", *re.findall(r"`(\w+)`", both + one)} - {"fresh_optimiser"}
    assert methods == set.union(*gained.values())
    assert {"fire", *re.findall(r"`(\w+)`", both)} == set.intersection(*gained.values())
    more = page.nine_against(page.STREAM, "fresh")["fire"]
    assert more.holm <= 0.05 and more.difference.low > 0
    assert page.compared(page.CONFLICT, "fire", "fresh").difference.high > 0
    assert page.compared(page.CONFLICT, "fresh_optimiser", "none").difference.low > 0
    assert page.forecast_words(page.CONFLICT).endswith("cannot be said")
    assert max(abs(value) for value, _, _ in page.forecasts(page.STREAM).values()) < 0.1


def test_a_method_is_better_only_after_the_correction_for_nine(results):
    """Of ten pairs all of one sign have p = 1/512, and nine of them 11/512: times nine it is above 0.05."""
    nine = {name: lines_of(name, [0.5] * 10) for name in page.NINE}
    plain = lines_of("none", [0.5] * 10)
    results(plain, *{**nine, "redo": lines_of("redo", [0.6] * 10), "fire": lines_of("fire", [0.4] * 10)}.values())
    assert page.better(page.CONFLICT) == "better: ReDo +0.10; worse: FIRE -0.10"

    results(plain, *{**nine, "redo": lines_of("redo", [0.6] * 9 + [0.4])}.values())
    assert page.better(page.CONFLICT) == "better: none; worse: none"

    results(plain, lines_of("redo", [0.6] * 9 + [0.4]))
    assert page.better(page.CONFLICT) == "better: ReDo +0.08; worse: none"


def test_eight_seeds_are_too_few_for_nine_tests(results):
    results(lines_of("none", [0.5] * 8), lines_of("redo", [0.6] * 8))

    assert page.better(page.CONFLICT) == "cannot be said: 8 seeds"


def test_differences_are_paired_by_seed_and_first_blocks_do_not_count(results):
    own = [0.1, 0.5, 0.9]
    better = lines_of("redo", [area + 0.1 for area in own])
    better[0] |= {"area": 0.0}
    results(lines_of("none", own), better)

    found = page.compared(page.CONFLICT, "redo", "none")

    assert (found.difference.value, found.wins) == (pytest.approx(0.1), 3)


def test_a_metric_forecasts_within_conditions_and_not_across_them(results):
    """Conditions that differ in both say nothing; within them the rank falls as the area grows."""
    draw = random.Random(0)
    areas = [draw.random() / 2 for _ in range(30)]
    results(
        lines_of("none", areas, [1 - area for area in areas]),
        lines_of("redo", [area + 0.5 for area in areas], [9 - area for area in areas]),
    )
    assert page.forecasts(page.CONFLICT)["rank_effective_fresh"][0] == pytest.approx(-1)
    assert page.forecast_words(page.CONFLICT) == "effective rank, fresh images -1.00 [-1.00, -1.00]"

    few = [lines_of(name, areas[:9], [1 - area for area in areas[:9]]) for name in ("none", "redo")]
    results(*few)
    assert page.forecast_words(page.CONFLICT) == "cannot be said with few seeds"

    results(lines_of("none", [0.2] * 30, [1] * 30), lines_of("redo", [0.8] * 30, [2] * 30))
    assert page.forecast_words(page.CONFLICT).endswith(" 0.00 [0.00, 0.00], cannot be said")


def test_a_metric_that_changes_with_the_area_over_a_life_is_no_forecast(results):
    """Both fall from block 2 to 3 in all seeds, and are not related within a block."""
    lines = []
    for seed in range(10):
        for block in (2, 3):
            line = {"curriculum": page.STREAM, "condition": "none", "seed": seed, "block": block, "reached": True}
            lines.append(line | dict.fromkeys(page.COLUMNS, 0) | {"area": 1 - block / 4 + seed / 100})
            lines[-1] |= {"norm_weights": 9 - block + (seed - 4.5) ** 2 / 100}
    results(lines)

    assert page.forecasts(page.STREAM)["norm_weights"][0] == pytest.approx(0, abs=1e-9)


def test_a_loss_grows_by_the_slope_of_fresh_networks_less_that_of_fine_tuning(results):
    lines = []
    for seed in range(6):
        for condition, slope in (("fresh", 0.001), ("none", -0.01 - seed / 1000)):
            for block in range(1, 31):
                line = {"curriculum": page.STREAM, "condition": condition, "seed": seed, "block": block}
                lines.append(line | {"area": 0.0 if block == 1 else 0.5 + slope * block})
    results(lines)

    assert page.growth().difference.value == pytest.approx(0.135)
    assert page.growth().wins == 6


def test_a_cost_is_of_seeds_that_were_distilled_and_the_others_are_counted(results):
    lines = []
    for seed in range(6):
        for network, area in (("fresh", 0.8), ("distilled", 0.7), ("old", 0.4)):
            line = {"curriculum": page.CONFLICT, "network": network, "seed": seed, "blocks_before": 1}
            lines.append(line | {"area": 0.0 if seed == 5 else area, "met": seed < 5 or network != "distilled"})
    write(page.MATCHED, lines, raw.HERE)

    costs = "the start 0.10 (cannot be said), the old weights 0.30 (cannot be said)"
    assert page.matched_words() == f"{costs}; distilling worked in 5 of 6 seeds"
