"""docs/results/every_curriculum.csv: its lines agree with each other and with what is exact of their curricula."""

from __future__ import annotations

from statistics import fmean

import pytest
import torch
import yaml
from helpers.paths import CHECKOUT
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
    assert all(len(lines) == 1 for lines in groups(LINES, "curriculum", "agent", "method", "seed").values())


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


def random_value(task) -> float:
    """The exact mean return of an agent that takes each action of a task equally often."""
    return float(task.policy_value(torch.full((task.images.num_images, task.num_actions), 1 / task.num_actions)))


@pytest.mark.parametrize("name", ["fo_b2_gradient", "co_b1_new_waits"])
def test_lines_have_what_is_known_of_their_curriculum(name):
    tasks = curricula.load(name).tasks
    exact = {"optimum": fmean(task.optimal_value(1.0) for task in tasks), "random": fmean(map(random_value, tasks))}
    for place, end in enumerate(("lowest", "highest")):
        exact[end] = fmean(task.return_bounds[place] for task in tasks)
    lines = [line for line in LINES if line["curriculum"] == name]

    assert lines
    assert exact["optimum"] == 1
    for line in lines:
        assert {key: line[key] for key in exact} == {key: f"{value:.4g}" for key, value in exact.items()}


def test_random_actions_have_what_the_closed_form_says_where_only_the_goal_pays():
    """A gradient also pays at other ends."""
    for name, others_pay in (("fo_b2_gradient", True), ("co_b1_new_waits", False)):
        exact = fmean(task.graph.exact_reward_prob_random for task in curricula.load(name).tasks)
        found = float(next(line["random"] for line in LINES if line["curriculum"] == name))
        assert found > 2 * exact if others_pay else found == pytest.approx(float(exact), rel=1e-3)


def test_a_lake_has_no_line_of_what_is_known():
    lines = [line for line in LINES if line["curriculum"] == "frozen_lake_4maps"]

    assert {line[key] for line in lines for key in ("optimum", "random", "lowest", "highest")} == {""}
