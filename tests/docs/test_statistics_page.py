"""docs/explanation/statistics.md: its tables are those of the script, which covers as the page says."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.paths import CHECKOUT

from ctgraph_rl.report import statistics
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.tasks.kinds.gym_task import GymTask

pytest.importorskip("scipy")
PAGE = CHECKOUT / "docs" / "explanation" / "statistics.md"


@pytest.fixture(scope="module")
def coverage():
    from studies import coverage

    return coverage


def cells(*names: str) -> list[str]:
    """The numbers of the line that starts with the names."""
    (line,) = [line for line in PAGE.read_text().splitlines() if line.startswith(f"| {' | '.join(names)} |")]
    return [cell.strip() for cell in line.split("|")[len(names) + 1 : -1]]


def covered(cell: str) -> float:
    return float(cell.split(" %")[0])


def test_the_page_is_its_template_with_tables(coverage):
    template = (CHECKOUT / "docs" / "results" / "templates" / "statistics.md").read_text(encoding="utf-8")
    written = template.replace("$draws", f"{coverage.DRAWS:,}").replace("$noisy_draws", f"{coverage.NOISY_DRAWS:,}")

    blocks = PAGE.read_text(encoding="utf-8").split("\n\n")
    tables = {"| returns | interval": "$of_means", "| seeds | noise": "$of_noise", "| number |  |": "$of_others"}
    named = [next((name for head, name in tables.items() if block.startswith(head)), block) for block in blocks]
    assert "\n\n".join(named) == written


@pytest.mark.parametrize("rule", ["**Gaffke**", "Student t"])
def test_two_outcomes_are_covered_as_exact_sums_say(coverage, rule):
    assert cells("two-valued", rule) == [coverage.cell(rule, "two-valued", n) for n in coverage.SEEDS]


@pytest.mark.parametrize(
    ("rule", "shape", "n"),
    [
        *(pytest.param("**Gaffke**", *of, marks=pytest.mark.slow) for of in (("bounded", 3), ("skewed", 5))),
        pytest.param("BCa bootstrap", "skewed", 10, marks=pytest.mark.slow),
        ("Student t", "skewed", 5),
    ],
)
def test_simulated_cells_are_computed_again(coverage, rule, shape, n):
    assert cells(shape, rule)[coverage.SEEDS.index(n)] == coverage.cell(rule, shape, n)


@pytest.mark.parametrize(
    ("kind", "noise", "n"),
    [
        ("equal, mean 1", 0.01, 3),
        *(pytest.param("equal, mean 1", noise, 5, marks=pytest.mark.slow) for noise in (0.1, 0.5)),
        *(pytest.param("solve at 0.5", 0.01, n, marks=pytest.mark.slow) for n in (20, 50)),
        pytest.param("solve at 0.98", 0.5, 50, marks=pytest.mark.slow),
    ],
)
def test_cells_of_noise_are_computed_again(coverage, kind, noise, n):
    assert cells(kind, f"{noise:g}")[coverage.MORE_SEEDS.index(n)] == coverage.noisy_cell(kind, noise, n)


def test_intervals_cover_noisy_returns_from_five_seeds_on(coverage):
    shares = [
        covered(cell) for kind in coverage.KINDS for noise in coverage.NOISES for cell in cells(kind, f"{noise:g}")
    ]

    assert len(shares) == 4 * 3 * 5 and (min(coverage.NOISES), max(coverage.NOISES)) == (0.01, 0.5)
    assert min(shares) >= 94


def test_bounds_of_a_mean_do_not_cover_noisy_returns_where_it_is_at_one(coverage):
    samples, centre = coverage.noisy_returns("equal, mean 1", 0.01, n=20, draws=50)

    assert not coverage.are_covered(np.clip(samples, 0, 1), centre, Bounds(0.0, 1.0)).any()
    assert coverage.are_covered(samples, centre, Bounds(0.0, 1.0).widened(0.01)).all()


@pytest.mark.parametrize("noise", [0.01, 0.5])
@pytest.mark.parametrize("kind", ["equal, mean 1", "solve at 0.5", "solve at 0.9"])
def test_what_is_counted_is_whether_the_intervals_of_the_package_hold_the_mean(coverage, kind, noise):
    samples, _ = coverage.noisy_returns(kind, noise, n=5, draws=12)
    samples[0, 0] = 20.0  # outside of all bounds, so that Student's interval counts
    bounds = Bounds(0.0, 1.0).widened(noise)
    found = [statistics.mean(sample, bounds=bounds) for sample in samples.tolist()]

    for place, end in ((0, 1e-6), (1, -1e-6)):
        for centre in [(each.low, each.high)[place] + shift for each in found[:4] for shift in (end, -end)]:
            expected = [each.low <= centre <= each.high for each in found]
            assert coverage.are_covered(samples, centre, bounds).tolist() == expected


def test_times_are_computed_again(coverage):
    name = "median of times, of which a third is never reached"
    assert cells(name, "covers, has an end")[:2] == [coverage.of_times(n) for n in (3, 5)]


@pytest.mark.slow
def test_other_numbers_are_computed_again(coverage):
    assert cells("interquartile mean of three tasks", "covers, width")[2] == coverage.of_middle_means(10)
    for how, name in (
        ("weighted", "**forward transfer, both sides weighted**"),
        ("drawn again", "forward transfer, both sides drawn again"),
    ):
        assert cells(name, "covers, no end below")[1] == coverage.of_transfer(how, 5)


def test_each_table_has_the_lines_and_columns_of_its_rules(coverage, monkeypatch):
    monkeypatch.setattr(coverage, "cell", lambda rule, shape, n: cells(shape, rule)[coverage.SEEDS.index(n)])
    of_means = [block for block in PAGE.read_text(encoding="utf-8").split("\n\n") if block.startswith("| returns")]

    assert coverage.of_means() == of_means[0]


def test_the_rules_of_the_package_cover_and_students_does_not():
    own = [cells(shape, "**Gaffke**") for shape in ("bounded", "two-valued", "skewed")]
    own += [
        cells("median of times, of which a third is never reached", "covers, has an end"),
        cells("interquartile mean of three tasks", "covers, width")[2:],
        cells("**forward transfer, both sides weighted**", "covers, no end below"),
    ]

    assert min(covered(cell) for row in own for cell in row) >= 95
    assert covered(cells("two-valued", "Student t")[1]) == 40.9
    assert covered(cells("skewed", "Student t")[1]) < 80


def test_gaffkes_is_the_only_one_that_covers_everywhere():
    least = {
        rule: min(covered(cell) for shape in ("bounded", "two-valued", "skewed") for cell in cells(shape, rule))
        for rule in ("**Gaffke**", "Student t", "BCa bootstrap")
    }

    assert [rule for rule, share in least.items() if share >= 95] == ["**Gaffke**"]


def test_what_the_text_says_of_five_seeds_is_so():
    text = PAGE.read_text()

    assert f"{1 - 0.9**5 - 0.1**5:.0%}".replace("%", " %") == "41 %" and "covers in 41 %" in text
    assert f"{0.9**5:.0%}" == "59%" and "in 59 % of cases" in text
    assert str(statistics.mean([0.0] * 5, bounds=(-1, 1))).startswith("0.00 [-0.52, 0.52]") and "[-0.52, 0.52]" in text
    assert statistics.compare([1.0] * 5, [0.0] * 5).p_value == 2 / 2**5
    assert statistics.pairs_needed(1.0, 0.0) == 6 and "Six can reach 0.03" in text
    assert statistics.pairs_needed(1.0, 0.0, comparisons=10) == 9 and "Holm's correction need nine" in text


def test_what_the_page_reads_aloud_is_a_number_of_the_results_and_what_more_seeds_give_is_so():
    text = PAGE.read_text(encoding="utf-8")

    adaptation = (CHECKOUT / "docs" / "results" / "adaptation.md").read_text(encoding="utf-8")
    assert "PEARL is at the goal in 0.88 [0.42, 0.97] (5 seeds) of the episodes" in adaptation
    assert "`0.88 [0.42, 0.97]` is a mean" in text and "may be anything from 42 % to 97 %" in text
    for n, low in ((5, "0.48"), (20, "0.83")):
        assert f"{statistics.mean([1.0] * n, bounds=(0, 1)).low:.2f}" == low and f"[{low}, 1]" in text


def test_what_the_text_says_of_the_slippery_lake_is_so():
    lake = GymTask("FrozenLake-v1")

    assert f"{lake.optimal_value(1.0):.2f}" == "0.74" and "an optimum of 0.74" in PAGE.read_text()
    assert lake.return_bounds == (0, 1)
