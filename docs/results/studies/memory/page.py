"""Raw results of memory cells on confounding graphs, and memory.md and its figures, which are made of them.

The page has numbers of an agent in a condition once all its seeds are there.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from string import Template

from studies.memory import figures, graphs, ladder, published
from studies.memory.conditions import NAME, SHARED, TO_FIND, UNIQUE, Condition, finished
from studies.memory.runs import AGENTS, SETTINGS, count, measured, ranking
from studies.raw import HERE, TEMPLATES, Raw, grow, lost, machines, merged

LENGTHS = {
    "reinforce_short": "reinforce, 8 steps",
    "reinforce_long": "reinforce, 128 steps",
}
"""Agents that differ in the steps of their batches."""


def collect(name: str, folders: Sequence[Path], add: bool = False) -> None:
    """Add the finished runs under some folders to tables that grow until they have all runs of the stored ones.

    The table is of the experiment ``memory_cells``, memory_ladder.csv of ``memory_search`` and ``memory_ladder``.

    Args:
        name: of the first table.
        folders: with run directories.
        add: whether runs that are not under the folders stay as the stored tables have them.
    """
    paths = [path for folder in folders for path in folder.rglob("metrics.json") if "experts" not in path.parts]
    lines = [measured(path.parent) for path in paths]
    on_ladder = [line for line in lines if "expected_length" in line]
    on_graphs = [line for line in lines if "expected_length" not in line]
    tables: dict[str, Raw] = {}
    lacking: list[str] = []
    for table, own, keys in (
        (name, on_graphs, Condition._fields),
        (ladder.NAME, on_ladder, ("depth", "expected_length", *SETTINGS)),
    ):
        all_runs = merged(table, own, (*keys, "agent", "seed"), add)
        tables[table] = sorted(all_runs, key=partial(_place, keys))
        lacking += lost(table, all_runs, (*keys, "agent", "seed"))
    grow(tables, lacking)


def _place(keys: Sequence[str], line: dict[str, str]) -> tuple[list[float], int, int]:
    """Return what lines are ordered by: numbers of a condition, the place of the agent, and the seed."""
    return [_number(line[key]) for key in keys], list(AGENTS).index(line["agent"]), int(line["seed"])


def _number(value: object) -> float:
    """Return the number of a column, of which some hold truth values, as text or not."""
    return float(str(value) == "True") if str(value) in ("True", "False") else float(str(value))


def texts() -> dict[str, str]:
    """Return the numbers and lists within the text of the page."""
    of = finished()
    ranked = {"shared": SHARED, "find_shared": TO_FIND[0], "find_unique": TO_FIND[1]}
    found = {place: ranking(of.get(condition, {})) for place, condition in ranked.items()}
    found |= {f"cut_{steps}": graphs.cut_off(steps) for steps in (8, 32, 128)}
    for wait_prob, middle in (("0.9", ""), ("0.5", "_half")):
        for images, end in (("500", ""), ("100", "_100")):
            on_unique = of[UNIQUE._replace(wait_prob=wait_prob, num_wait_images=images)]
            for place, name in LENGTHS.items():
                found[f"{place}{middle}{end}"] = count(on_unique.get(name))
    found["lower"], found["undecided"] = graphs.lower_and_undecided()
    found |= {"lost": graphs.lost(), "with_noise": graphs.with_noise()}
    found |= {"solve_shared": graphs.better_than_poor(SHARED), "solve_unique": graphs.better_than_poor(UNIQUE)}
    return found | ladder.texts() | {"intervals": graphs.intervals(), "published": published.text()}


def page() -> str:
    """Return the page: the template with its tables and numbers."""
    template = Template((TEMPLATES / "memory.md").read_text(encoding="utf-8"))
    tables = {"totals": graphs.total_table(), "claim": graphs.claim_table()}
    return template.substitute(tables, machines=machines(NAME, ladder.NAME), **texts())


def make() -> None:
    """Write the page and its figures."""
    (HERE / "memory.md").write_text(page(), encoding="utf-8")
    figures.draw_returns(HERE / "memory.png")
    figures.draw_ladder(HERE / "memory_ladder.png")
