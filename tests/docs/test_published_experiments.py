"""docs/reference/published_experiments.md: its table has every curriculum that cites a source, and what is missing."""

from __future__ import annotations

import csv
import fnmatch
import re
from typing import NamedTuple

import pytest
import yaml
from helpers.paths import CHECKOUT

import curricula

DOCS = CHECKOUT / "docs"
PAGE = DOCS / "reference" / "published_experiments.md"
RESULTS = DOCS / "results"


class Row(NamedTuple):
    source: str
    tasks: str
    published: str
    curricula: str
    rerun: str
    missing: str


ROWS = [
    Row(*line.strip("|").split(" | ")) for line in PAGE.read_text(encoding="utf-8").splitlines() if line[:2] == "| "
][1:]


def names_in(cell: str) -> list[str]:
    """The curricula of a cell, where ``fo_b1_*`` stands for all whose names begin so."""
    found = []
    for name in re.findall(r"`([\w*]+)`", cell):
        found += fnmatch.filter(curricula.names(), name) if name.endswith("*") else [name]
    return found


def curricula_with_a_study() -> set[str]:
    """The named curricula that raw results of a study are of."""
    found = {"su_b1_4tasks", "co_hard", "nm_uniform_goals", "su_b1_changing_goals"}  # their files do not name them
    for path in RESULTS.glob("*.csv"):
        if path.stem == "every_curriculum":
            continue  # the short runs, which cards show
        with open(path, newline="", encoding="utf-8") as file:
            lines = csv.DictReader(file)
            column = "curriculum" if "curriculum" in (lines.fieldnames or ()) else "configuration"
            found |= {line[column] for line in lines if column in line}
    return found & set(curricula.names())


def test_every_named_curriculum_stands_in_one_row_and_every_name_of_the_table_is_one():
    assert sorted(name for row in ROWS for name in names_in(row.curricula)) == curricula.names()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.source[:30])
def test_a_row_has_the_sources_that_its_curricula_cite(row):
    for name in names_in(row.curricula):
        assert all(part in row.source for part in re.split("[;,] ", curricula.load(name).source)), name


def test_every_part_that_cannot_be_recovered_stands_in_one_row():
    named = [name for row in ROWS for name in re.findall(r"\*\*(.*?)\*\*", row.tasks)]

    page = (PAGE.parent / "curricula.md").read_text(encoding="utf-8").partition("## Missing")[2]
    missing = re.findall(r"^\| \*\*(.*?)\*\*: .+ \| .+ \|$", page, re.MULTILINE)
    assert sorted(named) == sorted(missing) and len(missing) == 11
    assert {*missing}.isdisjoint(curricula.names())


def test_what_the_table_calls_rerun_has_raw_results_and_what_has_is_called_so():
    assert {name for row in ROWS for name in names_in(row.rerun)} == curricula_with_a_study()


def test_rows_say_where_short_runs_are():
    with open(RESULTS / "every_curriculum.csv", newline="", encoding="utf-8") as file:
        short = {line["curriculum"] for line in csv.DictReader(file)}

    assert short <= set(curricula.names()) - curricula_with_a_study()
    has_nothing_else = [row for row in ROWS if not names_in(row.rerun)]
    assert {row.rerun for row in has_nothing_else} <= {"no", "short runs"}
    for row in has_nothing_else:
        assert (row.rerun == "short runs") == bool(short & {*names_in(row.curricula)}), row.source


def test_every_curriculum_without_a_study_is_in_the_experiment_of_short_runs():
    settings = yaml.safe_load((CHECKOUT / "conf" / "experiment" / "every_curriculum.yaml").read_text(encoding="utf-8"))
    variants = settings["hydra"]["sweeper"]["variants"]

    planned = {name for variant in variants for name in variant["curriculum"].split(",")}
    assert planned == set(curricula.names()) - curricula_with_a_study()


def test_every_row_says_what_is_missing_and_links_pages_that_exist():
    for row in ROWS:
        assert all(cell.strip() for cell in row)
        assert all((PAGE.parent / link).exists() for link in re.findall(r"\]\(([\w/.]+)", row.rerun))


@pytest.mark.parametrize("page", ["results/baselines.md", "results/lifelong.md", "reference/curricula.md"])
def test_the_pages_of_results_and_curricula_link_the_table(page):
    links = re.findall(r"\]\(([\w/.-]*)published_experiments\.md\)", (DOCS / page).read_text(encoding="utf-8"))

    assert [((DOCS / page).parent / link).resolve() for link in links] == [PAGE.parent]
