"""docs/results/memory.md: made from the raw results beside it, and what it says of them holds."""

from __future__ import annotations

import csv
import itertools
import re
import sys
from collections import defaultdict

import pytest
from helpers.paths import CHECKOUT
from omegaconf import OmegaConf

from ctgraph_rl import CTGraphEnv
from ctgraph_rl.runs import config
from ctgraph_rl.tasks.values import random_frames_to_goal
from curricula import co_hard

FOLDER = CHECKOUT / "docs" / "results"
PAGE = " ".join((FOLDER / "memory.md").read_text(encoding="utf-8").split())
CONF = CHECKOUT / "conf" / "experiment"
RIVALS = ("DQN (1 step)", "DQN (6 steps)", "QRDQN+LSTM", "REINFORCE", "A2C", "AMRL-Max", "AMRL-Avg", "Backpropamine")
SETTINGS = ("num_envs", "num_steps", "learning_rate", "entropy_coeff")

Lines = list[dict[str, str]]


@pytest.fixture(scope="module")
def cells():
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(str(FOLDER))
        before = set(sys.modules)
        yield __import__("memory_cells")
        for name in set(sys.modules) - before:
            if name == "raw" or name.startswith("memory_"):
                del sys.modules[name]


@pytest.fixture(scope="module")
def names(cells) -> dict[str, str]:
    """What the page calls each agent."""
    return cells.AGENTS


def read(name: str, *keys: str) -> dict[tuple[str, ...], Lines]:
    """Raw lines with equal values under some keys."""
    found = defaultdict(list)
    with open(FOLDER / f"{name}.csv", newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            found[tuple(line[key] for key in keys)].append(line)
    return found


def on_hardest(unique: bool, given: bool, names: dict[str, str]) -> dict[str, Lines]:
    """Raw lines on a graph of the claims, by what the page calls the agent."""
    keys = ("wait_prob", "unique_decisions", "num_wait_images", "read_noise", "guide_frames", "agent")
    graph = ("0.9", str(unique), "500", "0", "204800" if given else "0")
    return {names[key[-1]]: lines for key, lines in read("memory_cells", *keys).items() if key[:-1] == graph}


def number(lines: Lines) -> int:
    return sum(float(line["greedy_return"]) >= 0.9 for line in lines)


def at_any_evaluation(lines: Lines) -> int:
    return sum(line["frames_to_90"] != "" for line in lines)


def named(part: str) -> list[str]:
    """The names in a list within a sentence."""
    return re.split(", | and ", part.strip(" ."))


def ranked(part: str) -> dict[str, int]:
    """The number of seeds of each agent that a list such as ``4 of 5: LSTM, GRU; 0 of 5: A2C`` names."""
    groups = [group.split(" of 5: ") for group in part.strip(" .").split("; ")]
    return {name: int(found) for found, of in groups for name in named(of) if not name.startswith("the other")}


def test_the_page_is_what_its_raw_results_make(cells):
    assert cells.page() == (FOLDER / "memory.md").read_text(encoding="utf-8")


def test_each_run_is_one_line_with_the_share_of_the_gap_or_its_reason(cells):
    conditions = {"memory_cells": cells.Condition._fields, "memory_ladder": ("depth", "expected_length", *SETTINGS)}

    for name, keys in conditions.items():
        assert {len(lines) for lines in read(name, "agent", "seed", *keys).values()} == {1}
    for line in itertools.chain(read("memory_cells")[()], read("memory_ladder")[()]):
        best, ceiling = float(line["optimum"]), float(line["ceiling_without_memory"])
        share = (float(line["greedy_return"]) - ceiling) / (best - ceiling) if best > ceiling else None
        if share is None:
            assert "memory gains nothing there" in line["memory_gap_closed"]
        else:
            assert float(line["memory_gap_closed"]) == pytest.approx(share, abs=1e-6)


@pytest.mark.parametrize(("unique", "given"), list(itertools.product((False, True), (True, False))))
def test_seeds_that_solve_the_hardest_graphs_are_counted_from_the_raw_results(unique, given, names):
    of = on_hardest(unique, given, names)
    decisions, rewards = "unique" if unique else "shared", "given" if given else "to be found"
    table = PAGE.split("by decisions and whether first rewards are given")[1]
    column = next(line for line in table.split("| |") if "shared, given" in line).split(" | ")
    place = [each.strip(" |") for each in column].index(f"{decisions}, {rewards}") + 1

    for rival in (*RIVALS, "MOHQA"):
        row = [each.strip() for each in table.split(f"| {rival} |")[1].split("|")]
        lines = of.get(rival, [])
        found = f"{number(lines)} of {len(lines)} ({at_any_evaluation(lines)})" if len(lines) == 5 else "not run"
        assert row[place - 1] == found
    ran = [rival for rival in RIVALS if len(of.get(rival, [])) == 5]
    poor, others = ([rival for rival in ran if (number(of[rival]) <= 1) == few] for few in (True, False))
    verdict = f"| {decisions} decisions, first rewards {rewards} | {', '.join(poor)} | {', '.join(others) or 'none'} |"
    assert verdict in table


def test_what_the_page_says_in_words_of_the_hardest_graphs_holds(names):
    shared, to_find = (on_hardest(False, given, names) for given in (True, False))
    unique, unique_to_find = (on_hardest(True, given, names) for given in (True, False))
    recurrent = ("LSTM", "GRU", "minGRU", "AMRL-Max", "AMRL-Avg", "Backpropamine")

    assert all(number(shared[name]) >= 3 for name in recurrent) and "recurrent agents solve the hardest graph" in PAGE
    listed = ranked(PAGE.split("shared decisions after training: ")[1].split(" - **")[0])
    assert set(recurrent) <= set(listed) and listed.items() <= {name: number(of) for name, of in shared.items()}.items()
    assert sum(map(number, to_find.values())) + sum(map(number, unique_to_find.values())) <= 2
    assert "Where agents must find the first reward themselves, nearly all fail" in PAGE
    rewards = 409_600 / random_frames_to_goal(co_hard(wait_prob=0.9).tasks[0])
    assert 1.5 < rewards < 2.5 and "409,600 frames hold about two rewards under random actions" in PAGE
    assert all(number(unique[name]) >= 4 and number(shared[name]) >= 4 for name in ("AMRL-Max", "AMRL-Avg"))
    assert "AMRL solves both graphs once first rewards are given" in PAGE
    assert all(number(each.get(name, [])) <= 1 for each in (to_find, unique_to_find) for name in RIVALS)
    assert "that rivals of MOHQA do poorly on such graphs holds where first rewards must be found" in PAGE
    assert min(number(each["Backpropamine"]) for each in (shared, unique)) > 1
    assert "With first rewards given, it does not hold for AMRL and Backpropamine" in PAGE
    assert all(at_any_evaluation(each["DQN (1 step)"]) >= 3 for each in (unique, unique_to_find))
    assert all(number(each["DQN (1 step)"]) <= 1 for each in (unique, unique_to_find))
    assert "solves the graph with unique decisions early and loses it again, even without first rewards" in PAGE
    assert number(unique["PPO (no memory)"]) >= 3 and "PPO without memory is a further rival that solves" in PAGE
    mohqa = [f"{number(of['MOHQA'])} of 5" if "MOHQA" in of else "not run" for of in (unique, unique_to_find)]
    assert f"graph in {mohqa[0]} seeds with unique decisions and first rewards given, and in {mohqa[1]} without" in PAGE


def test_totals_over_all_graphs_are_counted_from_the_raw_results(names):
    table = PAGE.split("## Over all graphs")[1].split("## By graph")[0]
    lines = read("memory_cells", "guide_frames", "read_noise", "agent")
    given = {names[key[-1]]: of for key, of in lines.items() if key[:-1] == ("204800", "0") and len(of) == 45}

    for name, of in given.items():
        assert f"| {name} | {number(of)} | {at_any_evaluation(of)} | " in table
    differ = named(PAGE.split("Fewer runs are solved by")[1].split("([table]")[0])
    alike = named(PAGE.split("is not distinguishable from")[1].split(". Fewer")[0])
    assert sorted([*differ, *alike, "LSTM"]) == sorted(given)
    assert max(number(given[name]) for name in differ) < number(given["LSTM"])


def test_agents_have_the_weights_and_take_the_gradient_steps_that_the_page_says(compose):
    env = CTGraphEnv([co_hard().tasks[0]])
    words = {"a2c": "A2C", "reinforce": "REINFORCE", "dqn": "DQN, targets of 1 or 6 steps", "mohqa": "MOHQA"}
    words |= {"qrdqn_lstm": "QRDQN+LSTM", "lstm_ppo": "PPO with each cell"}
    weights, steps = defaultdict(set), defaultdict(set)
    for variant in OmegaConf.load(CONF / "memory_cells.yaml").hydra.sweeper.variants:
        cfg = compose(*(f"{key}={value}" for key, value in variant.items()))
        agent = config.target(cfg, "agent")(env.observation_spec_unbatched, env.action_spec_unbatched)
        updates = cfg.agent.get("num_updates", cfg.agent.get("num_epochs", 1) * cfg.agent.get("num_minibatches", 1))
        weights[variant.agent].add(sum(each.numel() for each in agent.weights))
        steps[variant.agent].add(409_600 // (cfg.agent.num_envs * cfg.agent.num_steps) * updates)

    for name, row in words.items():
        cells = [each.strip() for each in PAGE.split(f"| {row} |")[1].split("|")]
        assert cells[0] == " to ".join(f"{each:,}" for each in sorted({min(weights[name]), max(weights[name])}))
        assert {int(cells[2].replace(",", ""))} == steps[name]


def ladder_lines() -> tuple[Lines, Lines]:
    """Lines of the search and of the ladder."""
    lines = read("memory_ladder")[()]
    return [line for line in lines if int(line["seed"]) >= 100], [line for line in lines if int(line["seed"]) < 100]


def setting(line: dict[str, str]) -> tuple[float, ...]:
    return tuple(float(line[key]) for key in SETTINGS)


def test_each_memory_has_the_setting_of_the_ladder_that_did_best_in_a_search_over_all_settings(names):
    found, ladder = ladder_lines()
    scores: dict[str, dict[tuple[float, ...], list[float]]] = {}
    for line in found:
        assert (line["depth"], line["expected_length"], line["frames"]) == ("2", "100", "409600")
        both = float(line["greedy_return"]) + float(line["training_return"])
        scores.setdefault(line["agent"], {}).setdefault(setting(line), []).append(both / 2)
    variants = OmegaConf.load(CONF / "memory_ladder.yaml").hydra.sweeper.variants
    given = {"lstm_ppo" if v.cell == "lstm" else f"lstm_ppo-{v.cell}": v for v in variants}

    low = named(PAGE.split("No setting scores 0.2 for:")[1].split(". An entropy")[0])

    assert set(given) == set(scores)
    for agent, of in scores.items():
        assert len(of) == 8 and all(len(values) == 2 for values in of.values())
        best = max(sum(values) for values in of.values())
        assert sum(of[tuple(float(given[agent][f"agent.{key}"]) for key in SETTINGS)]) == pytest.approx(best)
        row = PAGE.split("**Search.**")[1].split(f"| {names[agent]} |")[1].split("|")[:8]
        assert [float(each.strip(" *")) for each in row] == pytest.approx([sum(of[key]) / 2 for key in of], abs=0.0051)
        assert [place for place, each in enumerate(row) if "**" in each] == [
            next(place for place, values in enumerate(of.values()) if sum(values) == best)
        ]
        assert (best / 2 < 0.2) == (names[agent] in low)
    assert all(
        setting(line) == tuple(float(given[line["agent"]][f"agent.{key}"]) for key in SETTINGS) for line in ladder
    )
    solved = {steps: [number([line]) for line in found if line["num_steps"] == steps] for steps in ("128", "32")}
    words = " and ".join(f"{sum(of)} of {len(of)} with {steps}" for steps, of in solved.items())
    assert f"Of the runs of the search, {words} steps a sequence solve the graph" in PAGE


def test_what_the_page_says_in_words_of_the_ladder_holds(names):
    search, ladder = ladder_lines()
    of = defaultdict(dict)
    for line in ladder:
        of[line["depth"], line["expected_length"]].setdefault(names[line["agent"]], []).append(line)

    assert {line["frames"] for line in ladder} == {"409600"}
    listed = ranked(PAGE.split("expected length of 100 steps: ")[1].split(". With 300")[0])
    assert listed.items() <= {name: number(lines) for name, lines in of["2", "100"].items()}.items() and listed
    assert sum(number(lines) for lines in of["2", "300"].values()) == 0 and "With 300 steps: 0 of 5 with all" in PAGE
    best = setting(next(line for line in ladder if line["agent"] == "lstm_ppo"))
    found = number([line for line in search if line["agent"] == "lstm_ppo" and setting(line) == best])
    assert f"in {found} of 2 seeds of the search and in {number(of['2', '100']['LSTM'])} of 5 of the ladder" in PAGE
    longest = [line for (_, length), each in of.items() if length == "300" for lines in each.values() for line in lines]
    stopped = [line for line in longest if float(line["training_length"]) < 10]
    assert f"{len(stopped)} of {len(longest)} runs end with training episodes shorter than 10 steps" in PAGE
    assert len(stopped) > 0.8 * len(longest) and "Most agents stop waiting when no policy acts for them" in PAGE
    assert "PPO without memory earns nothing at depth 2 either" in PAGE
    assert all(float(line["training_return"]) < 0.05 for line in of["2", "300"]["PPO (no memory)"])
