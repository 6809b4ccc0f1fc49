"""Goals as people write them: ``1.2`` at every entry, and what is no goal is refused with the rule, value and fix."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import hydra
import pytest

import ctgraph_rl.gym  # noqa: F401  registers the environments
import curricula
from ctgraph_rl import Curriculum, Task
from ctgraph_rl.core.goal import write_goal
from ctgraph_rl.runs.config import curriculum_of
from ctgraph_rl.tasks.configurations import ct_fo_b1, ct_graph, make_task
from curricula.axes import reshaped


def through_gymnasium(goal, b):
    with gymnasium.make("ctgraph/CTGraph-v0", branching_factor=b, goal=goal) as env:
        return env.unwrapped.rows.tasks[0]


def through_json(goal, b):
    content = curricula.from_axes(branching_factor=b, goals=["1.2" if b < 10 else "1.10"]).to_json()
    content["tasks"][0]["goal"] = goal
    return Curriculum.from_json(content).tasks[0]


ENTRIES = {
    "Task": lambda goal, b: replace(ct_graph(b, 2), goal=goal),
    "ct_graph": lambda goal, b: ct_graph(b, 2, goal=goal),
    "make_task": lambda goal, b: make_task(branching_factor=b, goal=goal),
    "Task.from_json": lambda goal, b: Task.from_json({"graph_shape": {"d": 2, "b": b}}, goal),
    "Curriculum.from_json": through_json,
    "gymnasium": through_gymnasium,
}

GOALS = [("1.2", 2), (1.2, 9), ([1, 2], 2), ("1.10", 12), ([1, 10], 12)]

NO_GOALS = [
    ("1.3", 2, "goal must be 2 decisions in 1..2, such as 1.1, got 1.3"),
    (1.3, 2, "goal must be 2 decisions in 1..2, such as 1.1, got 1.3"),
    ("12", 2, "goal must be 2 decisions in 1..2, such as 1.1, got 12"),
    (12, 2, "goal must be 2 decisions in 1..2, such as 1.1, got 12"),
    ("1,2", 2, "goal must be 2 decisions in 1..2, such as 1.1, got 1,2"),
    ("01.2", 2, "goal must be 2 decisions in 1..2, such as 1.1, got 01.2"),
    ("1.2\n", 2, r"goal must be 2 decisions in 1..2, such as 1.1, got '1.2\n'"),
    ("", 2, "goal must be 2 decisions in 1..2, such as 1.1, got ''"),
    ([1, 3], 2, "goal must be 2 decisions in 1..2, such as 1.1, got (1, 3)"),
    ("0.1", 2, "got 0.1; a path of the authors' implementation counts from 0: use 1.2"),
    (1.1, 12, "got 1.1, a number, and as numbers 1.1 and 1.10 are equal: put it in quotes, in a shell '\"1.10\"'"),
]


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize(("goal", "b"), GOALS)
def test_every_entry_takes_a_goal_as_it_is_written(entry, goal, b):
    assert ENTRIES[entry](goal, b).goal == ((1, 2) if b < 10 else (1, 10))


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize(("goal", "b", "message"), NO_GOALS)
def test_every_entry_refuses_what_is_no_goal(entry, goal, b, message):
    with pytest.raises(ValueError) as refused:
        ENTRIES[entry](goal, b)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("words", "goals"),
    [
        (["curriculum.goals=1.2"], ["1.2"]),
        (["curriculum.goals=[1.2,2.1]"], ["1.2", "2.1"]),
        (["curriculum.goals=[[1,2],[2,1]]"], ["1.2", "2.1"]),
        (["curriculum.goals=1.2.1", "curriculum.depth=3"], ["1.2.1"]),
        (["curriculum.goals=[2]", "curriculum.depth=1"], ["2"]),
        (['curriculum.goals=["1.10",1.12]', "curriculum.branching_factor=12"], None),
        (["curriculum.goals=[\"1.10\",'1.12']", "curriculum.branching_factor=12"], ["1.10", "1.12"]),
    ],
)
def test_the_command_line_takes_goals_as_they_are_written(compose, words, goals):
    cfg = compose("curriculum=axes", *words)
    if goals is None:
        with pytest.raises(Exception, match=r"got 1\.12, a number, .* in quotes"):
            hydra.utils.instantiate(cfg.curriculum)
    else:
        assert [write_goal(task.goal) for task in hydra.utils.instantiate(cfg.curriculum).tasks] == goals


@pytest.mark.parametrize("written", ["[1.2, 2.1]", "['1.2', '2.1']", "\n- 1.2\n- [2, 1]"])
def test_a_yaml_file_takes_goals_as_they_are_written(tmp_path, written):
    (tmp_path / "curriculum").mkdir()
    (tmp_path / "curriculum" / "own.yaml").write_text(f"_target_: curricula.from_axes\ngoals: {written}\n")

    assert curriculum_of("own", tmp_path).labels == ("goal1.2", "goal2.1")


def test_a_goal_is_written_in_one_way():
    task = ct_fo_b1(goal=(1, 2))
    curriculum = curricula.from_axes("fo_b1", goals="1.2")

    assert task.goal == (1, 2)
    assert reshaped(task, task.graph, "full", "1.2") == task
    assert "goal 1.2," in repr(task)
    assert curriculum.labels == ("goal1.2",)
    assert curriculum.to_json()["tasks"][0]["goal"] == "1.2"
    assert curriculum.fingerprint == curricula.from_axes("fo_b1", goals=[(1, 2)]).fingerprint
