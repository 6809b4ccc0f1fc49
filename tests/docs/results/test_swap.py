"""The section on penn_a_swap of docs/results/baselines.md: what it says holds for the raw results beside it."""

from __future__ import annotations

import csv

from helpers.paths import CHECKOUT

import curricula

FOLDER = CHECKOUT / "docs" / "results"
PAGE = (FOLDER / "baselines.md").read_text(encoding="utf-8").split("### A goal that is swapped once")[1]
SECTION = " ".join(PAGE.split("\n## ")[0].split())
SWAP = 89_600


def returns(seed: str, task: str, block: str) -> list[tuple[int, float]]:
    """Frames and greedy returns of the evaluations of a seed on a task within a block."""
    with open(FOLDER / "rl2_swap.csv", newline="", encoding="utf-8") as file:
        lines = [
            line for line in csv.DictReader(file) if (line["seed"], line["task"], line["block"]) == (seed, task, block)
        ]
    return [(int(line["frames"]), float(line["greedy_return"])) for line in lines]


def test_the_goals_are_those_that_the_section_names_and_need_no_memory():
    curriculum = curricula.load("penn_a_swap")

    assert [block.num_frames for block in curriculum.blocks] == [SWAP, SWAP]
    assert [task.goal for task in curriculum.tasks] == [(2, 2), (1, 1)]
    assert {task.memoryless_ceiling(deterministic=True) for task in curriculum.tasks} == {1}
    assert "unannounced, after 89,600 of 179,200 frames" in SECTION and "Goals 2.2 and 1.1" in SECTION


def test_each_seed_ends_with_the_second_goal_and_the_first_evaluation_that_has_it_is_counted():
    times = []
    for seed in "01234":
        assert returns(seed, "1", "1")[-1] == (SWAP, 1.0) and returns(seed, "1", "2")[-1] == (2 * SWAP, 0.0)
        assert returns(seed, "2", "1")[-1] == (SWAP, 0.0) and returns(seed, "2", "2")[-1] == (2 * SWAP, 1.0)
        times.append(next(frames - SWAP for frames, value in returns(seed, "2", "2") if value >= 0.9))

    assert "learns the second goal in 5 of 5 seeds" in SECTION and "All seeds lose the first goal" in SECTION
    assert f"comes {min(times):,} to {max(times):,} frames after the swap" in SECTION
