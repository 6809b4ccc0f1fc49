"""Raw results of memory cells on confounding graphs, and memory.md and its figures, which are made of them.

The page has numbers of an agent in a condition once all its seeds are there.
"""

from __future__ import annotations

from string import Template

from studies.memory import figures, graphs, ladder
from studies.memory.conditions import NAME, SHARED, TO_FIND, UNIQUE, finished
from studies.memory.runs import count, ranking, solved, solved_once
from studies.raw import HERE, TEMPLATES, machines, numbers_in, read

PUBLISHED = "mohqa_published"

LENGTHS = {
    "reinforce_short": "reinforce, 8 steps",
    "reinforce_long": "reinforce, 128 steps",
}
"""Agents that differ in the steps of their batches."""


def published() -> str:
    """Return the greedy returns of MOHQA with its published settings, and how many seeds solve the task."""
    lines = read(PUBLISHED)
    returns = " and ".join(f"{value:.2f}" for value in numbers_in(lines, "greedy_return"))
    after = f"{sum(solved(lines))} of {len(lines)} seeds solve it"
    return f"{returns} ({after}, {sum(solved_once(lines))} at any evaluation)"


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
    return found | ladder.texts() | {"published": published()}


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
