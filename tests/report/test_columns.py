"""The columns of tables: what a curriculum is for, by one rule for a run, many runs, a report and the board."""

from __future__ import annotations

import pytest
from helpers.made_runs import all_runs, line
from helpers.scripted import DECISION_ID, OBSERVATIONS
from rich.console import Console

import curricula
from ctgraph_rl import Block, CTGraph, Curriculum, Evaluation, OneHot, Recorder, Task
from ctgraph_rl.metrics.curves import find_returns
from ctgraph_rl.report.columns import IN_ORDER, board_columns, columns
from ctgraph_rl.report.formats import FORMATS
from ctgraph_rl.report.results import rows_by_seed, selected, table
from ctgraph_rl.report.terminal import print_summary

A, B, C = (Task(CTGraph(3, 1), (branch,), OBSERVATIONS, OneHot(5)) for branch in (1, 2, 3))

RETURNS = ("average_performance", "relative_forgetting", "regain")


@pytest.mark.parametrize(
    ("trained", "shown"),
    [
        ([(0,), (1,), (2,)], IN_ORDER),
        ([(0,), (1,), (0,)], RETURNS),
        ([(0,), (1,), (2,), (0,)], RETURNS),
        ([(0,), (0,)], RETURNS[:2]),  # it never left
        ([(0,)], RETURNS[:1]),
        ([(0, 1, 2, 3)], RETURNS[:1]),
        ([(0, 1), (2,)], RETURNS[:2]),
        ([(0,), (0, 1), (1,)], RETURNS[:2]),
        ([(0,), (0, 1), (1,), (0,)], RETURNS),
        ([], IN_ORDER),
    ],
)
def test_columns_follow_from_which_task_each_block_trains(trained, shown):
    assert columns(trained, adapts=False) == shown
    assert columns(trained, adapts=True) == (*shown, "adapted_return", "search_regret")


@pytest.mark.parametrize("name", ["ct16_64", "ct29_recovery", "swoks_2x4", "task_free_recurring"])
def test_named_curricula_whose_tasks_return_show_forgetting_and_regain(name):
    learned = curricula.load(name)

    assert columns(learned.trained, adapts=False) == RETURNS
    assert board_columns(learned) == ["average_performance", "relative_forgetting"]


def test_a_return_is_alone_and_after_other_tasks():
    assert find_returns([(0,), (1,), (0,), (0,), (1,)]) == [(0, 1, 3), (1, 2, 5)]
    assert find_returns([(0, 1), (2,), (0,), (2,)]) == [(2, 2, 4)]
    assert find_returns([(0,), (0, 1), (0,)]) == []


def in_blocks(*tasks: Task) -> Curriculum:
    """Blocks of 16 frames with an evaluation every 4."""
    blocks = [Block(task, 16) for task in tasks]
    return Curriculum("own", 1, "here", blocks, Evaluation(4, every=4))


def policy(*decisions: int):
    """Decide for a branch in each part of a run."""
    return [lambda images, branch=branch: images[:, DECISION_ID].astype(int) * branch for branch in decisions]


def record(folder, learned, policies, name: str = "mine", seed: int = 0) -> None:
    with Recorder(learned, folder / name / str(seed), seed=seed, about={"learner": name}) as recorder:
        for frames, acts in zip(recorder.moments, policies, strict=True):
            recorder.evaluate(acts, frames)


def test_every_table_of_an_own_a_b_c_a_shows_forgetting_and_regain(tmp_path):
    """A is found after a quarter of its second block, where it took three quarters of the first; C is forgotten."""
    learned = in_blocks(A, B, C, A)
    record(tmp_path, learned, policy(*[3, 3, 3, 1, 1], *[2, 2, 2, 2], *[3, 3, 3, 3], *[1, 1, 1, 1]))
    runs = all_runs([tmp_path])

    rows = selected(table(runs))

    shown = ["average_performance", "isolated_forgetting", "relative_forgetting", "regain", "solved_rate"]
    assert [row.measure for row in rows] == [row.measure for row in selected(rows_by_seed(runs))] == shown
    assert line(rows, "regain", "mine").estimate.value == pytest.approx(4 / 12)
    assert line(rows, "relative_forgetting", "mine").estimate.value == pytest.approx(2 / 3)
    for form in FORMATS.values():
        assert "forgetting" in form(rows, {}, "")
        assert "regain" in form(rows, {}, "")
    console = Console(width=200, record=True)
    print_summary(runs[0].path, console)
    text = console.export_text()
    assert "forward transfer" not in text
    for name in ("relative forgetting", "isolated forgetting", "regain"):
        assert name in text


def test_a_task_that_is_not_mastered_again_is_never_regained(tmp_path):
    learned = in_blocks(A, B, A)
    for seed, last in enumerate((1, 2, 2)):
        record(tmp_path, learned, policy(*[3, 1, 1, 1, 1], *[2, 2, 2, 2], *[last] * 4), seed=seed)

    row = line(table(all_runs([tmp_path])), "regain", "mine")

    assert row.estimate.value == float("inf")
    assert "a task was not mastered again when it returned" in row.note


@pytest.mark.parametrize(
    ("first", "again", "value", "reason"),
    [
        ([1, 1, 1, 1], [1, 1, 1, 1], 1.0, None),
        ([3, 3, 3, 1], [3, 1, 1, 1], 0.5, None),
        ([3, 3, 3, 3], [1, 1, 1, 1], None, "no task that returns was mastered in its first block"),
    ],
)
def test_regain_is_of_tasks_that_were_mastered_at_first(first, again, value, reason):
    learned = in_blocks(A, B, A)
    recorder = Recorder(learned)
    for frames, acts in zip(recorder.moments, policy(3, *first, *[2, 2, 2, 2], *again), strict=True):
        recorder.evaluate(acts, frames)

    metric = recorder.metrics["regain"]

    assert (metric.value, metric.undefined) == (value, reason)


def test_a_task_that_was_kept_is_regained_in_no_frames():
    learned = in_blocks(A, B, A)
    recorder = Recorder(learned)
    for frames in recorder.moments:
        recorder.evaluate(policy(1)[0], frames)

    assert recorder.metrics["regain"].value == 0


def test_curricula_without_a_return_have_no_regain():
    recorder = Recorder(in_blocks(A, B))
    for frames in recorder.moments:
        recorder.evaluate(policy(1)[0], frames)

    reason = "the definition needs a block of one task that was trained before, with other tasks between"
    assert recorder.metrics["regain"].undefined == reason


def printed(run_dir, width: int = 80) -> str:
    console = Console(width=width, record=True)
    print_summary(run_dir, console)
    return console.export_text()


def test_a_run_that_keeps_its_only_task_says_how_many_it_learned(tmp_path):
    """It forgets nothing, which reads as success."""
    learned = in_blocks(A, B, C)
    record(tmp_path, learned, policy(*[1] * 13), "kept")
    record(tmp_path, learned, policy(*[1] * 5, *[2] * 4, *[3] * 4), "forgot")
    said = "only 1 of 3 tasks were learned in their blocks"

    kept = line(table(all_runs([tmp_path / "kept"])), "forgetting", "kept")
    forgot = line(table(all_runs([tmp_path / "forgot"])), "forgetting", "forgot")

    assert (kept.estimate.value, forgot.estimate.value) == (0, 1)
    assert f"seed 0: {said}" in kept.note and "were learned" not in forgot.note
    assert f"forgetting: {said}" in printed(tmp_path / "kept" / "0")
    assert "were learned" not in printed(tmp_path / "forgot" / "0")
