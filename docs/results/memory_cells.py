"""Memories on confounding graphs: raw results, and memory.md and its figures, which are made of them.

``python docs/results/memory_cells.py collect RUNS...`` writes memory_cells.csv from the finished runs of the experiment
``memory_cells`` under some folders, and memory_ladder.csv from those of ``memory_search`` and ``memory_ladder``;
``python docs/results/memory_cells.py`` makes the page, which has numbers of an agent in a condition once all its seeds
are there.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import memory_ladder
from memory_runs import AGENTS, SEEDS, SETTINGS, cell, count, measured, returns, solved
from raw import HERE, Raw, groups, machines, mean_of, read, table, write

NAME = "memory_cells"

NOISE = "25"
"""The largest addition to each pixel in the conditions with noise."""

GUIDED = "204800"
"""The frames over which a policy that navigates gives the first rewards."""


class Condition(NamedTuple):
    """What an agent learned from, as the columns of memory_cells.csv have it."""

    wait_prob: str
    unique_decisions: str
    num_wait_images: str
    guide_frames: str = GUIDED
    read_noise: str = "0"

    def __str__(self) -> str:
        """Return the condition in words."""
        rewards = "first rewards given" if self.guide_frames != "0" else "first rewards to be found"
        noise = f", noise up to {self.read_noise}" if self.read_noise != "0" else ""
        return f"p = {self.wait_prob}, {self.graph}, {rewards}{noise}"

    @property
    def graph(self) -> str:
        """Return what differs between graphs with the same waits, in words."""
        return (
            f"{self.num_wait_images} wait images, {'unique' if self.unique_decisions == 'True' else 'shared'} decisions"
        )


GRAPHS = list(product(("False", "True"), ("100", "500")))
"""Unique decisions and wait images of the graphs with waits."""

GIVEN = [
    Condition("0", "False", "100"),
    *(Condition(wait_prob, *graph) for wait_prob in ("0.5", "0.9") for graph in GRAPHS),
]
"""The conditions with first rewards given, in the order of the page; the first one is CT-CO-B1."""

TO_FIND = [Condition("0.9", unique, "500", "0") for unique in ("False", "True")]
NOISY = [
    Condition(wait_prob, "False", images, GUIDED, NOISE) for wait_prob in ("0.5", "0.9") for images in ("100", "500")
]
HARDEST, UNIQUE = Condition("0.9", "False", "500"), Condition("0.9", "True", "500")
"""The graphs that the published claim can be about."""


def collect(folders: list[Path]) -> None:
    """Write the raw results of the finished runs under some folders."""
    paths = [path for folder in folders for path in folder.rglob("metrics.json") if "experts" not in path.parts]
    lines, order = [measured(path.parent) for path in paths], list(AGENTS)
    for name, keys in ((NAME, Condition._fields), (memory_ladder.NAME, ("depth", "expected_length", *SETTINGS))):
        own = [
            (*(float(line[key]) for key in keys), order.index(line["agent"]), line["seed"], line)
            for line in lines
            if keys[0] in line
        ]
        write(name, [line for *_, line in sorted(own, key=lambda each: each[:-1])])


def finished() -> dict[Condition, dict[str, Raw]]:
    """Return the lines of each condition and agent with all seeds, agents in the order of the page."""
    found: dict[Condition, dict[str, Raw]] = {}
    for condition, lines in groups(read(NAME), *Condition._fields).items():
        of = {agent: each for (agent,), each in groups(lines, "agent").items() if len(each) >= SEEDS}
        found[Condition(*condition)] = {agent: of[agent] for agent in AGENTS if agent in of}
    return found


def columns(conditions: list[Condition]) -> dict[Condition, dict[str, Raw]]:
    """Return what is finished of some conditions, in their order."""
    of = finished()
    return {condition: of[condition] for condition in conditions if of.get(condition)}


def return_table(conditions: list[Condition]) -> str:
    """Return a line for each agent and a column for each condition."""
    of = columns(conditions)
    rows = [[AGENTS[name], *(cell(each.get(name)) for each in of.values())] for name in AGENTS]
    rows = [row for row in rows if any(row[1:])]
    ceilings = [next(iter(each.values()))[0]["ceiling_without_memory"] for each in of.values()]
    rows.append(["*ceiling without memory*", *(f"*{float(value):.2f}*" for value in ceilings)])
    return table(["", *heads(conditions, of)], rows)


def heads(conditions: list[Condition], of: Mapping[Condition, Any]) -> list[str]:
    """Return the heads of columns, which name p where it differs among the conditions."""
    one = len({condition.wait_prob for condition in conditions}) == 1
    return [condition.graph if one else f"p = {condition.wait_prob}, {condition.graph}" for condition in of]


def speed_table() -> str:
    """Return the frames to 90 % of the optimum with first rewards given."""
    of = columns(GIVEN)
    rows = []
    for name in AGENTS:
        each = [frames_to_90(one[name]) if name in one else None for one in of.values()]
        if any(value is not None for values in each for value in values or ()):
            found = [mean_of(values, (0, 409.6)) if values else "" for values in each]
            rows.append([AGENTS[name], *found])
    return table(["", *heads(GIVEN, of)], rows)


def frames_to_90(lines: Raw) -> list[float | None]:
    """Return the thousands of frames to 90 % of the optimum of each seed; None where it did not get there."""
    return [float(line["frames_to_90"]) / 1000 if line["frames_to_90"] else None for line in lines]


def noise_table() -> str:
    """Return a line for each graph and agent that learned with noise: its returns without and with it."""
    of, rows = finished(), []
    for noisy in NOISY:
        plain = of.get(noisy._replace(read_noise="0"), {})
        for name, lines in of.get(noisy, {}).items():
            rows.append([f"p = {noisy.wait_prob}, {noisy.graph}", AGENTS[name], cell(plain.get(name)), cell(lines)])
    return table(["", "", "without noise", f"noise up to {NOISE}"], rows)


def not_run() -> str:
    """Return a list of what the page has no number of."""
    of, lines = finished(), []
    of_noise = [name for name in AGENTS if name in ("lstm_ppo", "lstm_ppo-gru")]
    wanted = [(str(condition), list(AGENTS), of.get(condition, {})) for condition in [*GIVEN, *TO_FIND]]
    wanted += [(str(condition), of_noise, of.get(condition, {})) for condition in NOISY]
    for what, agents, each in [*wanted, *memory_ladder.wanted()]:
        missing = [AGENTS[name] for name in agents if name not in each]
        if missing:
            lines.append(f"- {what}: {'all' if len(missing) == len(agents) else ', '.join(missing)}.")
    return "\n".join(lines) or "- nothing that was planned."


def counts() -> dict[str, str]:
    """Return the numbers within the text of the page."""
    of, rung = finished(), memory_ladder.finished().get(("2", "100"), {})
    places = {"": of.get(HARDEST, {}), "unique_": of.get(UNIQUE, {}), "ladder_": rung}
    places |= {"find_": of.get(TO_FIND[0], {}), "find_unique_": of.get(TO_FIND[1], {})}
    keys = {name: re.sub("[^a-z0-9]+", "_", name.removeprefix("lstm_ppo-")) for name in AGENTS}
    found = {place + keys[name]: count(each.get(name)) for place, each in places.items() for name in AGENTS}
    found["search_lstm_ppo"] = count(memory_ladder.searched()["lstm_ppo"][memory_ladder.best("lstm_ppo")])
    to_find = places["find_"]
    none = [name for name, lines in to_find.items() if not any(returns(lines))]
    runs = [line for each in columns(GIVEN).values() for lines in each.values() for line in lines]
    reached = [line for line in runs if line["frames_to_90"]]
    lost = f"{len(reached) - sum(solved(reached))} of {len(reached)}"
    return {**found, "found_none": str(len(none)), "found_of": str(len(to_find)), "lost": lost}


def page() -> str:
    """Return the page: the template with its tables and numbers."""
    template = Template((HERE / "memory_template.md").read_text(encoding="utf-8"))
    tables = {
        "no_waits": return_table(GIVEN[:1]),
        "some_waits": return_table(GIVEN[1:5]),
        "long_waits": return_table(GIVEN[5:]),
        "to_find": return_table(TO_FIND),
        "noise": noise_table(),
        "speed": speed_table(),
        "search": memory_ladder.search_table(),
        "ladder": memory_ladder.ladder_table(),
        "not_run": not_run(),
    }
    return template.substitute(tables, machines=machines(NAME, memory_ladder.NAME), **counts())


def draw(path: Path) -> None:
    """Draw the greedy return of every seed with first rewards given: a panel for each graph, a row for each p."""
    from ctgraph_rl.visualize.style import new_figure, save_figure

    of = finished()
    figure = new_figure(12.8, 6.4)
    panels = figure.subplots(2, 5, sharex=True, sharey=True)
    names = [name for name in AGENTS if any(name in of.get(condition, {}) for condition in GIVEN)]
    for axes, condition in zip(panels.flat, [*GIVEN[1:5], GIVEN[0], *GIVEN[5:], None], strict=True):
        if condition is None or condition not in of:
            axes.set_visible(False)
            continue
        each = of[condition]
        ceiling = float(next(iter(each.values()))[0]["ceiling_without_memory"])
        axes.axvline(ceiling, color="0.6", linewidth=0.8, linestyle="--")
        for place, name in enumerate(names):
            values = returns(each.get(name, []))
            shifts = [place + 0.3 * (seed / (SEEDS - 1) - 0.5) for seed in range(len(values))]
            axes.plot(values, shifts, "o", color="0", markersize=3, alpha=0.6)
            if values:
                axes.plot(sum(values) / len(values), place, "|", color="tab:red", markersize=9, markeredgewidth=1.8)
        axes.set_title(f"p = {condition.wait_prob}, {condition.graph}".replace("images, ", "images,\n"), fontsize=8)
        axes.set(xlim=(-0.05, 1.05), ylim=(len(names) - 0.5, -0.5))
        axes.tick_params(labelsize=7)
    for axes in [*panels[1, :4], panels[0, 4]]:
        axes.set_xlabel("greedy return", fontsize=8)
        axes.tick_params(labelbottom=True)
    for axes in panels[:, 0]:
        axes.set_yticks(range(len(names)), [AGENTS[name] for name in names], fontsize=7)
    save_figure(figure, path)


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(prog="python docs/results/memory_cells.py", description=__doc__)
    commands = parser.add_subparsers(dest="command")
    collecting = commands.add_parser("collect", help="raw results from runs")
    collecting.add_argument("runs", type=Path, nargs="+", help="folders with runs")
    options = parser.parse_args()
    if options.command == "collect":
        collect(options.runs)
    else:
        (HERE / "memory.md").write_text(page(), encoding="utf-8")
        draw(HERE / "memory.png")
        memory_ladder.draw(HERE / "memory_ladder.png")


if __name__ == "__main__":
    main()
