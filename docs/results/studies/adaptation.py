"""Agents that adapt to a uniform goal, beside the best search: adaptation.md."""

from __future__ import annotations

from collections.abc import Sequence
from math import fsum
from pathlib import Path
from statistics import fmean
from string import Template
from typing import Any

from ctgraph_rl.report import statistics
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.report.statistics import Comparison
from studies import adaptation_swap
from studies.raw import (
    HERE,
    TEMPLATES,
    Raw,
    groups,
    machines,
    mean_of,
    read,
    shown,
    table,
)
from studies.verdicts import seeds_that_would_do

NAME = "adaptation"
PAGE = HERE / "adaptation.md"
PICTURE = HERE / "adaptation.png"

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


def lines_of(depth: int, kind: str) -> Raw:
    """Return the lines of one graph."""
    return [line for line in read(NAME) if (line["depth"], line["kind"]) == (str(depth), kind)]


def runs(depth: int, kind: str = FULL) -> dict[tuple[str, ...], dict[tuple[str, ...], Raw]]:
    """Return the lines of each seed of each agent and gate on a graph, in the order of `LABELS` and `GATES`."""
    lines = lines_of(depth, kind)
    of = groups(lines, "agent", "gate")
    order = [(agent, gate) for agent in LABELS for gate in GATES if (agent, gate) in of]
    return {key: groups(of[key], "seed") for key in order}


def graph_label(depth: int, kind: str) -> str:
    """Return what a graph is called in a table or above a panel."""
    return str(depth) if kind == FULL else f"{depth}, {kind}"


def first(lines: Raw) -> float:
    """Return the success of a run's first episodes, before any adaptation."""
    return float(lines[0]["success"])


def adapted(lines: Raw) -> float:
    """Return the mean success of a run's episodes after the adaptation."""
    after = [float(line["success"]) for line in lines if int(line["episode"]) > int(line["adapt_episodes"])]
    return fmean(after)


def regret(lines: Raw) -> float:
    """Return the goals that a run's rows miss beside the best search, in all of their episodes."""
    return fsum(float(line["best_search"]) - float(line["success"]) for line in lines)


def bounds_of_regret(lines: Raw) -> Bounds:
    """Return the regret of episodes that all succeed by chance, below 0, and of an agent that never succeeds."""
    best = fsum(float(line["best_search"]) for line in lines)
    return Bounds(best - len(lines), best)


def successes(depth: int, kind: str = FULL) -> dict[str, str]:
    """Return the success after adaptation of each agent and gate in words, by ``AGENT`` or ``AGENT_GATE``.

    ``KIND_`` stands before it on graphs that are not fully observable. The range over seeds has ``_seeds`` behind it.
    """
    found = {}
    start = "" if kind == FULL else f"{kind}_"
    for (agent, gate), of in runs(depth, kind).items():
        seeds = [adapted(lines) for lines in of.values()]
        name = start + (agent if gate == "none" else f"{agent}_{gate}")
        count = f"{len(seeds)} seeds" if len(seeds) > 1 else "one seed"
        found[name] = f"{mean_of(seeds, SUCCESS)} ({count})"
        found[f"{name}_seeds"] = f"{min(seeds):.2f} to {max(seeds):.2f}"
    return found


def adaptation_table(depth: int) -> str:
    """Return a row for each agent without a gate: means over seeds with their intervals; a row for the best search."""
    rows = []
    best: Raw = []
    for (agent, gate), of in runs(depth).items():
        if gate == "none":
            seeds = list(of.values())
            best = seeds[0]
            rows.append(
                [
                    LABELS[agent],
                    str(len(seeds)),
                    best[0]["frames"],
                    mean_of([first(lines) for lines in seeds], SUCCESS),
                    mean_of([adapted(lines) for lines in seeds], SUCCESS),
                    mean_of([regret(lines) for lines in seeds], bounds_of_regret(best)),
                ]
            )
    rows.append(["*best search*", "exact", "-", best[0]["best_search"], "1.00", "0.00"])
    head = ["agent", "seeds", "frames", "success in episode 1", "success after adaptation", "regret"]
    return table(head, rows)


def gates_table(depth: int) -> str:
    """Return a row for each agent with gates and a column for each gate: success after adaptation, mean over seeds."""
    found = runs(depth)
    agents = dict.fromkeys(agent for agent, gate in found if gate != "none")
    rows = []
    for agent in agents:
        of_gates = [found.get((agent, gate), {}).values() for gate in GATES]
        means = [mean_of([adapted(lines) for lines in seeds], SUCCESS) if seeds else "-" for seeds in of_gates]
        rows.append([LABELS[agent], *means])
    return table(["agent", *(f"`{gate}`" for gate in GATES)], rows)


Runs = dict[tuple[str, ...], dict[tuple[str, ...], Raw]]
"""The lines of each seed, by agent and gate."""


def against(found: Runs, first: tuple[str, ...], second: tuple[str, ...]) -> Comparison:
    """Compare the success after adaptation of two agents with their gates, on the seeds that both have."""
    seeds = [seed for seed in found[first] if seed in found[second]]
    values, others = ([adapted(found[key][seed]) for seed in seeds] for key in (first, second))
    return statistics.compare(values, others, bounds=SUCCESS)


RIVALS = ("cavia", "rl2", "maml")
"""Agents below PEARL."""


def differences() -> dict[str, str]:
    """Return what the page says of differences of agents and of a gate."""
    of = runs(2)
    found = {name: against(of, ("pearl", "none"), (name, "none")) for name in RIVALS}
    gated = against(of, ("pearl", "none"), ("pearl", "hard_straight_through"))
    return {
        **{f"pearl_{name}": shown(each.difference) for name, each in found.items()},
        "order_seeds": str(max(seeds_that_would_do(each) or 0 for each in found.values())),
        "gate_of_pearl": shown(gated.difference),
    }


def draw(path: Path) -> None:
    """Draw the success in each episode of a row, without gates: a panel for each graph, a line for each seed."""
    from ctgraph_rl.draw.style import new_figure, save_figure

    graphs = [(1, FULL), (2, FULL), (3, FULL), (2, SURJECTIVE)]
    figure = new_figure(7.2, 3.0)
    panels = figure.subplots(1, len(graphs), sharey=True)
    for axes, (depth, kind) in zip(panels, graphs, strict=True):
        _draw_graph(axes, depth, kind)
    panels[0].set_ylabel("share at the goal")
    legends = [axes.get_legend_handles_labels() for axes in panels]
    handles, labels = max(legends, key=lambda legend: len(legend[1]))
    figure.legend(handles, labels, loc="outside upper left", ncols=6, fontsize=7)
    save_figure(figure, path, 220)


def _draw_graph(axes: Any, depth: int, kind: str) -> None:
    lines: Raw = []
    for position, agent in enumerate(LABELS):
        of = runs(depth, kind).get((agent, "none"), {})
        for number, lines in enumerate(of.values()):
            success = [float(line["success"]) for line in lines]
            name = LABELS[agent] if number == 0 else None
            axes.plot(range(1, len(lines) + 1), success, color=f"C{position}", linewidth=0.9, label=name)
    best = [float(line["best_search"]) for line in lines_of(depth, kind)][: len(lines)]
    axes.plot(range(1, len(best) + 1), best, "k--", linewidth=1, label="best search")
    if kind == SURJECTIVE:
        axes.axhline(WITHOUT_MEMORY, color="0.5", linestyle=":", linewidth=1, label="most without memory")
    axes.set_title(f"depth {graph_label(depth, kind)}", fontsize=9)
    axes.set(xlabel="episode of a row", ylim=(-0.05, 1.05))


def table_of_graphs(graphs: Sequence[tuple[int, str]]) -> str:
    """Return a row for each graph and agent with its success after adaptation: means over seeds with intervals."""
    rows = []
    for depth, kind in graphs:
        for (agent, _), of in runs(depth, kind).items():
            seeds = list(of.values())
            after = mean_of([adapted(lines) for lines in seeds], SUCCESS)
            rows.append([graph_label(depth, kind), LABELS[agent], str(len(seeds)), seeds[0][0]["frames"], after])
    return table(["depth", "agent", "seeds", "frames", "success after adaptation"], rows)


def page() -> str:
    """Return the page: its template with its tables and numbers."""
    text = (TEMPLATES / "adaptation.md").read_text(encoding="utf-8")
    return Template(text).substitute(
        successes(2) | successes(2, SURJECTIVE) | differences(),
        gates=gates_table(2),
        without_memory=f"{WITHOUT_MEMORY:.3f}",
        depth_2=adaptation_table(2),
        other_graphs=table_of_graphs([(1, FULL), (3, FULL), (2, SURJECTIVE)]),
        swap=adaptation_swap.swap_table(),
        rl2_swap=mean_of(adaptation_swap.shares("rl2", held_out=True), SUCCESS),
        penn_a_swap=mean_of(adaptation_swap.shares("penn_a", held_out=True), SUCCESS),
        best_swap=f"{adaptation_swap.best_search(goals=4, swapped=True):.2f}",
        machines=machines(NAME, adaptation_swap.NAME),
    )


def make() -> None:
    """Write the page and its figure."""
    draw(PICTURE)
    PAGE.write_text(page(), encoding="utf-8")
