"""docs/explanation/statistics.md: intervals cover as its tables say."""

from __future__ import annotations

import math
import re
from zlib import crc32

import numpy as np
import pytest
from helpers.paths import CHECKOUT

from ctgraph_rl.report import statistics
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.tasks.kinds.gym_task import GymTask

pytest.importorskip("scipy")
PAGE = CHECKOUT / "docs" / "explanation" / "statistics.md"


SEEDS = (3, 5, 10, 20)
RATE = 0.9


def cells(*names: str) -> list[str]:
    """The numbers of the line that starts with the names."""
    (line,) = [line for line in PAGE.read_text().splitlines() if line.startswith(f"| {' | '.join(names)} |")]
    return [cell.strip() for cell in line.split("|")[len(names) + 1 : -1]]


def covered(cell: str) -> float:
    return float(cell.split(" %")[0])


def gaffke(values: list[float]) -> tuple[float, float]:
    """The rule of the package for values in [0, 1]."""
    found = statistics.mean(values, bounds=(0.0, 1.0))
    return found.low, found.high


def student(values: list[float]) -> tuple[float, float]:
    """Student's interval; of no width where all seeds agree."""
    found = statistics.mean(values)
    return (found.value, found.value) if found.low is None else (found.low, found.high)


def draws_of(*names: object) -> np.random.Generator:
    """The draws of a cell."""
    return np.random.default_rng(crc32(" ".join(map(str, names)).encode()))


def shown(covers: float, other: str) -> str:
    return f"{covers:.1%}, {other}".replace("%", " %")


@pytest.mark.parametrize(("name", "rule"), [("**Gaffke**", gaffke), ("Student t", student)])
def test_two_outcomes_are_covered_as_exact_sums_say(name, rule):
    expected = []
    for n in SEEDS:
        covers = width = 0.0
        for ones in range(n + 1):
            chance = math.comb(n, ones) * RATE**ones * (1 - RATE) ** (n - ones)
            low, high = rule([1.0] * ones + [0.0] * (n - ones))
            covers += chance * (low <= RATE <= high)
            width += chance * (high - low)
        expected.append(shown(covers, f"{width:.2f}"))

    assert cells("two-valued", name) == expected


@pytest.mark.parametrize(
    ("name", "rule", "shape", "n"),
    [
        pytest.param("**Gaffke**", gaffke, "bounded", 3, marks=pytest.mark.slow),
        pytest.param("**Gaffke**", gaffke, "skewed", 5, marks=pytest.mark.slow),
        ("Student t", student, "skewed", 5),
    ],
)
def test_simulated_cells_are_computed_again(name, rule, shape, n):
    uniform = draws_of(shape, n).random((2000, n))
    samples, centre = (uniform, 0.5) if shape == "bounded" else (1 - uniform**8, 1 - 1 / 9)
    ends = np.array([rule(sample) for sample in samples.tolist()])

    covers = (ends[:, 0] <= centre + 1e-12) & (centre - 1e-12 <= ends[:, 1])
    width = (ends[:, 1] - ends[:, 0]).mean()
    assert cells(shape, name)[SEEDS.index(n)] == shown(covers.mean(), f"{width:.2f}")


@pytest.mark.slow
def test_widened_bounds_cover_noisy_returns_and_bounds_of_a_mean_do_not():
    noise = 0.01
    samples = 1 + noise * draws_of("equal, mean 1", noise, 20).standard_normal((50, 20))

    for values, bounds, share in ((samples, Bounds(0, 1).widened(noise), 1.0), (samples.clip(0, 1), Bounds(0, 1), 0.0)):
        found = [statistics.mean(sample, bounds=bounds) for sample in values.tolist()]
        assert np.mean([each.low <= 1 <= each.high for each in found]) == share
    assert cells("equal, mean 1", "0.01")[3].startswith("100.0 %")


def test_intervals_cover_noisy_returns_from_five_seeds_on():
    kinds = ("equal, mean 1", "solve at 0.9", "solve at 0.5")
    shares = [covered(cell) for kind in kinds for noise in ("0.01", "0.5") for cell in cells(kind, noise)]

    assert len(shares) == 3 * 2 * 5
    assert min(shares) >= 94


def test_times_are_computed_again():
    expected = []
    for n in (3, 5):
        rng = draws_of("times", n)
        times = np.where(rng.random((2000, n)) < 1 / 3, np.inf, rng.exponential(size=(2000, n)))
        found = [statistics.median_time(sample) for sample in times.tolist()]
        covers = np.mean([each.low <= math.log(4) <= each.high for each in found])
        expected.append(shown(covers, f"{np.mean([each.high < math.inf for each in found]):.0%}"))

    assert cells("median of times, of which a third is never reached", "covers, has an end")[:2] == expected


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


def test_the_table_of_seeds_is_that_of_the_function():
    text = PAGE.read_text(encoding="utf-8")
    found = re.findall(r"^\| (0\.\d) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \|$", text, re.MULTILINE)

    assert [row[0] for row in found] == ["0.1", "0.3", "0.5"]
    for std, *shown in found:
        assert [statistics.pairs_needed(gap, float(std)) for gap in (0.1, 0.2, 0.3, 0.5)] == list(map(int, shown))
    assert "`ctgraph_rl.report.statistics.pairs_needed(0.3, std=0.5)` returns 24" in text


def test_p_can_be_small_while_the_interval_holds_0():
    differences = [0.2] * 6
    found = statistics.compare(differences, [0.0] * 6, bounds=(-1, 1))

    assert found.p_value <= 0.05 and found.difference.low < 0


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
