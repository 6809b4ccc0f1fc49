"""Raw results of memory cells on confounding graphs, and memory.md and its figures, which are made of them.

``python docs/results/memory_cells.py collect RUNS...`` writes memory_cells.csv from the finished runs of the experiment
``memory_cells`` under some folders, and memory_ladder.csv from those of ``memory_search`` and ``memory_ladder``;
``python docs/results/memory_cells.py`` makes the page, which has numbers of an agent in a condition once all its seeds
are there.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from string import Template

import memory_figures
import memory_graphs
import memory_ladder
from memory_conditions import GIVEN, NAME, NOISY, NOISY_AGENTS, SHARED, TO_FIND, UNIQUE, Condition, finished
from memory_runs import AGENTS, SETTINGS, count, measured, ranking, solved_once
from raw import HERE, machines, write


def collect(folders: list[Path]) -> None:
    """Write the raw results of the finished runs under some folders."""
    paths = [path for folder in folders for path in folder.rglob("metrics.json") if "experts" not in path.parts]
    lines, order = [measured(path.parent) for path in paths], list(AGENTS)
    on_ladder = [line for line in lines if "expected_length" in line]
    on_graphs = [line for line in lines if "expected_length" not in line]
    for name, own, keys in (
        (NAME, on_graphs, Condition._fields),
        (memory_ladder.NAME, on_ladder, ("depth", "expected_length", *SETTINGS)),
    ):
        place = [(*(float(line[key]) for key in keys), order.index(line["agent"]), line["seed"]) for line in own]
        write(name, [own[i] for i in sorted(range(len(own)), key=place.__getitem__)])


def not_run() -> str:
    """Return a list of what the page has no number of, or that it has all."""
    of, lines = finished(), []
    wanted = [(str(condition), list(AGENTS), of.get(condition, {})) for condition in [*GIVEN, *TO_FIND]]
    wanted += [(str(condition), list(NOISY_AGENTS), of.get(condition, {})) for condition in NOISY]
    for what, agents, each in [*wanted, *memory_ladder.wanted()]:
        missing = [AGENTS[name] for name in agents if name not in each]
        if missing:
            lines.append(f"- {what}: {'all' if len(missing) == len(agents) else ', '.join(missing)}.")
    return "\n".join(["Not run yet:\n", *lines]) if lines else "All runs that were planned are on this page."


def texts() -> dict[str, str]:
    """Return the numbers and lists within the text of the page."""
    of = finished()
    ranked = {"shared": SHARED, "find_shared": TO_FIND[0], "find_unique": TO_FIND[1]}
    found = {place: ranking(of.get(condition, {})) for place, condition in ranked.items()}
    for place, condition in (("unique", UNIQUE), ("find_unique", TO_FIND[1])):
        one_step = of[condition]["dqn, 1 step"]
        found |= {f"dqn_{place}": count(one_step), f"dqn_{place}_once": str(sum(solved_once(one_step)))}
        found[f"mohqa_{place}"] = count(of[condition].get("mohqa"))
    found["lower"], found["alike"] = memory_graphs.distinguishable()
    found |= {"lost": memory_graphs.lost(), "with_noise": memory_graphs.with_noise()}
    return found | memory_ladder.texts() | {"intervals": memory_graphs.intervals()}


def page() -> str:
    """Return the page: the template with its tables and numbers."""
    template = Template((HERE / "memory_template.md").read_text(encoding="utf-8"))
    tables = {
        "totals": memory_graphs.total_table(),
        "no_waits": memory_graphs.return_table(GIVEN[:1]),
        "some_waits": memory_graphs.return_table(GIVEN[1:5]),
        "long_waits": memory_graphs.return_table(GIVEN[5:]),
        "to_find": memory_graphs.return_table(TO_FIND),
        "noise": memory_graphs.noise_table(),
        "speed_shared": memory_graphs.speed_table("shared"),
        "speed_unique": memory_graphs.speed_table("unique"),
        "claim": memory_graphs.claim_table(),
        "verdicts": memory_graphs.verdict_table(),
        "search": memory_ladder.search_table(),
        **{f"ladder_depth_{depth}": memory_ladder.ladder_table(depth) for depth in "234"},
        "not_run": not_run(),
    }
    return template.substitute(tables, machines=machines(NAME, memory_ladder.NAME), **texts())


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
        memory_figures.draw_returns(HERE / "memory.png")
        memory_figures.draw_ladder(HERE / "memory_ladder.png")


if __name__ == "__main__":
    main()
