"""The figures of memory.md."""

from __future__ import annotations

from pathlib import Path

from ctgraph_rl.draw.style import new_figure, save_figure
from studies.figures import draw_grid, draw_seeds
from studies.memory.conditions import AGENTS, GIVEN, LADDER, SEEDS, finished, solved
from studies.memory.graphs import ceiling
from studies.raw import numbers_in, read, select

DPI = 220


def draw_returns(path: Path) -> None:
    """Draw the greedy return of every seed with first rewards given: a row of panels for each p."""
    figure = new_figure(7.2, 7.4)
    panels = figure.subplots(3, 4, sharex=True, sharey=True)
    for axes in panels[0, 1:]:
        axes.set_axis_off()
    for axes, condition in zip([panels[0, 0], *panels[1:].flat], GIVEN, strict=True):
        of = finished()[condition]
        draw_seeds(axes, {AGENTS[name]: numbers_in(lines, "greedy_return") for name, lines in of.items()})
        for row, lines in enumerate(of.values()):
            axes.text(1.17, row, str(sum(solved(lines))), ha="center", va="center", fontsize=6)
        if ceiling(of) < 1:
            axes.axvline(ceiling(of), color="0.55", linewidth=0.8, linestyle="--")
        graph = f"{condition.num_wait_images} wait images,\n{condition.decisions} decisions"
        axes.set_title(f"p = {condition.wait_prob}\n{graph}", fontsize=7)
        axes.set(xlim=(-0.08, 1.26))
    for axes in [panels[0, 0], *panels[2]]:
        axes.set_xlabel("greedy return", fontsize=7)
        axes.tick_params(labelbottom=True)
    seed, mean, *_, best = panels[0, 0].lines
    names = ["best policy without memory", "a seed", "mean"]
    key = panels[0, 1].legend([best, seed, mean], names, fontsize=7, loc="upper left", frameon=False)
    key.set_in_layout(False)  # so that it may reach into the empty panels beside it
    save_figure(figure, path, DPI)


def draw_ladder(path: Path) -> None:
    """Draw how many seeds solve each rung of the ladder, a panel for each depth."""
    cells = [name for name in AGENTS if name.startswith("lstm_ppo") and name != "lstm_ppo-attention"]
    figure = new_figure(7.2, 0.9 + 0.24 * len(cells))
    panels = figure.subplots(1, 3, sharey=True)
    lines = [line for line in read(LADDER) if line["seed"] not in ("100", "101")]  # those of the search
    for axes, depth in zip(panels, "234", strict=True):
        lengths = ["6" if depth == "2" else "10", "30", "100", "300"]
        rungs = [select(lines, depth=depth, expected_length=length) for length in lengths]
        rows = [[sum(solved(select(rung, agent=name))) for rung in rungs] for name in cells]
        draw_grid(axes, rows, "{}", [AGENTS[name] for name in cells], lengths, colours="Greys", most=1.2 * SEEDS)
        axes.set_title(f"depth {depth}", fontsize=8)
        axes.set_xlabel("expected episode length (steps)", fontsize=7)
    save_figure(figure, path, DPI)
