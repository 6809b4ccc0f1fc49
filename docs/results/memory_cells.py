"""Memories on confounding graphs: raw results, and memory.md and its figure, which are made of them.

``python docs/results/memory_cells.py collect RUNS`` writes memory_cells.csv from the finished runs of the experiments
``memory_cells`` and ``memory_ladder`` under a folder; ``python docs/results/memory_cells.py`` makes the page, which has
numbers of an agent in a condition once all its seeds are there.
"""

from __future__ import annotations

import argparse
import json
import re
from itertools import product
from pathlib import Path
from string import Template
from typing import Any

from raw import HERE, Raw, groups, machine_of, machines, mean_of, read, table, write

NAME = "memory_cells"
SEEDS = 5

TAIL = 40_960
"""The last frames of a run, over whose training episodes the return of the acting policy is taken."""

CONDITION = ("depth", "expected_length", "wait_prob", "unique_decisions", "num_wait_images", "guide_frames", "frames")

AGENTS = {
    "lstm_ppo": "LSTM",
    "lstm_ppo-gru": "GRU",
    "lstm_ppo-min_gru": "minGRU",
    "lstm_ppo-amrl_max": "AMRL-Max",
    "lstm_ppo-amrl_avg": "AMRL-Avg",
    "lstm_ppo-backpropamine": "Backpropamine",
    "lstm_ppo-frames": "frame stacking",
    "lstm_ppo-none": "no memory",
    "a2c": "A2C",
    "reinforce": "REINFORCE",
    "dqn, 1 step": "DQN, 1 step",
    "dqn, 6 steps": "DQN, 6 steps",
    "qrdqn_lstm": "QRDQN+LSTM",
    "mohqa": "MOHQA",
}
"""Names of agents with their cells, in the order of the page; PPO where no other algorithm is named."""


def measured(run: Path) -> dict[str, Any]:
    """Return the line of a finished run: its condition, its final returns, and how soon it was near the optimum."""
    from ctgraph_rl.log.files import LOG
    from ctgraph_rl.log.run_log import RunLog

    log = RunLog.read(run / LOG)
    about, metrics = log.of_kind("run")[0], json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    config, curriculum = about["config"], about["config"]["curriculum"]
    evaluations, training = log.of_kind("evaluation"), log.of_kind("training")
    frames, best = training[-1]["frames"], metrics["optimal_performance"]["value"]
    last = [line for line in training if line["frames"] > frames - TAIL and line["episodes"]]
    episodes = sum(line["episodes"] for line in last)
    reached = (line["frames"] for line in evaluations if best is not None and line["return_mean"] >= 0.9 * best)
    length = curriculum["expected_length"]
    gap, name = metrics["memory_gap_closed"], run.name.split("-seed")[0]
    steps = {"dqn": config["agent"].get("n_steps")}.get(name)
    return {
        "agent": name if steps is None else f"{name}, {steps} step{'s' * (steps > 1)}",
        "seed": config["seed"],
        "depth": curriculum["depth"],
        "expected_length": length or "",
        "wait_prob": "" if length else curriculum["wait_prob"],
        "unique_decisions": curriculum["unique_decisions"],
        "num_wait_images": curriculum["num_wait_images"],
        "guide_frames": config["protocol"]["guide_frames"] or 0,
        "frames": frames,
        "greedy_return": evaluations[-1]["return_mean"],
        "sampled_return": round(sum(line["return_mean"] * line["episodes"] for line in last) / episodes, 6),
        "frames_to_90": next(reached, ""),
        "memory_gap_closed": gap["value"] if gap["value"] is not None else gap["undefined"],
        "optimum": best,
        "ceiling_without_memory": metrics["memoryless_ceiling"]["value"],
        **machine_of(about),
    }


def collect(folder: Path) -> None:
    """Write the raw results of the finished runs under a folder."""
    lines = [measured(path.parent) for path in sorted(folder.rglob("metrics.json")) if "experts" not in path.parts]
    order = list(AGENTS)
    write(
        NAME,
        sorted(
            lines, key=lambda line: (*(str(line[key]) for key in CONDITION), order.index(line["agent"]), line["seed"])
        ),
    )


def finished() -> dict[tuple[str, ...], dict[str, Raw]]:
    """Return the lines of each condition and agent with all seeds, conditions and agents in the order of the page."""
    found = {}
    for condition, lines in groups(read(NAME), *CONDITION).items():
        of = {agent: each for (agent,), each in groups(lines, "agent").items() if len(each) >= SEEDS}
        if of:
            found[condition] = {agent: of[agent] for agent in AGENTS if agent in of}
    return dict(sorted(found.items(), key=lambda item: [float(value or 0) for value in (*item[0][:3], item[0][4])]))


def solved(lines: Raw) -> list[bool]:
    """Return for each seed whether its greedy return is at least 0.9."""
    return [float(line["greedy_return"]) >= 0.9 for line in lines]


def cell(lines: Raw | None) -> str:
    """Return how many seeds solve the task, and the mean greedy return and that of acting in training."""
    if lines is None:
        return ""
    means = (mean_of([float(line[key]) for line in lines], (0, 1)) for key in ("greedy_return", "sampled_return"))
    return f"{sum(solved(lines))} of {len(lines)}; {'; '.join(means)}"


def title(condition: tuple[str, ...]) -> str:
    """Return a condition in words."""
    _, _, wait_prob, unique, images, guide, _ = condition
    rewards = "first rewards given" if guide != "0" else "first rewards to be found"
    return f"p = {wait_prob}, {images} wait images, {'unique' if unique == 'True' else 'shared'} decisions, {rewards}"


def graphs() -> dict[tuple[str, ...], dict[str, Raw]]:
    """Return the finished conditions that differ in the graph and in first rewards."""
    return {condition: of for condition, of in finished().items() if not condition[1]}


def graph_table() -> str:
    """Return a line for each agent and a column for each condition."""
    of = graphs()
    rows = [[AGENTS[name], *(cell(each.get(name)) for each in of.values())] for name in AGENTS]
    rows = [row for row in rows if any(row[1:])]
    ceilings = [next(iter(each.values()))[0]["ceiling_without_memory"] for each in of.values()]
    rows.append(["*ceiling without memory*", *(f"*{float(value):.2f}*" for value in ceilings)])
    return table(["", *map(title, of)], rows)


def speed_table() -> str:
    """Return the frames to 90 % of the optimum, where all agents of a condition have them at the same moments."""
    of = {condition: each for condition, each in graphs().items() if condition[5] != "0"}
    rows = []
    for name in AGENTS:
        each = [[float(line["frames_to_90"] or "nan") for line in one.get(name, [])] for one in of.values()]
        each = [[None if value != value else value for value in values] for values in each]
        if any(value is not None for values in each for value in values):
            found = [mean_of(values, (0, float(c[6]))) if values else "" for c, values in zip(of, each, strict=True)]
            rows.append([AGENTS[name], *found])
    return table(["", *map(title, of)], rows)


def ladder_table() -> str:
    """Return a line for each depth and cell, a column for each expected length."""
    of = {condition[:2]: each for condition, each in finished().items() if condition[1]}
    lengths = sorted({length for _, length in of}, key=float)
    rows = []
    for depth in sorted({depth for depth, _ in of}):
        for name in AGENTS:
            cells = [cell(of.get((depth, length), {}).get(name)) for length in lengths]
            if any(cells):
                rows.append([depth, AGENTS[name], *cells])
    return table(["depth", "", *(f"{length} steps" for length in lengths)], rows)


SHARED_OR_UNIQUE = ("False", "True")
PLANNED = [
    *product(("0.9",), SHARED_OR_UNIQUE, ("500",), ("0",)),
    *product(("0", "0.5", "0.9"), SHARED_OR_UNIQUE, ("100", "500"), ("204800",)),
]
"""Waiting probability, unique decisions, wait images and guided frames of the conditions of the experiment."""

LADDER = [(depth, length) for depth in "234" for length in (("6" if depth == "2" else "10"), "30", "100", "300")]
"""Depth and expected length of the conditions of the ladder."""


def not_run() -> str:
    """Return a list of what the page has no number of."""
    of = {condition[2:6]: each for condition, each in graphs().items()}
    of_ladder = {condition[:2]: each for condition, each in finished().items() if condition[1]}
    cells = [name for name in AGENTS if name.startswith("lstm_ppo")]
    wanted = [(title(("", "", *graph, "")), list(AGENTS), of.get(graph, {})) for graph in PLANNED]
    wanted += [
        (f"depth {depth}, {length} steps", cells, of_ladder.get((depth, length), {})) for depth, length in LADDER
    ]
    lines = []
    for what, agents, each in wanted:
        missing = [AGENTS[name] for name in agents if name not in each]
        if missing:
            lines.append(f"- {what}: {'all' if len(missing) == len(agents) else ', '.join(missing)}.")
    return "\n".join(lines)


HARDEST, UNIQUE = ("0.9", "False", "500"), ("0.9", "True", "500")
"""Waiting probability, unique decisions and wait images of the graphs that the published claim can be about."""


def count(agent: str, graph: tuple[str, ...] = HARDEST, guide: str = "204800") -> str:
    """Return in how many seeds an agent solves a graph, as ``4 of 5``; ``not run`` where it was not."""
    of = {condition[2:6]: each for condition, each in graphs().items()}.get((*graph, guide), {})
    return f"{sum(solved(of[agent]))} of {len(of[agent])}" if agent in of else "not run"


def counts() -> dict[str, str]:
    """Return the numbers within the text of the page."""
    found = {}
    for name in AGENTS:
        key = re.sub("[^a-z0-9]+", "_", name.removeprefix("lstm_ppo-"))
        found |= {key: count(name), f"find_{key}": count(name, guide="0"), f"unique_{key}": count(name, UNIQUE)}
    to_find = {condition[2:6]: each for condition, each in graphs().items()}[*HARDEST, "0"]
    none = [name for name, lines in to_find.items() if all(float(line["greedy_return"]) == 0 for line in lines)]
    runs = [line for each in graphs().values() for lines in each.values() for line in lines if line["frames_to_90"]]
    lost = [line for line in runs if float(line["greedy_return"]) < 0.9]
    return {**found, "found_none": str(len(none)), "found_of": str(len(to_find)), "lost": f"{len(lost)} of {len(runs)}"}


def page() -> str:
    """Return the page: the template with its tables and numbers."""
    template = Template((HERE / "memory_template.md").read_text(encoding="utf-8"))
    tables = {"graphs": graph_table(), "speed": speed_table(), "ladder": ladder_table(), "not_run": not_run()}
    return template.substitute(tables, machines=machines(NAME), **counts())


def draw(path: Path) -> None:
    """Draw the greedy return of every seed with first rewards given, on graphs that more than one agent has learned."""
    from ctgraph_rl.visualize.style import new_figure, save_figure

    of = {condition: each for condition, each in graphs().items() if condition[5] != "0" and len(each) > 1}
    figure = new_figure(3.2 + 2.4 * (len(of) - 1), 3.4)
    panels = figure.subplots(1, len(of), sharey=True, squeeze=False)[0]
    names = [name for name in AGENTS if any(name in each for each in of.values())]
    for axes, (condition, each) in zip(panels, of.items(), strict=True):
        ceiling = float(next(iter(each.values()))[0]["ceiling_without_memory"])
        axes.axvline(ceiling, color="0.6", linewidth=0.8, linestyle="--")
        for place, name in enumerate(names):
            returns = [float(line["greedy_return"]) for line in each.get(name, [])]
            shifts = [place + 0.3 * (seed / (SEEDS - 1) - 0.5) for seed in range(len(returns))]
            axes.plot(returns, shifts, "o", color="0", markersize=3, alpha=0.6)
            if returns:
                axes.plot(sum(returns) / len(returns), place, "|", color="tab:red", markersize=9, markeredgewidth=1.8)
        axes.set_title(
            title(condition).removesuffix(", first rewards given").replace("images, ", "images,\n"), fontsize=8
        )
        axes.set_xlim(-0.05, 1.05)
        axes.set_xlabel("greedy return", fontsize=8)
    panels[0].set_yticks(range(len(names)), [AGENTS[name] for name in names], fontsize=7)
    panels[0].invert_yaxis()
    save_figure(figure, path)


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(prog="python docs/results/memory_cells.py", description=__doc__)
    commands = parser.add_subparsers(dest="command")
    collecting = commands.add_parser("collect", help="raw results from runs")
    collecting.add_argument("runs", type=Path, help="folder with runs")
    options = parser.parse_args()
    if options.command == "collect":
        collect(options.runs)
    else:
        (HERE / "memory.md").write_text(page(), encoding="utf-8")
        draw(HERE / "memory.png")


if __name__ == "__main__":
    main()
