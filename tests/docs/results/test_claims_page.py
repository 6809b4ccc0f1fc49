"""docs/results/claims.md: its numbers and verdicts are those of the raw results, counted here another way."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest
from helpers.paths import CHECKOUT

from ctgraph_rl.tasks.configurations import CONFIGURATIONS as TASKS

FOLDER = CHECKOUT / "docs" / "results"
PAGE = (FOLDER / "claims.md").read_text(encoding="utf-8")
TEXT = " ".join(PAGE.split())
RECURRENT = ("lstm_ppo", *(f"lstm_ppo-{cell}" for cell in ("gru", "min_gru", "amrl_max", "amrl_avg", "backpropamine")))


def returns() -> dict[tuple[str, ...], float]:
    """Greedy returns with first rewards given and without noise, by agent, p, unique decisions, images and seed."""
    keys = ("agent", "wait_prob", "unique_decisions", "num_wait_images", "seed")
    with open(FOLDER / "memory_cells.csv", newline="", encoding="utf-8") as file:
        return {
            tuple(line[key] for key in keys): float(line["greedy_return"])
            for line in csv.DictReader(file)
            if (line["guide_frames"], line["read_noise"]) == ("204800", "0")
        }


def rows() -> list[list[str]]:
    """Cells of the table, without its head."""
    lines = [line for line in PAGE.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[1:]]


def test_the_page_is_that_of_its_template_and_raw_results():
    from studies import claims

    assert claims.page() == PAGE


def test_each_of_nine_sentences_has_a_place_a_test_and_a_verdict_and_the_verdicts_are_counted():
    verdicts = [row[-1].strip("*") for row in rows()]
    counts = [f"{name} {verdicts.count(name)}" for name in ("agrees", "not found")]

    assert len(verdicts) == 9 and all(all(row) and len(row) == 5 for row in rows())
    assert f"Verdicts: {', '.join(counts)}." in TEXT and sum(int(each.split()[-1]) for each in counts) == 9


def test_the_sentence_on_large_sets_has_the_differences_of_the_raw_results():
    found = returns()
    few = {
        key: value
        for key, value in found.items()
        if key[0] in RECURRENT and key[3] == "100" and key[1] in ("0.5", "0.9")
    }
    many = {key: found[*key[:3], "500", key[4]] for key in few}
    difference = np.mean([many[key] - few[key] for key in few])
    solved = {key: (many[key] >= 0.9) - (few[key] >= 0.9) for key in few}
    changes = {}
    for key, change in solved.items():
        changes[key[:3]] = changes.get(key[:3], 0) + int(change)

    number, verdict = rows()[0][3:]
    shown, low, high = map(float, re.search(r"difference (\S+) \[(\S+), (\S+)\]", number).groups())
    assert shown == pytest.approx(difference, abs=0.0051) and low < difference < high
    totals = [sum(value >= 0.9 for value in each.values()) for each in (many, few)]
    assert f"{totals[0]} of {len(few)} runs solved with 500, {totals[1]} with 100" in number
    assert (verdict == "**agrees**") == (high < 0)
    lost, won = (sum(sign * change for change in changes.values() if sign * change > 0) for sign in (-1, 1))
    assert f"agents lose {lost} solved seeds on some graphs and win {won} on others." in TEXT
    assert f"No agent loses more than {-min(changes.values())} of five seeds on a graph." in TEXT


def test_the_sentence_on_attention_and_associative_learning_has_the_returns_of_the_raw_results():
    shared = {key: value for key, value in returns().items() if key[2] == "False"}
    of = {name: [value for key, value in shared.items() if key[0] == name] for name in {key[0] for key in shared}}
    number, verdict = rows()[4][3:]

    rivals = {"attention": "lstm_ppo-attention", "MOHQA": "mohqa", "Backpropamine": "lstm_ppo-backpropamine"}
    for name, agent in rivals.items():
        shown, low = re.search(rf"{name} (\S+) \[(\S+), ", number).groups()
        assert float(shown) == pytest.approx(np.mean(of[agent]) - np.mean(of["lstm_ppo"]), abs=0.0051)
        assert float(low) < 0 and verdict == "**not found**"
        assert f"{name} {sum(value >= 0.9 for value in of[agent])} of {len(of[agent])}" in TEXT
    assert f"Solved runs: LSTM {sum(value >= 0.9 for value in of['lstm_ppo'])} of 25" in TEXT


def test_the_best_fixed_sequence_is_optimal_without_waits_and_reaches_the_goal_with_p_to_the_depth_else():
    number, verdict = rows()[6][3:]

    for name, shown in re.findall(r"(CT-\w+-\w+) ([\d.]+)", number):
        graph = TASKS[name]().graph
        assert float(shown) == (1 - graph.wait_prob) ** graph.depth
    assert len(re.findall("CT-", number)) == len(TASKS) and verdict == "**agrees**"


def outcomes(curriculum: str, column: str, **conditions: str) -> dict[str, float]:
    """A column of the runs of a curriculum under some conditions, by depth and seed."""
    with open(FOLDER / "claim_runs.csv", newline="", encoding="utf-8") as file:
        lines = [line for line in csv.DictReader(file) if line["curriculum"] == curriculum]
    lines = [line for line in lines if all(line[key] == value for key, value in conditions.items())]
    return {f"{line['depth']} {line['seed']}": float(line[column] or "nan") for line in lines}


COMPARED = [
    (1, "success", ("large_gradient", {"reward_fn": "gradient"}), {"reward_fn": "needle"}, 1),
    (2, "success", ("stochastic_rewards", {"depth": "3", "reward_std": "1"}), {"depth": "3", "reward_std": "0"}, -1),
    (3, "end_rate", ("negative_rewards", {"reward_std": "2"}), {"reward_std": "0"}, -1),
    (5, "tasks_learned", ("stochastic_grouped", {"within": "0.1"}), {"within": "0.3"}, 1),
]
"""Row of the table, what is compared, the runs that the sentence is about, those beside them, and the side it names."""


@pytest.mark.parametrize(
    ("row", "column", "about", "beside", "side"), COMPARED, ids=["large", "noise", "ends", "alike"]
)
def test_a_sentence_on_two_kinds_of_runs_has_their_difference_and_agrees_where_its_interval_does(
    row, column, about, beside, side
):
    curriculum, conditions = about
    first = outcomes(curriculum, column, **conditions)
    second = outcomes(curriculum, column, **beside)
    number, verdict = rows()[row][3:]
    shown, low, high = map(float, re.search(r"difference (\S+) \[(\S+), (\S+)\]", number).groups())

    assert first.keys() == second.keys() and len(first) >= 5
    assert shown == pytest.approx(np.mean([first[run] - second[run] for run in first]), abs=0.0051)
    assert (verdict == "**agrees**") == (low > 0 if side > 0 else high < 0)


def test_the_sentences_on_similarity_have_the_means_of_the_raw_results():
    transfer = outcomes("fo_b1_dissimilar", "forward_transfer")
    forgetting = outcomes("fo_b1_dissimilar", "forgetting")
    number, verdict = rows()[7][3:]
    forgot, forgot_low, moved = map(
        float, re.search(r"forgetting (\S+) \[(\S+), .*?transfer (-?[\d.]+)[; ]", number).groups()
    )
    frames = [outcomes("su_b1_4tasks", f"frames_{task}") for task in (1, 2, 3, 4)]
    gained = np.array([np.mean([each[run] for each in frames[1:]]) - frames[0][run] for run in frames[0]])
    waiting, waiting_verdict = rows()[8][3:]

    assert forgot == pytest.approx(np.mean([*forgetting.values()]), abs=0.0051)
    assert moved == pytest.approx(np.mean([*transfer.values()]), abs=0.0051)
    assert (verdict == "**agrees**") == (forgot_low > 0 and moved <= 0)
    assert float(waiting.split(" [")[0]) == pytest.approx(np.nanmean(gained), abs=0.51)
    assert (waiting_verdict == "**agrees**") == (float(re.search(r", (\S+)\]", waiting).group(1)) < 0)
