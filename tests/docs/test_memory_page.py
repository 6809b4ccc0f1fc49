"""docs/results/memory.md: made from the raw results beside it, and what it says of them holds."""

from __future__ import annotations

import csv
import itertools
import sys

import pytest
from helpers.paths import CHECKOUT
from omegaconf import OmegaConf

FOLDER = CHECKOUT / "docs" / "results"
PAGE = " ".join((FOLDER / "memory.md").read_text(encoding="utf-8").split())


@pytest.fixture(scope="module")
def cells():
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(str(FOLDER))
        yield __import__("memory_cells")
        for name in ("memory_cells", "memory_ladder", "memory_runs", "raw"):
            sys.modules.pop(name, None)


def returns(unique: str) -> dict[tuple[str, bool], list[float]]:
    """Greedy returns on a graph of the claims, by agent and whether first rewards were given."""
    found: dict[tuple[str, bool], list[float]] = {}
    with open(FOLDER / "memory_cells.csv", newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            graph = (line["wait_prob"], line["unique_decisions"], line["num_wait_images"], line["read_noise"])
            if graph == ("0.9", unique, "500", "0"):
                found.setdefault((line["agent"], line["guide_frames"] != "0"), []).append(float(line["greedy_return"]))
    return {key: values for key, values in found.items() if len(values) == 5}


@pytest.fixture(scope="module")
def hardest():
    return returns("False")


@pytest.fixture(scope="module")
def told_apart():
    return returns("True")


def test_the_page_is_what_its_raw_results_make(cells):
    assert cells.page() == (FOLDER / "memory.md").read_text(encoding="utf-8")


def test_each_run_is_one_line_with_the_share_of_the_gap_or_its_reason(cells):
    ladder = cells.memory_ladder
    conditions = {cells.NAME: cells.Condition._fields, ladder.NAME: ("depth", "expected_length", *cells.SETTINGS)}
    lines = {name: cells.read(name) for name in conditions}

    for name, of in lines.items():
        assert len({tuple(line[key] for key in ("agent", "seed", *conditions[name])) for line in of}) == len(of)
    for line in itertools.chain(*lines.values()):
        best, ceiling = float(line["optimum"]), float(line["ceiling_without_memory"])
        share = (float(line["greedy_return"]) - ceiling) / (best - ceiling) if best > ceiling else None
        if share is None:
            assert "memory gains nothing there" in line["memory_gap_closed"]
        else:
            assert float(line["memory_gap_closed"]) == pytest.approx(share, abs=1e-6)


def test_seeds_that_solve_the_hardest_graph_are_counted_from_the_raw_results(hardest, told_apart):
    solved, unique = (
        {key: f"{sum(value >= 0.9 for value in values)} of 5" for key, values in found.items()}
        for found in (hardest, told_apart)
    )
    cell, one, six = "lstm_ppo", "dqn, 1 step", "dqn, 6 steps"

    of = {name: solved[name, True] for name, given in solved if given}
    assert f"PPO with an LSTM solves the task in {of[cell]} seeds once its first rewards are given" in PAGE
    assert f"with a GRU in {of[f'{cell}-gru']}, with AMRL-Max in {of[f'{cell}-amrl_max']}" in PAGE
    assert f"and with AMRL-Avg in {of[f'{cell}-amrl_avg']}." in PAGE
    assert f"A2C in {of['a2c']}, REINFORCE in {of['reinforce']}, DQN in {of[one]} with one step" in PAGE
    assert f"and in {of[six]} with six. QRDQN+LSTM does in {of['qrdqn_lstm']}." in PAGE
    rows = {
        "DQN, 1 step": one,
        "DQN, 6 steps": six,
        "QRDQN+LSTM": "qrdqn_lstm",
        "AMRL-Avg": f"{cell}-amrl_avg",
        "MOHQA": "mohqa",
    }
    for row, name in rows.items():
        cells = [of.get((name, guided), "not run") for of in (solved, unique) for guided in (True, False)]
        assert f"| {row} | {' | '.join(cells)} |" in PAGE
    assert f"Backpropamine, which solves the shared graph in {of[f'{cell}-backpropamine']}" in PAGE
    assert (
        f"It did not show here: MOHQA solves that graph in {unique['mohqa', True]} seeds" in PAGE
        and unique["mohqa", True] == "0 of 5"
    )
    assert f"PPO without one solves the graph in {unique[f'{cell}-none', True]} seeds" in PAGE


def test_what_the_page_says_in_words_of_the_claims_holds(hardest, told_apart):
    best = {key: max(values) for key, values in hardest.items()}
    to_find = [value for (_, given), value in best.items() if not given]
    by_name = {name: values for (name, given), values in told_apart.items() if given}

    assert set(to_find) == {0.0}
    assert f"the greedy policies of {len(to_find)} of {len(to_find)} agents get nothing there in any seed" in PAGE
    found = {name for (name, given), values in told_apart.items() if not given and max(values) >= 0.9}
    assert found == {"dqn, 6 steps"}
    assert "the claim holds here of every agent that was run, an LSTM and a GRU among them, but of DQN with six" in PAGE
    assert f"unique decisions in {sum(v >= 0.9 for v in told_apart['dqn, 6 steps', False])} of 5 seeds" in PAGE
    assert all(best[name, True] < 0.9 for name in ("a2c", "reinforce", "dqn, 1 step", "dqn, 6 steps", "lstm_ppo-none"))
    assert all(sum(value >= 0.9 for value in hardest[f"lstm_ppo-amrl_{kind}", True]) >= 4 for kind in ("max", "avg"))
    assert sum(value >= 0.9 for value in hardest["lstm_ppo-backpropamine", True]) >= 3
    assert "With first rewards given it does not hold of AMRL, nor of Backpropamine" in PAGE
    assert all(sum(value >= 0.9 for value in by_name[name]) <= 1 for name in ("a2c", "reinforce", "dqn, 1 step"))
    assert all(min(by_name[name]) >= 0.9 for name in ("dqn, 6 steps", "qrdqn_lstm"))
    assert "The claim then still holds of A2C, REINFORCE and DQN with one step" in PAGE
    assert "It does not hold of DQN with six steps and of QRDQN+LSTM" in PAGE


def test_one_step_dqn_alone_meets_rewards_where_they_must_be_found_on_the_shared_graph(cells):
    lines = cells.finished()[cells.TO_FIND[0]]
    met = {name: sum(float(line["sampled_return"]) for line in of) / len(of) for name, of in lines.items()}

    assert {name for name, mean in met.items() if mean > 0.01} == {"dqn, 1 step"}
    assert "DQN with one step alone meets rewards more than once in a hundred episodes" in PAGE


def ladder_lines() -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Lines of the search and of the ladder."""
    with open(FOLDER / "memory_ladder.csv", newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    return [line for line in lines if int(line["seed"]) >= 100], [line for line in lines if int(line["seed"]) < 100]


SETTINGS = ("num_envs", "num_steps", "learning_rate", "entropy_coeff")


def setting(line: dict[str, str]) -> tuple[float, ...]:
    return tuple(float(line[key]) for key in SETTINGS)


def test_each_memory_has_the_setting_of_the_ladder_that_did_best_in_a_search_over_all_settings(cells):
    found, ladder = ladder_lines()
    scores: dict[str, dict[tuple[float, ...], list[float]]] = {}
    for line in found:
        assert (line["depth"], line["expected_length"], line["frames"]) == ("2", "100", "409600")
        both = float(line["greedy_return"]) + float(line["sampled_return"])
        scores.setdefault(line["agent"], {}).setdefault(setting(line), []).append(both / 2)
    variants = OmegaConf.load(CHECKOUT / "conf/experiment/memory_ladder.yaml").hydra.sweeper.variants
    given = {"lstm_ppo" if v.cell == "lstm" else f"lstm_ppo-{v.cell}": v for v in variants}

    for agent, of in scores.items():
        assert len(of) == 8 and all(len(values) == 2 for values in of.values())
        best = max(sum(values) for values in of.values())
        assert sum(of[tuple(float(given[agent][f"agent.{key}"]) for key in SETTINGS)]) == pytest.approx(best)
        row = PAGE.split("## By the length")[1].split(f"| {cells.AGENTS[agent]} |")[1].split("|")[:8]
        assert [float(each.strip(" *")) for each in row] == pytest.approx([sum(of[key]) / 2 for key in of], abs=0.0051)
        assert [place for place, each in enumerate(row) if "**" in each] == [
            next(place for place, values in enumerate(of.values()) if sum(values) == best)
        ]
    assert all(
        setting(line) == tuple(float(given[line["agent"]][f"agent.{key}"]) for key in SETTINGS) for line in ladder
    )


def test_what_the_page_says_in_words_of_the_ladder_holds(cells):
    ladder = ladder_lines()[1]
    solved = {
        (name, length): sum(float(line["greedy_return"]) >= 0.9 for line in lines)
        for (name, length), lines in cells.groups(
            [line for line in ladder if line["depth"] == "2"], "agent", "expected_length"
        ).items()
        if len(lines) == 5
    }
    names = {"AMRL-Avg": "amrl_avg", "a GRU": "gru", "AMRL-Max": "amrl_max", "minGRU": "min_gru"}

    for words, name in names.items():
        assert f"{words} in {solved[f'lstm_ppo-{name}', '100']} of 5" in PAGE
    assert f"an LSTM in {solved['lstm_ppo', '100']} of 5." in PAGE
    assert "With 300 steps no cell solves any graph that was run, in 409,600 frames" in PAGE
    assert not any(float(line["greedy_return"]) >= 0.9 for line in ladder if line["expected_length"] == "300")
    best = setting(next(line for line in ladder if line["agent"] == "lstm_ppo"))
    of_search = [line for line in ladder_lines()[0] if line["agent"] == "lstm_ppo" and setting(line) == best]
    found = sum(float(line["greedy_return"]) >= 0.9 for line in of_search)
    assert f"in {found} of 2 seeds of the search, and in {solved['lstm_ppo', '100']} of 5 of the ladder" in PAGE
    assert {line["frames"] for line in ladder} == {"409600"}
    in_search = [line["num_steps"] for line in ladder_lines()[0] if float(line["greedy_return"]) >= 0.9]
    assert in_search.count("128") > 2 * in_search.count("32") and "more often where gradients reach back 128" in PAGE
