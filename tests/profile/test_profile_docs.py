"""docs/reference/profile.md: the numbers of its table are those of the code."""

from __future__ import annotations

import re
from statistics import fmean

import pytest
from helpers.paths import CHECKOUT
from helpers.profiles import LATE, life

import curricula
from ctgraph_rl.profile.floors import best_without_memory
from ctgraph_rl.profile.properties import measure
from curricula.profile import NAMED, PROPERTIES

PAGE = (CHECKOUT / "docs" / "reference" / "profile.md").read_text(encoding="utf-8")
ROWS = {row[0]: row[1:] for row in re.findall(r"\| \d+ \| `(\w+)` \| ([\d,]+) \| .*? \| (.*?) \| ([\d.]+) \|", PAGE)}


def test_the_table_has_each_property_with_its_frames():
    assert list(ROWS) == list(PROPERTIES)
    for name, (frames, *_) in ROWS.items():
        assert int(frames.replace(",", "")) == curricula.load(name).num_frames


def stated(name):
    return float(re.match(r"[\d.]+", ROWS[name][1]).group())


@pytest.mark.parametrize("name", ["profile_observability", "profile_memory"])
def test_floors_of_the_table_are_those_of_the_best_policy_without_memory(name):
    tasks = list(curricula.load(name).tasks)
    floors = []
    for size in PROPERTIES[name].arguments["sizes"]:
        floors.append(min(best_without_memory(task) for task in tasks[:size]))
        del tasks[:size]

    assert stated(name) == pytest.approx(fmean(floors), abs=5e-4)


@pytest.mark.parametrize("name", ["profile_sparsity", "profile_adaptation"])
def test_floors_of_the_table_are_those_of_a_random_search(name):
    run = life(name, lambda *life: LATE)

    assert measure(run, [], PROPERTIES[name]).floors == (pytest.approx(stated(name), abs=5e-4),)


def test_every_life_stands_in_the_table_of_controls():
    lives = set(re.findall(r"^\| `(profile_\w+)` \|", PAGE, re.MULTILINE))

    used = {control for prop in PROPERTIES.values() for control in prop.controls}
    assert lives == used | {name for name, prop in PROPERTIES.items() if prop.controls}
    assert used | {*PROPERTIES} == {*NAMED}
