"""Agents that adapt to a uniform goal, beside the best search: adaptation.md."""

from __future__ import annotations

from collections.abc import Sequence
from math import fsum
from pathlib import Path
from statistics import fmean
from typing import Any

from ctgraph_rl.draw.style import new_figure, save_figure
from ctgraph_rl.report import statistics
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.report.statistics import Comparison
from studies import adaptation_swap
from studies.raw import Raw, fill, groups, machines, mean_of, numbers_in, read, select, shown, table

NAME = "adaptation"

LABELS = {
    "rl2": "RL^2",
    "cavia": "CAVIA",
    "maml": "MAML",
    "pearl": "PEARL",
}
GATES = ("none", "soft", "hard", "hard_straight_through")
SUCCESS = (0.0, 1.0)

FULL = "full"
SURJECTIVE = "surjective"

WITHOUT_MEMORY = (1 + 1 + 0.25 + 0.25) / 4
"""The most that a policy which sees one image at all decisions gets, over the goals 1.1, 2.2, 1.2 and 2.1."""

RIVALS = ("cavia", "rl2", "maml")
"""Agents below PEARL."""

Runs = dict[tuple[str, ...], dict[tuple[str, ...], Raw]]
"""The lines of each seed, by agent and gate."""


def runs(depth: int, kind: str = FULL) -> Runs:
    """Return the lines of each seed of each agent and gate on a graph, in the order of `LABELS` and `GATES`."""
    of = groups(select(read(NAME), depth=str(depth), kind=kind), "agent", "gate")
    order = [(agent, gate) for agent in LABELS for gate in GATES if (agent, gate) in of]
    return {key: groups(of[key], "seed") for key in order}


def graph_label(depth: int, kind: str) -> str:
    """Return what a graph is called in a table or above a panel."""
    return str(depth) if kind == FULL else f"{depth}, {kind}"


def adapted(lines: Raw) -> float:
    """Return the mean success of a run's episodes after the adaptation."""
    after = [line for line in lines if int(line["episode"]) > int(line["adapt_episodes"])]
    return fmean(numbers_in(after, "success"))


def all_adapted(of: dict[tuple[str, ...], Raw]) -> str:
    """Return the success after adaptation: the mean over seeds with its interval."""
    return mean_of([adapted(lines) for lines in of.values()], SUCCESS)


def regret(lines: Raw) -> float:
    """Return the goals that a run's rows miss beside the best search, in all of their episodes."""
    return fsum(float(line["best_search"]) - float(line["success"]) for line in lines)


def successes(kind: str, prefix: str) -> dict[str, str]:
    """Return the success after adaptation of each agent at depth 2 without a gate, in words; and its range."""
    found = {}
    for (agent, gate), of in runs(2, kind).items():
        if gate == "none":
            seeds = [adapted(lines) for lines in of.values()]
            found[f"{prefix}{agent}"] = f"{all_adapted(of)} ({len(of)} seeds)"
            found[f"{prefix}{agent}_seeds"] = f"{min(seeds):.2f} to {max(seeds):.2f}"
    return found


def adaptation_table() -> str:
    """Return a row for each agent without a gate at depth 2, and a row for the best search."""
    rows = []
    best: Raw = []
    for (agent, gate), of in runs(2).items():
        if gate == "none":
            best, *_ = of.values()
            most = fsum(numbers_in(best, "best_search"))
            bounds = Bounds(most - len(best), most)  # all episodes succeed by chance, or none
            first = [float(lines[0]["success"]) for lines in of.values()]
            missed = [regret(lines) for lines in of.values()]
            row = [LABELS[agent], str(len(of)), best[0]["frames"], mean_of(first, SUCCESS)]
            rows.append([*row, all_adapted(of), mean_of(missed, bounds)])
    rows.append(["*best search*", "exact", "-", best[0]["best_search"], "1.00", "0.00"])
    head = ["agent", "seeds", "frames", "success in episode 1", "success after adaptation", "search regret"]
    return table(head, rows)


def gates_table() -> str:
    """Return a row for each agent with gates and a column for each gate: success after adaptation at depth 2."""
    found = runs(2)
    rows = []
    for agent in dict.fromkeys(agent for agent, gate in found if gate != "none"):
        of_gates = [found.get((agent, gate)) for gate in GATES]
        rows.append([LABELS[agent], *(all_adapted(of) if of else "-" for of in of_gates)])
    return table(["agent", *(f"`{gate}`" for gate in GATES)], rows)


def table_of_graphs(graphs: Sequence[tuple[int, str]]) -> str:
    """Return a row for each graph and agent with its success after adaptation."""
    rows = []
    for depth, kind in graphs:
        for (agent, _), of in runs(depth, kind).items():
            frames = next(iter(of.values()))[0]["frames"]
            rows.append([graph_label(depth, kind), LABELS[agent], str(len(of)), frames, all_adapted(of)])
    return table(["depth", "agent", "seeds", "frames", "success after adaptation"], rows)


def against(found: Runs, first: tuple[str, ...], second: tuple[str, ...]) -> Comparison:
    """Compare the success after adaptation of two agents with their gates, on the seeds that both have."""
    seeds = [seed for seed in found[first] if seed in found[second]]
    values, others = ([adapted(found[key][seed]) for seed in seeds] for key in (first, second))
    return statistics.compare(values, others, bounds=SUCCESS)


def differences() -> dict[str, str]:
    """Return what the page says of differences of agents and of a gate."""
    of = runs(2)
    pearl = ("pearl", "none")
    found = {}
    seeds = []
    for name in RIVALS:
        each = against(of, pearl, (name, "none"))
        found[f"pearl_{name}"] = shown(each.difference)
        seeds.append(statistics.corrected({name: each})[name].needed or 0)
    found["order_seeds"] = str(max(seeds))
    found["gate_of_pearl"] = shown(against(of, pearl, ("pearl", "hard_straight_through")).difference)
    return found


def page() -> str:
    """Return the page."""
    tables = {
        "gates": gates_table(),
        "without_memory": f"{WITHOUT_MEMORY:.3f}",
        "depth_2": adaptation_table(),
        "other_graphs": table_of_graphs([(1, FULL), (3, FULL), (2, SURJECTIVE)]),
        "swap": adaptation_swap.swap_table(),
        "rl2_swap": mean_of(adaptation_swap.shares("rl2", held_out=True), SUCCESS),
        "penn_a_swap": mean_of(adaptation_swap.shares("penn_a", held_out=True), SUCCESS),
        "best_swap": f"{adaptation_swap.best_search(goals=4, swapped=True):.2f}",
        "machines": machines(NAME, adaptation_swap.NAME),
    }
    return fill(NAME, successes(FULL, "") | successes(SURJECTIVE, "surjective_") | differences() | tables)


def draw(folder: Path) -> None:
    """Draw the success in each episode of a row, without gates: a panel for each graph, a line for each seed."""
    graphs = [(1, FULL), (2, FULL), (3, FULL), (2, SURJECTIVE)]
    figure = new_figure(7.2, 3.0)
    panels = figure.subplots(1, len(graphs), sharey=True)
    for axes, (depth, kind) in zip(panels, graphs, strict=True):
        _draw_graph(axes, depth, kind)
    panels[0].set_ylabel("share at the goal")
    handles, labels = panels[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=6, fontsize=7)
    save_figure(figure, folder / "adaptation.png", 220)


def _draw_graph(axes: Any, depth: int, kind: str) -> None:
    lines: Raw = []
    for position, agent in enumerate(LABELS):
        of = runs(depth, kind).get((agent, "none"), {})
        for number, lines in enumerate(of.values()):
            name = LABELS[agent] if number == 0 else None
            episodes = range(1, len(lines) + 1)
            axes.plot(episodes, numbers_in(lines, "success"), color=f"C{position}", linewidth=0.9, label=name)
    best = numbers_in(lines, "best_search")
    axes.plot(range(1, len(best) + 1), best, "k--", linewidth=1, label="best search")
    if kind == SURJECTIVE:
        axes.axhline(WITHOUT_MEMORY, color="0.5", linestyle=":", linewidth=1, label="most without memory")
    axes.set_title(f"depth {graph_label(depth, kind)}", fontsize=9)
    axes.set(xlabel="episode of a row", ylim=(-0.05, 1.05))
