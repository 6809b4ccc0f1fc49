"""docs/results/every_curriculum.csv: its lines agree with each other and with what is exact of their curricula."""

from __future__ import annotations

from statistics import fmean

import pytest
import yaml
from helpers.paths import CHECKOUT
from studies.every_curriculum import KEY, known_values
from studies.raw import groups, read

import curricula

LINES = read("every_curriculum")
PLAN = yaml.safe_load((CHECKOUT / "conf" / "experiment" / "every_curriculum.yaml").read_text(encoding="utf-8"))
VARIANTS = PLAN["hydra"]["sweeper"]["variants"]


def planned() -> set[tuple[str, str, str, str, int]]:
    """The curriculum, agent, method, task id and frames of a block of each cell of the experiment."""
    found = set()
    for variant in VARIANTS:
        given = (variant["agent"], variant.get("protocol.task_id", ""), variant["curriculum.num_frames"])
        for name in variant["curriculum"].split(","):
            for method in variant.get("method", "finetune").split(","):
                found.add((name, given[0], method, *given[1:]))
    return found


def test_the_lines_are_the_cells_of_the_experiment():
    found = {tuple(line[key] for key in ("curriculum", "agent", "method", "task_id", "seed")) for line in LINES}

    assert found == {(*cell[:-1], seed) for cell in planned() for seed in "012"}
    assert {(line["curriculum"], int(line["block_frames"])) for line in LINES} <= {
        (name, frames) for name, *_, frames in planned()
    }


def test_a_run_has_one_line():
    assert all(len(lines) == 1 for lines in groups(LINES, *KEY).values())


def test_every_run_is_of_a_named_curriculum_with_the_frames_that_it_says():
    for line in LINES:
        loaded = curricula.load(line["curriculum"], num_frames=int(line["block_frames"]))
        assert (line["curriculum"], loaded.num_frames) == (line["curriculum"], int(line["frames"]))


def test_a_curve_starts_and_ends_where_the_columns_say_and_its_frames_grow():
    for line in LINES:
        frames = [int(at) for at in line["at"].split()]
        values = [float(value) for value in line["curve"].split()]
        assert (frames[0] == 0, frames[-1]) == (line["before"] != "", int(line["frames"]))
        assert frames == sorted(set(frames))
        assert values[-1] == pytest.approx(float(line["end"]), abs=1e-3, rel=1e-3)
        if line["before"]:
            assert values[0] == pytest.approx(float(line["before"]), abs=1e-3, rel=1e-3)


def test_returns_without_noise_are_within_what_is_possible():
    for line in LINES:
        noises = {getattr(task, "reward_std", 0.0) for task in curricula.load(line["curriculum"]).tasks}
        if line["lowest"] and noises == {0.0}:
            for column in ("learned", "end"):
                assert float(line["lowest"]) <= float(line[column]) <= float(line["highest"]), line


@pytest.mark.parametrize("name", ["fo_b2_gradient", "su_b1_4tasks", "co_b1_new_waits"])
def test_random_actions_have_what_the_closed_form_says(name):
    """P_R of the paper where only the goal pays; a gradient also pays at other ends."""
    curriculum = curricula.load(name)
    exact = fmean(task.graph.exact_reward_prob_random for task in curriculum.tasks)
    found = float(known_values(curriculum)["random"])

    assert found > 2 * exact if name == "fo_b2_gradient" else found == pytest.approx(float(exact), rel=1e-3)


@pytest.mark.parametrize("name", ["fo_b2_gradient", "co_b1_new_waits", "frozen_lake_4maps"])
def test_lines_have_what_is_known_of_their_curriculum(name):
    exact = known_values(curricula.load(name))
    lines = [line for line in LINES if line["curriculum"] == name]

    assert lines
    assert all({key: line[key] for key in exact} == exact for line in lines)
    assert exact["optimum"] == ("" if name == "frozen_lake_4maps" else "1")
