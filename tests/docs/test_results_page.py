"""docs/results.md: made from the raw results beside it, and the raw results say what theory says."""

from __future__ import annotations

import math
import sys

import pytest
from helpers.paths import CHECKOUT

from ctgraph_rl.tasks.configurations import CONFIGURATIONS

FOLDER = CHECKOUT / "docs" / "results"
WITHOUT_MEMORY = ("a2c", "dqn", "ppo", "ppo_count", "reinforce")
SMALL = ("fo_b1", "su_b1", "co_b1", "posr_b1")
GOALS = ("1.1", "1.2", "2.1", "2.2")


@pytest.fixture(scope="module")
def make():
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(str(FOLDER))
        yield __import__("make")
        del sys.modules["make"]


def task_of(line):
    name = "CT-" + line["configuration"].upper().replace("_", "-")
    return CONFIGURATIONS[name](goal=tuple(map(int, line["task"].split("."))))


def test_the_page_is_what_its_raw_results_make(make):
    assert make.page() == make.PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["baselines"], "invalid choice: 'baselines' (choose from"),
        (["baselines_b1"], "no raw results of baselines_b1, whose file stays as it was: give the folder of its runs"),
        (["main_job"], "no raw results of main_job, whose file stays as it was"),
        (["masks_ct8"], "holds no finished run of masks_ct8: give the folder of its runs"),
    ],
)
def test_what_cannot_be_collected_is_one_message_and_no_file_changes(
    make, monkeypatch, capsys, tmp_path, arguments, message
):
    before = {path: path.read_bytes() for path in FOLDER.glob("*.csv")}
    monkeypatch.setattr(sys, "argv", ["make.py", "collect", *arguments, str(tmp_path)])

    with pytest.raises(SystemExit) as end:
        make.main()

    assert end.value.code == 2
    assert message in capsys.readouterr().err
    assert {path: path.read_bytes() for path in FOLDER.glob("*.csv")} == before


def test_every_cell_of_the_small_configurations_has_five_seeds_that_finished(make):
    cells = make.groups(make.read("baselines_b1"), "configuration", "task", "agent")

    agents = (*WITHOUT_MEMORY, "lstm_ppo")
    assert set(cells) == {(name, goal, agent) for name in SMALL for goal in GOALS for agent in agents}
    assert all(sorted(line["seed"] for line in lines) == list("01234") for lines in cells.values())
    assert not any(line["failed"] for lines in cells.values() for line in lines)


def test_no_policy_without_memory_is_above_its_exact_ceiling(make):
    lines = [line for line in make.read("baselines_b1") if line["agent"] in WITHOUT_MEMORY]

    for line in lines:
        task = task_of(line)
        reward_noise = task.reward_std / math.sqrt(make.EPISODES)
        for way, deterministic in (("greedy", True), ("sampled", False)):
            ceiling = task.memoryless_ceiling(deterministic)
            spread = math.sqrt(ceiling * (1 - ceiling) / make.EPISODES) + reward_noise
            assert float(line[f"{way}_return"]) <= ceiling + 5 * spread, line


def test_memory_solves_every_goal_of_every_small_configuration(make):
    cells = make.groups(make.read("baselines_b1"), "agent", "configuration", "task")

    for (agent, configuration, _), lines in cells.items():
        if agent == "lstm_ppo" or (configuration == "fo_b1" and agent != "reinforce"):
            mean = sum(float(line["greedy_success"]) for line in lines) / len(lines)
            assert mean >= 0.99, (agent, configuration)


def test_at_least_two_agents_solve_ct_fo_b2(make):
    cells = make.groups(make.read("baselines_fo_b2"), "agent", "task")

    solved = {
        agent
        for agent in {agent for agent, _ in cells}
        if all(
            float(line["greedy_success"]) >= 0.99
            for (name, _), lines in cells.items()
            if name == agent
            for line in lines
        )
    }
    assert len(solved) >= 2
