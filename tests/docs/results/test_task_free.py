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
        cells = SECTION.split(f"| `{curriculum}` | {NAMES[detector]} | ")[1].split(" | ")
        values = {key: [float(line[key]) for line in lines] for key in ("average_performance", "online_return")}
        means = [sum(each) / len(each) for each in values.values()]
        seeds = ["0", "1", "2"] if curriculum == "task_free_abrupt" else ["0"]

        assert sorted(line["seed"] for line in lines) == seeds and cells[0] == f"{len(seeds)}"
        assert [cell.split(" [")[0] for cell in cells[1:3]] == [f"{mean:.2f}" for mean in means]
        assert {int(line["frames"]) for line in lines} == {curricula.load(curriculum).num_frames}


def test_what_is_said_of_gradual_changes_holds():
    [adwin], [none] = (RUNS["task_free_gradual", detector] for detector in ("adwin", ""))

    assert (goals(adwin), none["final_returns"]) == (4, "0 0 0 1")
    assert "labels end with all four goals and fine-tuning ends with the last one" in SECTION
    assert adwin["delays"] == "" and "| no point of change | undefined |" in SECTION


def test_what_is_said_of_recurring_tasks_holds():
    [oracle], [adwin] = (RUNS["task_free_recurring", detector] for detector in ("oracle", "adwin"))

    assert (goals(oracle), goals(adwin)) == (
        4,
        3,
    ) and "labels end with all four goals. With ADWIN's they end" in SECTION
    found = [each != "-" for each in delays([adwin])]
    share = float(adwin["frames_not_learned"]) / float(adwin["frames"])
    assert f"it finds {sum(found)} of {len(found)} changes and opens six labels, and {share:.0%}"[:-1] in SECTION
    assert 4 * float(adwin["labels_per_task"]) == 6


def test_what_is_said_of_abrupt_changes_holds():
    oracle, adwin, none = (RUNS["task_free_abrupt", detector] for detector in ("oracle", "adwin", ""))

    assert [goals(line) for line in oracle] == [4, 4, 4] and "a return of 1 on all four goals in each seed" in SECTION
    assert sorted(map(goals, adwin)) == [2, 3, 3] and "three goals in two seeds and with two in the third" in SECTION
    assert "end with two or three goals of four, and with the oracle's labels with all" in " ".join(PAGE.split())
    assert "keep two or three goals of four (3 seeds; [no labels]" in README
    assert [line["final_returns"] for line in none] == ["0 0 0 1"] * 3
    assert "Fine-tuning ends with the last goal in each seed" in SECTION
    found = [each != "-" for each in delays(adwin)]
    assert f"it finds {sum(found)} of {len(found)} changes, without a false alarm" in SECTION
    assert {float(line["false_alarms"]) for line in adwin} == {0}
    assert {float(line["labels_per_task"]) for line in adwin} == {0.75}
    share = sum(float(line["frames_not_learned"]) for line in adwin) / sum(float(line["frames"]) for line in adwin)
    assert 0.32 < share < 0.38 and "a third of the frames is not learned from" in SECTION
