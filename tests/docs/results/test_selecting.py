"""The section on ct28 of docs/results/collectives.md: what it says holds for the raw results beside it."""

from __future__ import annotations

import csv
from collections import defaultdict

import pytest
from helpers.paths import CHECKOUT

FOLDER = CHECKOUT / "docs" / "results"
LINES = (FOLDER / "collectives.md").read_text(encoding="utf-8").split("## Masks that select\n")[1].splitlines()
SECTION = " ".join(" ".join(LINES).split())
NAMES = {"mask_amsc": "AMSC", "mask_lc": "Mask LC", "cka_rl": "CKA-RL", "mask_ri": "Mask RI", "finetune": "PPO"}


def runs() -> dict[str, dict[str, list[dict[str, str]]]]:
    found = defaultdict(lambda: defaultdict(list))
    with open(FOLDER / "selecting.csv", newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            found[line["method"]][line["seed"]].append(line)
    return found


RUNS = runs()


def solved(run: list[dict[str, str]], column: str, *depths: int) -> int:
    return sum(float(line[column]) >= 0.9 for line in run if line["task"].count(".") + 1 in depths)


def test_a_run_is_of_planned_seeds_and_has_each_task_once_the_shallow_ones_first():
    assert set(RUNS) == set(NAMES)
    for seeds in RUNS.values():
        assert set(seeds) <= {"86", "87", "88", "89", "90"}
        for run in seeds.values():
            assert [int(line["block"]) for line in run] == list(range(1, 29))
            assert [line["task"].count(".") + 1 for line in run] == [depth for depth in range(2, 9) for _ in range(4)]
            assert {(line["num_epochs"], line["numbers"]) for line in run} == {("1", "1")}
            for line in run:
                assert line["frames_to_learn"] == "" or 512 <= int(line["frames_to_learn"]) <= 51_200
                assert all(0 <= float(line[name]) <= 1 for name in ("final_return", "evaluated", "kept"))


def test_goals_of_a_family_are_nested():
    run = next(iter(RUNS["mask_ri"].values()))

    for earlier, later in zip(run, run[4:], strict=False):
        goal, images = earlier["task"].split("-")[0], earlier["task"].split("-")[-1]
        assert later["task"].startswith(f"{goal}.") and later["task"].endswith(images)


@pytest.mark.parametrize("method", NAMES)
def test_a_row_has_the_means_over_its_seeds(method):
    [row] = [line.strip("| ").split(" | ")[1:] for line in LINES if line.startswith(f"| {NAMES[method]} |")]
    of, every = RUNS[method].values(), range(2, 9)

    assert int(row[0]) == len(of)
    for cell, column in zip(row[1:3], ("evaluated", "kept"), strict=True):
        assert float(cell.split(" [")[0]) == pytest.approx(
            sum(solved(run, column, *every) for run in of) / len(of), abs=0.005
        )
    for cell, depth in zip(row[3:], every, strict=True):
        assert float(cell) == pytest.approx(sum(solved(run, "evaluated", depth) for run in of) / len(of), abs=0.0501)


def test_what_the_text_says_holds():
    learned = {name: [solved(run, "evaluated", *range(2, 9)) for run in RUNS[name].values()] for name in NAMES}
    between = {name: f"{min(of)} to {max(of)}" if min(of) < max(of) else str(min(of)) for name, of in learned.items()}

    assert f"AMSC, which selects earlier masks by embeddings, learns {between['mask_amsc']} tasks. Mask LC" in SECTION
    assert f"combines all earlier masks and learns {between['mask_lc']}." in SECTION
    assert f"combines none and learns {between['mask_ri']}. AMSC and Mask LC are" in SECTION
    assert f"CKA-RL learns {between['cka_rl']} tasks and PPO {between['finetune']}." in SECTION
    assert "AMSC learns more tasks than the four other methods, in each of its five seeds" in SECTION
    assert len(learned["mask_amsc"]) == 5
    assert min(learned["mask_amsc"]) > max(max(of) for name, of in learned.items() if name != "mask_amsc")
    assert sum(learned["cka_rl"]) / len(learned["cka_rl"]) <= sum(learned["finetune"]) / len(learned["finetune"])
    deep = {name: max(solved(run, "evaluated", 6, 7, 8) for run in RUNS[name].values()) for name in NAMES}
    assert {name for name, count in deep.items() if count} == {"mask_amsc", "mask_lc"}
    for name, seeds in RUNS.items():
        for run in seeds.values():
            if name.startswith("mask_"):
                assert solved(run, "kept", *range(2, 9)) == solved(run, "evaluated", *range(2, 9))
            else:
                assert solved(run, "kept", *range(2, 9)) <= 2
