"""docs/results/claims.md: its rows are those of the raw results, and opposite ones have other verdicts."""

from __future__ import annotations

import re
from collections import Counter
from contextlib import suppress

import numpy as np
import pytest
from helpers.opposite import FOLDER, Table, empty, mirror, shuffle, write_changed
from studies import claims, raw
from studies.claims import SENTENCES
from studies.verdicts import AGREES, DISAGREES, UNKNOWN

from ctgraph_rl.tasks.configurations import CONFIGURATIONS

PAGE = (FOLDER / "claims.md").read_text(encoding="utf-8")
TEXT = " ".join(PAGE.split())

TIMES = ("frames_1", "frames_2", "frames_3", "frames_4")
TABLES = [
    Table(
        "claim_runs",
        ("success", "end_rate", "tasks_learned", "forgetting", *TIMES),
        ("reward_fn", "reward_std", "within", "num_wait_images", "cell", "method"),
    ),
    Table("memory_cells", ("greedy_return", "frames_to_90"), ("num_wait_images",)),
    Table("methods", ("1", "2", "3", "4"), ("method",)),
]


@pytest.fixture(scope="module")
def rows():
    return claims.rows()


PARTS = (
    claims.large_sets,
    claims.gradients,
    claims.noise,
    claims.negative_samples,
    claims.advantages,
    claims.stochastic_observations,
    claims.similarity,
    claims.waiting,
)


def verdicts():
    """The verdict of each test; none of a part that refuses its runs, such as pairs of other seeds."""
    found = {}
    for part in PARTS:
        with suppress(ValueError):
            found |= {row.test: row.verdict for row in part()}
    return found


def test_the_page_is_that_of_its_template_and_raw_results():
    assert claims.page() == PAGE


def test_each_of_nine_sentences_has_tests_whose_verdicts_are_counted(rows):
    counts = Counter(row.verdict for row in rows)
    words = f"{counts[AGREES]} agree, {counts[DISAGREES]} disagree, and {counts[UNKNOWN]} are undecided"

    assert list(dict.fromkeys(row.sentence for row in rows)) == list(SENTENCES) and len(SENTENCES) == 9
    assert f"{len(rows)} tests of nine sentences of the paper about learning: {words}." in TEXT
    assert all(re.search(rf"^\d\. {re.escape(place)}: ", PAGE, re.MULTILINE) for place, _ in SENTENCES.values())


def test_pairs_of_times_are_counted_from_the_raw_results(rows):
    """Counted another way: times that were not reached are one billion."""
    graphs = ("agent", "wait_prob", "unique_decisions", "seed")
    times = {}
    for line in raw.read("memory_cells"):
        given = (line["guide_frames"], line["read_noise"]) == ("204800", "0")
        if given and line["agent"] in claims.RECURRENT and line["wait_prob"] != "0":
            key = tuple(line[name] for name in graphs)
            times.setdefault(key, {})[line["num_wait_images"]] = float(line["frames_to_90"] or 1e9)
    signs = [np.sign(of["500"] - of["100"]) for of in times.values()]
    [row] = [row for row in rows if row.test.startswith("500 wait images")]

    assert row.number == f"later in {signs.count(1)} of {len(signs)} pairs, earlier in {signs.count(-1)}"
    assert row.effect.estimate.value == pytest.approx(np.mean(signs))
    assert len(row.effect.values) == len({key[0::3] for key in times}) == 30  # agents and seeds


@pytest.mark.parametrize("method", ["finetune", "clear", "mask_lc"])
def test_times_of_later_tasks_are_counted_from_the_raw_results(method, rows):
    lines = [line for line in raw.read("claim_runs") if line["curriculum"] == "shared_waiting"]
    times = {
        (line["method"], line["seed"], task): float(line[f"frames_{task}"] or 1e9)
        for line in lines
        for task in (2, 3, 4)
    }
    signs = [np.sign(value - times[method, *key]) for (name, *key), value in times.items() if name == "scratch"]
    [row] = [row for row in rows if f"against `{method}`" in row.test and row.sentence == "waiting"]

    assert row.effect.estimate.value == pytest.approx(np.mean(signs)) and len(signs) == 24
    assert row.number == f"`scratch` is later in {signs.count(1)} of 24 pairs, earlier in {signs.count(-1)}"


@pytest.mark.parametrize(
    ("test", "column", "with_it", "without", "sign"),
    [
        ("PPO, depth 3", "success", {"depth": "3", "reward_std": "1"}, {"depth": "3", "reward_std": "0"}, -1),
        ("deviation 30", "end_rate", {"reward_std": "30"}, {"reward_std": "0", "goal_reward": "1"}, -1),
        ("sets of 50,", "tasks_learned", {"within": "0.1"}, {"within": "0.3"}, 1 / 4),
    ],
)
def test_an_effect_is_the_mean_difference_of_the_raw_results(test, column, with_it, without, sign, rows):
    [row] = [row for row in rows if test in row.test]
    names = {"noise": "stochastic_rewards", "negative": "negative_rewards", "stochastic": "stochastic_grouped"}
    of = [
        line
        for line in raw.read("claim_runs")
        if line["curriculum"] == names[row.sentence] and line["group_size"] in ("", "50")
    ]
    means = [
        np.mean([float(line[column]) for line in of if all(line[key] == each[key] for key in each)])
        for each in (with_it, without)
    ]

    assert row.effect.estimate.value == pytest.approx(sign * (means[0] - means[1]))


def test_every_verdict_changes_where_the_raw_results_say_the_opposite(rows, tmp_path, monkeypatch):
    decided = {row.test for row in rows if row.verdict != UNKNOWN and row.effect is not None}
    changed = set()
    for change in (mirror, shuffle):
        write_changed(TABLES, change, tmp_path / change.__name__)
        monkeypatch.setattr(raw, "HERE", tmp_path / change.__name__)
        found = verdicts()
        changed |= {row.test for row in rows if found.get(row.test) != row.verdict}

    assert decided - changed == set()


def test_verdicts_that_stand_after_holm_are_marked(rows):
    """Sorted by how small an error their intervals allow, the k-th of 23 stands at 0.05 / (24 - k)."""
    tested = [row for row in rows if row.effect is not None]
    decided = [row for row in tested if row.verdict != UNKNOWN]

    def holds(row, number):
        return row.effect.verdict_at(0.05 / number) == row.verdict

    marked = [row for row in rows if row.holm]
    assert len(tested) == 23 and {row.test for row in decided if holds(row, 23)} <= {row.test for row in marked}
    assert all(holds(row, 23 - len(marked) + 1) for row in marked)
    assert not any(holds(row, 23 - len(marked)) for row in decided if not row.holm)
    assert PAGE.count("** (Holm) |") == len(marked) == 8
    assert f"over all 23 rows with an interval: {len(marked)}." in TEXT


def test_a_row_whose_interval_is_above_0_agrees_however_small_its_effect(rows):
    [row] = [row for row in rows if row.test.startswith("500 wait images")]

    assert 0 < row.effect.estimate.low < row.effect.estimate.high < row.effect.counts
    assert row.verdict == AGREES and not row.holm


def test_no_verdict_is_given_on_empty_results(tmp_path, monkeypatch):
    write_changed(TABLES, empty, tmp_path)
    monkeypatch.setattr(raw, "HERE", tmp_path)

    for part in (claims.large_sets, claims.advantages, claims.waiting):
        assert {row.verdict for row in part()} == {UNKNOWN}
    for part in (claims.gradients, claims.noise, claims.negative_samples, claims.stochastic_observations):
        with pytest.raises(ValueError, match="could not convert string to float"):
            part()


def test_the_best_fixed_sequence_is_optimal_without_waits_and_reaches_the_goal_with_p_to_the_depth_else(rows):
    [row] = [row for row in rows if row.sentence == "fixed"]

    for name, shown in re.findall(r"(CT-\w+-\w+) ([\d.]+)", row.number):
        graph = CONFIGURATIONS[name]().graph
        assert float(shown) == (1 - graph.wait_prob) ** graph.depth
    assert len(re.findall("CT-", row.number)) == len(CONFIGURATIONS) and row.verdict == AGREES


def test_settings_were_chosen_on_seeds_that_are_not_compared():
    seeds = {cell: {int(line["seed"]) for line in claims.tested(cell)} for cell in claims.MEMORIES}
    search = [line for line in raw.read("claim_runs") if line["curriculum"] == "co_hard" and int(line["seed"]) > 99]

    assert all(max(of, default=0) < 100 for of in seeds.values())
    assert all(100 <= int(line["seed"]) < 120 for line in search)
