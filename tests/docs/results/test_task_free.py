"""The section on task-free curricula of docs/results/no_labels.md: what it says holds for the raw results beside it."""

from __future__ import annotations

import csv
from collections import defaultdict

from helpers.paths import CHECKOUT

import curricula

FOLDER = CHECKOUT / "docs" / "results"
PAGE = (FOLDER / "no_labels.md").read_text(encoding="utf-8")
SECTION = " ".join(PAGE.split("## Task-free curricula")[1].split("\n## ")[0].split())
README = (CHECKOUT / "README.md").read_text(encoding="utf-8")
NAMES = {"oracle": "oracle", "adwin": "ADWIN", "": "fine-tuning"}

Lines = list[dict[str, str]]


def runs() -> dict[tuple[str, str], Lines]:
    found = defaultdict(list)
    with open(FOLDER / "task_free.csv", newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            found[line["curriculum"], line["detector"]].append(line)
    return found


RUNS = runs()


def goals(line: dict[str, str]) -> int:
    """The goals with a return of 1 at the end."""
    return [float(each) for each in line["final_returns"].split()].count(1)


def delays(lines: Lines) -> list[str]:
    return [each for line in lines for each in line["delays"].split()]


def test_each_row_has_the_means_over_its_seeds():
    for (curriculum, detector), lines in RUNS.items():
        rows = PAGE.split(f"| `{curriculum}` | {NAMES[detector]} | ")
        cells = rows[1].split("\n")[0].split(" | ")
        values = {key: [float(line[key]) for line in lines] for key in ("average_performance", "online_return")}
        means = [sum(each) / len(each) for each in values.values()]

        assert sorted(line["seed"] for line in lines) == ["0", "1", "2"] and cells[0] == "3"
        assert [cell.split(" [")[0] for cell in cells[1:3]] == [f"{mean:.2f}" for mean in means]
        assert {int(line["frames"]) for line in lines} == {curricula.load(curriculum).num_frames}
        if detector:
            found = [each != "-" for each in delays(lines)]
            frames = sum(float(line["frames"]) for line in lines)
            lost = [sum(float(line[key]) for line in lines) for key in ("frames_not_learned", "frames_rolled_back")]
            assert cells[3] == (f"{sum(found)} of {len(found)}" if found else "no point of change")
            assert cells[5] == "; ".join(f"{100 * each / frames:.0f} %" for each in lost) + " |"


def test_what_is_said_of_gradual_changes_holds():
    adwin, none = (RUNS["task_free_gradual", detector] for detector in ("adwin", ""))

    assert [goals(line) for line in adwin] == [4, 4, 4] and "with all four goals in each seed. Fine" in SECTION
    assert sorted(line["final_returns"] for line in none) == ["0 0 0 0", "0 0 0 1", "0 0 0 1"]
    assert "Fine-tuning ends with the last one in two seeds and with none in the third." in SECTION
    assert {line["delays"] for line in adwin} == {""} and "| no point of change | undefined |" in SECTION


def test_what_is_said_of_recurring_tasks_holds():
    oracle, adwin, none = (RUNS["task_free_recurring", detector] for detector in ("oracle", "adwin", ""))

    assert [goals(line) for line in oracle] == [4, 4, 4] and [goals(line) for line in adwin] == [3, 3, 3]
    assert "oracle's labels end with all four goals in each seed, and with ADWIN's labels with three." in SECTION
    assert sorted(map(goals, none)) == [0, 1, 1] and "ends with one goal in two seeds and with none in the" in SECTION
    assert sorted(4 * float(line["labels_per_task"]) for line in adwin) == [5, 6, 6]
    assert "ADWIN opens five or six labels" in SECTION


def test_what_is_said_of_abrupt_changes_holds():
    oracle, adwin, none = (RUNS["task_free_abrupt", detector] for detector in ("oracle", "adwin", ""))

    assert [goals(line) for line in oracle] == [4, 4, 4] and "a return of 1 on all four goals in each seed" in SECTION
    assert sorted(map(goals, adwin)) == [2, 3, 3] and "three goals in two seeds and with two in the third" in SECTION
    assert "end with two or three goals of four. With the oracle's labels they end with all" in " ".join(PAGE.split())
    assert (
        "With 102,400 frames and ADWIN it keeps two or three of four goals on `task_free_abrupt`, three on " in README
    )
    assert [line["final_returns"] for line in none] == ["0 0 0 1"] * 3
    assert "Fine-tuning ends with the last goal in each seed" in SECTION
    assert {float(line["labels_per_task"]) for line in adwin} == {0.75} and "three labels for four goals" in SECTION


def test_adwin_has_no_false_alarm_where_tasks_change_at_a_point():
    lines = [*RUNS["task_free_abrupt", "adwin"], *RUNS["task_free_recurring", "adwin"]]

    assert {float(line["false_alarms"]) for line in lines} == {0}
    assert (
        "On `task_free_abrupt` and `task_free_recurring` ADWIN has no false alarm, so it finds no change by chance."
        in SECTION
    )
