"""docs/results/baselines.md: made from the raw results beside it, and the raw results say what theory says."""

from __future__ import annotations

import math
import re

import pytest
from helpers.paths import CHECKOUT

import curricula
from ctgraph_rl.tasks.configurations import CONFIGURATIONS

FOLDER = CHECKOUT / "docs" / "results"
PAGE, LIFELONG = FOLDER / "baselines.md", FOLDER / "lifelong.md"
WITHOUT_MEMORY = ("a2c", "dqn", "ppo", "ppo_count", "reinforce")
SMALL = ("fo_b1", "su_b1", "co_b1", "posr_b1")
GOALS = ("1.1", "1.2", "2.1", "2.2")


@pytest.fixture(scope="module")
def make():
    from studies.baselines import page

    return page


def task_of(line):
    name = "CT-" + line["configuration"].upper().replace("_", "-")
    return CONFIGURATIONS[name](goal=tuple(map(int, line["task"].split("."))))


def test_the_page_is_what_its_raw_results_make(make):
    assert make.page() == PAGE.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_lifelong_page_is_what_its_raw_results_make():
    from studies.lifelong import page

    assert page.page() == LIFELONG.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", [PAGE, LIFELONG], ids=["agents", "methods"])
def test_no_mean_of_five_seeds_stands_without_its_interval_and_none_leaves_what_is_possible(page):
    tables = [line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    numbers = re.findall(r"\d\.\d\d(?! \[)", re.sub(r"±\d\.\d\d|p \d\.\d{3}|\[[^]]*\]", "[]", " ".join(tables)))
    ends = [tuple(map(float, each)) for each in re.findall(r"\[(-?[\d.]+), (-?[\d.]+)\]", " ".join(tables))]

    assert numbers == []
    assert len(ends) > 70 and all(low < high for low, high in ends)
    if page == PAGE:
        assert all(low >= 0 and high <= 1 for low, high in ends)


def test_the_draws_of_the_evaluation_have_their_error(make):
    page = PAGE.read_text(encoding="utf-8")

    assert round(math.sqrt(0.86 * 0.14 / make.EPISODES), 2) == 0.01
    assert "| `dqn` | 1.00 [0.48, 1], 0.86 [0.41, 0.93] ±0.01 |" in page


def test_a_threshold_does_not_hang_on_the_last_bit(make):
    from studies.lifelong import comparison

    experts = [
        lines
        for (who, _), lines in make.groups(make.read("epochs/masks_ct12"), "method", "seed").items()
        if who == "expert"
    ]

    areas = 1 - comparison.expert_areas(experts).mean(0)

    assert areas[2] != 0.05 and areas[2] == pytest.approx(0.05, abs=1e-15)
    assert comparison.full(experts) == [1, 4, 5, 7, 10, 12]
    assert comparison.full(experts[::-1]) == comparison.full([lines[::-1] for lines in experts])
    next(line for lines in experts for line in lines if line["3"] == "0.0" and line["frames"] != "0")["3"] = "1.0"
    assert 3 in comparison.full(experts)


OF_OTHER_ROUNDING = {"masks_ct8": {"1": 1, "2": 3, "3": 1, "5": 2}}
"""Evaluations of the first task that EWC, whose compiled steps are of one seed, has otherwise, by table and seed."""


@pytest.mark.parametrize("name", ["masks_ct8_md", "masks_ct8", "masks_ct12"])
def test_ewc_has_the_results_of_ppo_on_the_first_task_but_for_rounding(make, name):
    first = {
        (method, seed): [line["1"] for line in lines if line["block"] in ("0", "1")]
        for (method, seed), lines in make.groups(make.read(name), "method", "seed").items()
    }

    for seed in {seed for _, seed in first}:
        others = [a != b for a, b in zip(first["finetune", seed], first["ewc_published", seed], strict=True)]
        assert sum(others) == OF_OTHER_ROUNDING.get(name, {}).get(seed, 0)


@pytest.mark.parametrize("name", ["ct8_md", "ct8", "ct12", "fo_b1_4tasks", "fo_b1_4images", "fo_b1_depth2to5"])
def test_an_evaluation_of_the_lifelong_page_is_one_episode_of_a_return_in_0_to_1(make, name):
    learned = curricula.load(name)
    raw = make.read(f"masks_{name}") or [line for line in make.read("methods") if line["curriculum"] == name]

    assert learned.evaluation.greedy and all(task.is_deterministic for task in learned.tasks)
    assert {task.return_bounds for task in learned.tasks} == {(0, 1)}
    assert {line[key] for line in raw for key in line if key.isdigit()} - {""} == {"0.0", "1.0"}


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


def test_memory_solves_every_goal_of_every_small_configuration_in_every_seed_but_one(make):
    raw = make.read("baselines_b1")

    failed = {
        (line["agent"], line["configuration"], line["task"], line["seed"])
        for line in raw
        if line["agent"] == "lstm_ppo" or (line["configuration"] == "fo_b1" and line["agent"] != "reinforce")
        if float(line["greedy_success"]) < 0.95
    }
    assert failed == {("lstm_ppo", "posr_b1", "2.1", "4")}
    assert "on goal 2.1 of CT-POSR-B1 one seed of five did not" in " ".join(make.page().split())


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


def test_where_nothing_is_left_to_chance_is_as_the_page_says(make):
    goals = dict.fromkeys(SMALL, "1.1") | {"fo_b2": "1.1.1"}
    without = {name for name, goal in goals.items() if make.task_of(name, goal).is_deterministic}

    assert without == {"fo_b1", "su_b1"}
    assert "On CT-FO-B1 and CT-SU-B1 nothing is left to chance" in PAGE.read_text(encoding="utf-8")
    assert all(task.is_deterministic for task in curricula.load("su_b1_4tasks").tasks)


def test_raw_results_say_the_machine_of_each_run_and_where_it_is_not_recorded(make, monkeypatch, tmp_path):
    from studies import raw

    monkeypatch.setattr(raw, "HERE", tmp_path)
    lines = ["seed,machine,cpu", "0,,not recorded", "1,x86_64 AVX512,AMD EPYC", "2,x86_64 AVX2,not recorded"]
    (tmp_path / "table.csv").write_text("\n".join(lines), encoding="utf-8")

    assert raw.machines("table") == (
        "1 rows: not recorded; 1 rows: x86_64 AVX2, not recorded; 1 rows: x86_64 AVX512, AMD EPYC"
    )
