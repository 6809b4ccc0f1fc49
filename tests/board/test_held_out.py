"""Level *held out*: what a verifier's number draws, and what its runs must have."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

import curricula
from ctgraph_rl.board import held_out, rerun
from ctgraph_rl.board.held_out import held_out_cells, other_curriculum, seeds_of
from ctgraph_rl.board.tracks import held_out_seeds
from ctgraph_rl.log.run_log import RunLog


@pytest.mark.parametrize("name", ["ct8", "ct8_md", "dick2020_pair", "su_b1_4images"])
def test_held_out_images_and_goals_keep_what_tasks_share(name):
    curriculum = curricula.load(name)
    other = other_curriculum(curriculum, "key")

    def shared(tasks):
        pairs = [(one, two) for one in tasks for two in tasks]
        goals = [[a == b for a, b in zip(one.goal, two.goal, strict=False)] for one, two in pairs]
        first = [next((place for place, same in enumerate(goal) if not same), len(goal)) for goal in goals]
        return first, [one.images == two.images for one, two in pairs], [one == two for one, two in pairs]

    assert shared(other.tasks) == shared(curriculum.tasks)
    assert [task.graph for task in other.tasks] == [task.graph for task in curriculum.tasks]
    assert not {task.image_seed for task in other.tasks} & ({task.image_seed for task in curriculum.tasks} - {None})
    assert other.ends == curriculum.ends
    assert other == other_curriculum(curriculum, "key")
    assert other != other_curriculum(curriculum, "another key")


def test_held_out_seeds_are_neither_submitted_nor_for_tuning(tiny_submission, tmp_path):
    without = replace(tiny_submission, track=None)
    assert seeds_of(tiny_submission, 5, 3) == held_out_seeds(f"tiny-v1 {tiny_submission.digest} 5", 3)
    for submission in (tiny_submission, without):
        assert seeds_of(submission, 5, 20) == seeds_of(submission, 5, 20) != seeds_of(submission, 6, 20)
        assert len(set(seeds_of(submission, 5, 20))) == 20
        assert min(seeds_of(submission, 5, 20)) >= 10**6
    one, two = held_out_cells(tiny_submission, 5, 2, tmp_path)

    assert one.curriculum.fingerprint != two.curriculum.fingerprint
    assert dict(one.job.config) == dict(tiny_submission.config)


@pytest.mark.parametrize("is_complete", [True, False])
def test_a_held_out_log_has_the_evaluations_of_the_protocol(tiny_submission, tmp_path, is_complete):
    (cell,) = held_out_cells(tiny_submission, 5, 1, tmp_path)
    measurements = tiny_submission.log(tiny_submission.runs[0]).measurements
    last = max(place for place, each in enumerate(measurements) if each["kind"] == "evaluation")
    kept = [each for place, each in enumerate(measurements) if is_complete or place != last]
    log = RunLog.of_content("".join(json.dumps(each) + "\n" for each in kept).encode(), tmp_path)
    cell = cell._replace(curriculum=tiny_submission.curriculum)

    frames, evaluations, _ = held_out.held_out_checks(tiny_submission, [(cell, rerun.Rerun(log, "", None))])

    assert (frames.passed, evaluations.passed, evaluations.level) == (True, is_complete, "held_out")
