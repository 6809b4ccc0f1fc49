"""docs/results/memory.md: made from the raw results beside it, and what it says of them holds."""

from __future__ import annotations

import csv
import itertools
import re
import shlex
from collections import defaultdict

import numpy as np
import pytest
from helpers.paths import CHECKOUT
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from ctgraph_rl import CTGraphEnv
from ctgraph_rl.report import statistics
from ctgraph_rl.runs import config
from ctgraph_rl.tasks.values import random_frames_to_goal
from curricula import co_hard

FOLDER = CHECKOUT / "docs" / "results"
PAGE = " ".join((FOLDER / "memory.md").read_text(encoding="utf-8").split())
CONF = CHECKOUT / "conf" / "experiment"
RIVALS = (
    "DQN (1 step)",
    "DQN (6 steps)",
    "QRDQN+LSTM",
    "REINFORCE (8 steps)",
    "REINFORCE (128 steps)",
    "A2C (8 steps)",
    "A2C (32 steps)",
    "AMRL-Max",
    "AMRL-Avg",
    "Backpropamine",
)
LONG = ("A2C (32 steps)", "REINFORCE (128 steps)")
"""Agents that ran on some of the graphs."""
BY_STEPS = {"a2c": 8, "reinforce": 128}
"""Agents whose runs differ in the steps of a batch, and what their files in ``conf/agent`` say."""
GRAPH = ("wait_prob", "unique_decisions", "num_wait_images", "seed")
SETTINGS = ("num_envs", "num_steps", "learning_rate", "entropy_coeff")

Lines = list[dict[str, str]]


@pytest.fixture(scope="module")
def cells():
    from studies.memory import page

    return page


@pytest.fixture(scope="module")
def names(cells) -> dict[str, str]:
    """What the page calls each agent."""
    return cells.graphs.AGENTS


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


def says(part: str, of: dict[str, Lines]) -> bool:
    """Whether a list such as ``4 of 5: LSTM, GRU; 0 of 5: the other 7`` has every agent with its number of seeds."""
    numbers = {name: number(lines) for name, lines in of.items()}
    every = re.fullmatch(r"(\d) of 5 with all (\d+) agents", part.strip(" ."))
    if every:
        return set(numbers.values()) == {int(every[1])} and len(numbers) == int(every[2])
    for group in part.strip(" .").split("; "):
        found, names = group.split(" of 5: ")
        own = {name for name in numbers if numbers[name] == int(found)}
        if names != f"the other {len(own)}" and set(named(names)) != own:
            return False
        numbers = {name: each for name, each in numbers.items() if name not in own}
    return not numbers


@pytest.mark.slow
def test_the_page_is_what_its_raw_results_make(cells):
    assert cells.page() == (FOLDER / "memory.md").read_text(encoding="utf-8")


def test_each_run_is_one_line_with_the_share_of_the_gap_or_its_reason(cells):
    conditions = {
        "memory_cells": (*GRAPH[:3], "guide_frames", "read_noise"),
        "memory_ladder": ("depth", "expected_length", *SETTINGS),
    }

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
        assert len(lines) == 5
        assert row[place - 1] == f"{number(lines)} ({at_any_evaluation(lines)})"
    solve = [rival for rival in RIVALS if number(of[rival]) > 1]
    if given:
        said = (
            "On unique ones it does not hold for ([^.]*)"
            if unique
            else "it does not hold for (.*?) on shared decisions"
        )
        assert named(re.search(said, table)[1]) == solve
    else:
        assert solve == []


def test_what_the_page_says_in_words_of_the_hardest_graphs_holds(names):
    shared, to_find = (on_hardest(False, given, names) for given in (True, False))
    unique, unique_to_find = (on_hardest(True, given, names) for given in (True, False))
    recurrent = ("LSTM", "GRU", "minGRU", "AMRL-Max", "AMRL-Avg", "Backpropamine")

    counts = [number(shared[name]) for name in recurrent]
    assert (min(counts), max(counts)) == (3, 5)
    assert "six recurrent PPO agents solves the hardest graph in three to five of five seeds.** That graph has" in PAGE
    assert says(PAGE.split("Seeds that solve it after training: ")[1].split(" - **")[0], shared)
    assert says(PAGE.split("solve the graph with shared decisions: ")[1].split(". With unique")[0], to_find)
    assert says(PAGE.split(". With unique decisions: ")[1].split(" - **")[0], unique_to_find)
    assert sum(map(number, to_find.values())) + sum(map(number, unique_to_find.values())) <= 2
    assert "Nearly all agents fail where they must find the first reward themselves" in PAGE
    task = co_hard(wait_prob=0.9).tasks[0]
    assert 1.5 < 409_600 / random_frames_to_goal(task) < 2.5 and "frames hold about two rewards under random" in PAGE
    assert f"meets a reward once in {1 / task.graph.reward_prob_random:,.0f} episodes" in PAGE
    assert all(number(unique[name]) >= 4 and number(shared[name]) >= 4 for name in ("AMRL-Max", "AMRL-Avg"))
    assert "AMRL solves both graphs once first rewards are given" in PAGE
    assert all(number(each.get(name, [])) <= 1 for each in (to_find, unique_to_find) for name in (*RIVALS, "MOHQA"))
    assert "agrees with these results where first rewards must be found. But MOHQA does poorly there, too" in PAGE
    solvers = {name for name in RIVALS if number(shared.get(name, [])) > 1}
    assert solvers == {"AMRL-Max", "AMRL-Avg", "Backpropamine"} < {name for name in RIVALS if number(unique[name]) > 1}
    assert {name for name in RIVALS if number(unique[name]) > 1} - solvers == {"QRDQN+LSTM", "DQN (6 steps)", *LONG}
    assert "With first rewards given it holds for some rivals only" in PAGE


def test_the_steps_of_batches_of_reinforce_and_a2c_are_compared_by_counts_of_seeds(names):
    unique = on_hardest(True, True, names)
    of_100 = read("memory_cells", "wait_prob", "unique_decisions", "num_wait_images", "guide_frames", "agent")
    graph = ("0.9", "True", "100", "204800")
    keys = ("reinforce, 8 steps", "reinforce, 128 steps")
    on_100 = [f"{number(of_100[*graph, key])} of {len(of_100[*graph, key])}" for key in keys]
    count = {name: f"{number(unique[name])} of {len(unique[name])}" for name in unique}

    short, long = count["REINFORCE (8 steps)"], count["REINFORCE (128 steps)"]
    assert (short, long) == ("0 of 5", "5 of 5")
    assert f"At p = 0.9, 8 steps solve {short} seeds and 128 steps {long}. At p = 0.5 it is" in PAGE
    words = f"it solves p = 0.9 in {on_100[0]} seeds with 8 steps and in {on_100[1]} with 128"
    assert f"With 100 wait images and unique decisions {words}" in PAGE
    assert "Over both numbers of wait images each of ten pairs of seeds differs in these directions" in PAGE
    for wait_prob, sign in (("0.9", 1), ("0.5", -1)):
        differences = []
        for images in ("100", "500"):
            lines = (of_100[wait_prob, "True", images, "204800", key] for key in keys)
            short_lines, long_lines = (sorted(each, key=lambda line: line["seed"]) for each in lines)
            for one, other in zip(short_lines, long_lines, strict=True):
                differences.append(sign * (float(other["greedy_return"]) - float(one["greedy_return"])))
        assert len(differences) == 10 and min(differences) > 0 and round(2 / 2**10, 3) == 0.002
        half = [number(of_100[wait_prob, "True", "500", "204800", key]) for key in keys]
        assert wait_prob == "0.9" or f"At p = 0.5 it is {half[0]} of 5 and {half[1]} of 5." in PAGE
    of_half = [f"{number(of_100['0.5', 'True', '100', '204800', key])} of 5" for key in keys]
    assert f"p = 0.5 in {of_half[0]} and {of_half[1]}." in PAGE


@pytest.mark.parametrize("steps", [8, 32, 128])
def test_the_share_of_frames_whose_episode_a_batch_cuts_off_is_that_of_simulated_episodes(steps):
    rng = np.random.default_rng(0)
    shares = []
    for wait_prob in (0.0, 0.5, 0.9):
        lengths = rng.geometric(1 - wait_prob, (300_000, 3)).sum(1) + 3
        ends = np.concatenate([[0], lengths.cumsum()])
        edges = np.arange(steps, ends[-1], steps)
        ages = edges - ends[ends.searchsorted(edges, side="right") - 1]
        shares.append(100 * np.minimum(ages, steps).mean() / steps)

    part = PAGE.split("continues, at p = 0, 0.5 and 0.9, is ")[1].split("So REINFORCE")[0]
    said = re.search(rf"([\d, %and]+) with {steps}\b", part)[1]

    assert [float(each) for each in re.findall(r"\d+(?= %)", said)] == pytest.approx(shares, abs=0.7)


def test_totals_over_all_graphs_are_counted_from_the_raw_results(names):
    table = PAGE.split("## All graphs")[1].split("## The published claim")[0]
    after = PAGE.split("**What is lost.** ")[1].split("[memory_cells.csv]")[0]
    lines = read("memory_cells", "guide_frames", "read_noise", "agent")
    given = {names[key[-1]]: of for key, of in lines.items() if key[:-1] == ("204800", "0")}
    paired = {
        name: [float(line["greedy_return"]) for line in sorted(of, key=lambda line: [line[key] for key in GRAPH])]
        for name, of in given.items()
    }
    others = [name for name in given if name != "LSTM"]
    found = [statistics.compare(paired[name], paired["LSTM"], bounds=(0, 1)) for name in others]
    p_values = dict(zip(others, statistics.holm([each.p_value for each in found]), strict=True))

    assert set(given) == set(names.values())
    assert {len(of) for of in given.values()} == {45}
    for name in (*others, "LSTM"):
        assert f"| {name} | {number(given[name])} | {at_any_evaluation(given[name])} | " in table
    lower = [name for name in others if p_values[name] <= 0.05]
    others_said = re.findall(r"([\w+-]+) (-?[\d.]+) \[", PAGE.split("Their differences: ")[1].split(" - **")[0])
    differences = {name: each.difference.value for name, each in zip(others, found, strict=True)}
    assert f"{len(lower)} agents have lower returns than the LSTM (p <= 0.05, Holm)" in PAGE
    assert {name for name, _ in others_said} == {name for name in others if p_values[name] > 0.05}
    assert all(float(shown) == pytest.approx(differences[name], abs=0.0051) for name, shown in others_said)
    assert all(sum(paired[name]) < sum(paired["LSTM"]) for name in lower)
    lost = [line for key, of in lines.items() if key[1] == "0" for line in of if line["frames_to_90"]]
    gone = [line for line in lost if float(line["greedy_return"]) < 0.9]
    assert f"Of {len(lost)} runs that solved the task at an evaluation, {len(gone)} did not after training" in after
    noisy = [line for key, of in lines.items() if key[1] == "25" for line in of]
    agents = {line["agent"] for line in noisy}
    plain = [
        line
        for key, of in lines.items()
        if key[:2] == ("204800", "0") and key[2] in agents
        for line in of
        if line["unique_decisions"] == "False" and line["wait_prob"] != "0"
    ]
    words = f"{number(noisy)} of {len(noisy)} runs with noise and {number(plain)} of {len(plain)} without"
    assert f"shared decisions and first rewards given, the LSTM and the GRU solve {words}." in PAGE
    readme = (CHECKOUT / "README.md").read_text(encoding="utf-8")
    assert f"PPO with an LSTM solves {number(given['LSTM'])} of 45 runs if a scripted policy first shows it" in readme
    assert sum(number(on_hardest(unique, False, names)["LSTM"]) for unique in (False, True)) == 0


def line_of(cell: dict[str, str]) -> tuple[str, ...]:
    """The agent, the seed and the condition of a cell of a sweep, as the raw results have them."""
    name = cell["agent"] if cell.get("cell", "lstm") == "lstm" else f"{cell['agent']}-{cell['cell']}"
    if name == "dqn":
        name = {"1": "dqn, 1 step", "6": "dqn, 6 steps"}[cell["agent.n_steps"]]
    if name in BY_STEPS:
        name = f"{name}, {cell.get('agent.num_steps', BY_STEPS[name])} steps"
    ladder = ("curriculum.depth", "curriculum.expected_length", *(f"agent.{key}" for key in SETTINGS))
    graph = ("wait_prob", "unique_decisions", "num_wait_images", "guide_frames", "read_noise")
    places = {"guide_frames": "protocol.guide_frames"}
    keys = ladder if "curriculum.depth" in cell else [places.get(key, f"curriculum.{key}") for key in graph]
    return name, cell["seed"], *(cell[key].replace("true", "True").replace("false", "False") for key in keys)


def runs_of(command: str) -> set[tuple[str, ...]]:
    """What `line_of` returns for each run of a command of the page."""
    name, *arguments = shlex.split(command.split("experiment=")[1])
    experiment = OmegaConf.load(CONF / f"{name}.yaml")
    parser = OverridesParser.create()
    variants = [argument for argument in arguments if argument.startswith("hydra.sweeper.variants=")]
    given = dict(argument.split("=") for argument in arguments if argument not in variants)
    fixed = {"protocol.guide_frames": experiment.protocol.guide_frames, "curriculum.read_noise": 0}
    found = set()
    for variant in parser.parse_override(variants[0]).value() if variants else experiment.hydra.sweeper.variants:
        of = {**fixed, **experiment.hydra.sweeper.params, **variant, **given}
        parsed = {key: parser.parse_override(f"{key}={value}") for key, value in of.items()}
        choices = (
            [(key, value) for value in (each.sweep_string_iterator() if each.is_sweep_override() else [str(of[key])])]
            for key, each in parsed.items()
        )
        found |= {line_of(dict(cell)) for cell in itertools.product(*choices)}
    return found


@pytest.mark.slow
def test_the_commands_of_the_page_make_its_runs(cells):
    text = (FOLDER / "memory.md").read_text(encoding="utf-8").replace("\\\n", " ")
    commands = [line for line in text.splitlines() if line.startswith("ctgraph-rl -m experiment=")]
    conditions = {
        "memory_cells": (*GRAPH[:3], "guide_frames", "read_noise"),
        "memory_ladder": ("depth", "expected_length", *SETTINGS),
    }
    recorded = (set(read(name, "agent", "seed", *keys)) for name, keys in conditions.items())

    assert set().union(*map(runs_of, commands)) == set().union(*recorded)


@pytest.mark.slow
def test_agents_have_the_weights_and_take_the_gradient_steps_that_the_page_says(compose):
    env = CTGraphEnv([co_hard().tasks[0]])
    words = {"dqn": "DQN, targets of 1 or 6 steps", "mohqa": "MOHQA", "lstm_ppo": "PPO with each cell"}
    words |= {"qrdqn_lstm": "QRDQN+LSTM, targets of 6 steps", "a2c, 8": "A2C (8 steps)", "a2c, 32": "A2C (32 steps)"}
    words |= {"reinforce, 8": "REINFORCE (8 steps)", "reinforce, 128": "REINFORCE (128 steps)"}
    weights, settings = defaultdict(set), defaultdict(set)
    experiments = [OmegaConf.load(CONF / f"{name}.yaml") for name in ("memory_cells", "memory_returns")]
    for variant in (each for experiment in experiments for each in experiment.hydra.sweeper.variants):
        cfg = compose(*(f"{key}={value}" for key, value in variant.items()))
        agent = config.target(cfg, "agent")(env.observation_spec_unbatched, env.action_spec_unbatched)
        updates = cfg.agent.get("num_updates", cfg.agent.get("num_epochs", 1) * cfg.agent.get("num_minibatches", 1))
        name = f"{variant.agent}, {cfg.agent.num_steps}" if variant.agent in BY_STEPS else variant.agent
        weights[name].add(sum(each.numel() for each in agent.weights))
        size = cfg.agent.num_envs * cfg.agent.num_steps
        batch = f"{cfg.agent.num_envs} x {cfg.agent.num_steps}"
        exploration = "none" if variant.agent == "reinforce" else f"entropy bonus {cfg.agent.get('entropy_coeff')}"
        if "eps_end" in cfg.agent:
            steps = f"{cfg.agent.annealing_num_steps:,}"
            exploration = f"epsilon from {cfg.agent.eps_init:g} to {cfg.agent.eps_end} over {steps} frames"
        own = f"{cfg.agent.learning_rate}", batch, f"{409_600 // size * updates:,}", f"{cfg.agent.gamma}", exploration
        settings[name].add(own)

    for name, row in words.items():
        cells = [each.strip() for each in PAGE.split("## Methods")[1].split(f"| {row} |")[1].split("|")]
        assert cells[0] == " to ".join(f"{each:,}" for each in sorted({min(weights[name]), max(weights[name])}))
        assert {(cells[1], cells[2], cells[4], cells[5], cells[6])} == settings[name]


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

    assert set(given) == set(scores)
    for agent, of in scores.items():
        assert len(of) == 8 and all(len(values) == 2 for values in of.values())
        best = max(sum(values) for values in of.values())
        assert sum(of[tuple(float(given[agent][f"agent.{key}"]) for key in SETTINGS)]) == pytest.approx(best)
    assert all(
        setting(line) == tuple(float(given[line["agent"]][f"agent.{key}"]) for key in SETTINGS) for line in ladder
    )


def test_what_the_page_says_of_mohqa_with_its_published_settings_holds():
    with open(FOLDER / "mohqa_published.csv", newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))

    assert [(line["agent"], line["frames"], line["unique_decisions"]) for line in lines] == [
        ("mohqa", "1000000", "True")
    ] * 2
    assert [float(line["greedy_return"]) for line in lines] == [0.28, 0.31]
    assert "two seeds end at 0.28 and 0.31 (0 of 2 seeds solve it, 1 at any evaluation)" in PAGE
    assert [line["frames_to_90"] for line in lines] == ["", "600000"]
    assert (
        "one of two seeds with its published settings solves the graph with unique decisions, and only for a time"
        in PAGE
    )


def test_what_the_page_says_in_words_of_the_ladder_holds(names):
    search, ladder = ladder_lines()
    of = defaultdict(dict)
    for line in ladder:
        of[line["depth"], line["expected_length"]].setdefault(names[line["agent"]], []).append(line)

    assert {line["frames"] for line in ladder} == {"409600"}
    assert says(PAGE.split("expected length of 100 steps: ")[1].split(". With 300")[0], of["2", "100"])
    assert says(PAGE.split("With 300 steps: ")[1].split(" - **")[0], of["2", "300"])
    longest = [line for (_, length), each in of.items() if length == "300" for lines in each.values() for line in lines]
    assert number(longest) == 0 and "No agent solves episodes of 300 steps" in PAGE
    best = setting(next(line for line in ladder if line["agent"] == "lstm_ppo"))
    found = number([line for line in search if line["agent"] == "lstm_ppo" and setting(line) == best])
    assert f"in {found} of 2 seeds of the search and in {number(of['2', '100']['LSTM'])} of 5 of the ladder" in PAGE
    short = [line for line in longest if float(line["training_length"]) < 10]
    assert f"{len(short)} of {len(longest)} runs end with training episodes of fewer than 10 steps and without" in PAGE
    assert "these agents leave wait states at once" in PAGE
    assert {float(line["training_return"]) for line in short} == {0.0}
    at_100 = [float(line["training_length"]) for lines in of["2", "100"].values() for line in lines]
    assert f"{sum(each < 10 for each in at_100)} of {len(at_100)} runs end in the same way" in PAGE
