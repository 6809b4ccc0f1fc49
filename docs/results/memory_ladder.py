"""How long memories last: the tables and the figure of a graph whose episodes get longer, for `memory_cells`.

memory_ladder.csv has the runs of two experiments. ``memory_search`` tries some values of `SETTINGS` for each cell on
one graph with the seeds of `SEARCHED`; ``memory_ladder`` gives each cell the setting that did best there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from memory_runs import AGENTS, CELLS, SEEDS, SETTINGS, cell, solved
from raw import Raw, groups, read, table

NAME = "memory_ladder"

SEARCHED = ("100", "101")
"""Seeds of the search, which the ladder does not have."""

RUNGS = [(depth, length) for depth in "234" for length in (("6" if depth == "2" else "10"), "30", "100", "300")]
"""Depth and expected length of the ladder's graphs; 10 is the shortest at depth 4."""


def searched() -> dict[str, dict[tuple[str, ...], Raw]]:
    """Return the lines of the search by agent and setting, settings in the order of the file."""
    lines = [line for line in read(NAME) if line["seed"] in SEARCHED]
    return {agent: groups(own, *SETTINGS) for (agent,), own in groups(lines, "agent").items()}


def score(lines: Raw) -> float:
    """Return what the search maximises: the mean over seeds of the greedy return and of that of acting in training."""
    return sum(float(line["greedy_return"]) + float(line["sampled_return"]) for line in lines) / (2 * len(lines))


def best(agent: str) -> tuple[str, ...]:
    """Return the setting that did best in the search, the first of equals."""
    of = searched()[agent]
    return max(of, key=lambda setting: score(of[setting]))


def search_table() -> str:
    """Return a line for each cell and a column for each setting, the best one in bold."""
    of = searched()
    settings = list(dict.fromkeys(setting for each in of.values() for setting in each))
    rows = []
    for name in (name for name in CELLS if name in of):
        scores = {setting: f"{score(lines):.2f}" for setting, lines in of[name].items()}
        scores[best(name)] = f"**{scores[best(name)]}**"
        rows.append([AGENTS[name], *(scores.get(setting, "") for setting in settings)])
    heads = [f"{steps} steps, {rate}, {entropy}" for _, steps, rate, entropy in settings]
    return table(["", *heads], rows)


def finished() -> dict[tuple[str, str], dict[str, Raw]]:
    """Return the lines of each rung and cell with all seeds."""
    found: dict[tuple[str, str], dict[str, Raw]] = {}
    lines = [line for line in read(NAME) if line["seed"] not in SEARCHED]
    for (depth, length, agent), own in groups(lines, "depth", "expected_length", "agent").items():
        if len(own) >= SEEDS:
            found.setdefault((depth, length), {})[agent] = own
    return found


def wanted() -> list[tuple[str, list[str], dict[str, Raw]]]:
    """Return the rungs in words, the agents that they are for, and what is finished of each."""
    of = finished()
    return [(f"depth {depth}, {length} steps", CELLS, of.get((depth, length), {})) for depth, length in RUNGS]


def ladder_table() -> str:
    """Return a line for each depth and cell, a column for each expected length."""
    of, rows = finished(), []
    for depth in "234":
        lengths = [length for each, length in RUNGS if each == depth]
        for name in CELLS:
            cells = [cell(of.get((depth, length), {}).get(name)) for length in lengths]
            if any(cells):
                rows.append([depth, AGENTS[name], *cells])
    return table(["depth", "", "6 steps (depth 2) or 10", "30 steps", "100 steps", "300 steps"], rows)


def draw(path: Path) -> None:
    """Draw how many seeds solve each rung, a panel for each depth."""
    from ctgraph_rl.visualize.style import new_figure, save_figure

    of = finished()
    names = [name for name in CELLS if any(name in each for each in of.values())]
    figure = new_figure(7.2, 0.9 + 0.24 * len(names))
    panels = figure.subplots(1, 3, sharey=True)
    for axes, depth in zip(panels, "234", strict=True):
        lengths = [length for each, length in RUNGS if each == depth]
        for row, name in enumerate(names):
            for column, length in enumerate(lengths):
                _square(axes, (column, row), of.get((depth, length), {}).get(name))
        axes.set(xlim=(-0.5, len(lengths) - 0.5), ylim=(len(names) - 0.5, -0.5))
        axes.set_title(f"depth {depth}", fontsize=8)
        axes.set_xticks(range(len(lengths)), lengths, fontsize=7)
        axes.set_xlabel("steps of an episode in the mean", fontsize=7)
        axes.tick_params(length=0)
    panels[0].set_yticks(range(len(names)), [AGENTS[name] for name in names], fontsize=7)
    save_figure(figure, path)


def _square(axes: Any, place: tuple[int, int], lines: Raw | None) -> None:
    """Draw the number of seeds that solve a rung on a grey that darkens with it."""
    column, row = place
    if not lines:
        axes.text(column, row, "not run", ha="center", va="center", fontsize=5, color="0.5")
        return
    number = sum(solved(lines))
    share = number / len(lines)
    axes.fill_between([column - 0.48, column + 0.48], row - 0.46, row + 0.46, color=str(1 - 0.8 * share), linewidth=0)
    axes.text(column, row, str(number), ha="center", va="center", fontsize=7, color="1" if share > 0.5 else "0")
