"""The page memory.md and its figures."""

from __future__ import annotations

from pathlib import Path

from studies.memory import figures, graphs, ladder
from studies.memory.conditions import NAME, SHARED, TO_FIND, UNIQUE, count, finished, ranking, solved, solved_once
from studies.raw import fill, machines, numbers_in, read


def published() -> str:
    """Return the greedy returns of MOHQA with its published settings, and how many seeds solve the task."""
    lines = read("mohqa_published")
    returns = " and ".join(f"{value:.2f}" for value in numbers_in(lines, "greedy_return"))
    after = f"{sum(solved(lines))} of {len(lines)} seeds solve it"
    return f"{returns} ({after}, {sum(solved_once(lines))} at any evaluation)"


def texts() -> dict[str, str]:
    """Return the numbers and lists within the text of the page."""
    of = finished()
    found = {"shared": ranking(of[SHARED])}
    found |= {"find_shared": ranking(of[TO_FIND[0]]), "find_unique": ranking(of[TO_FIND[1]])}
    found |= {f"cut_{steps}": graphs.cut_off(steps) for steps in (8, 32, 128)}
    for wait_prob, middle in (("0.9", ""), ("0.5", "_half")):
        for images, end in (("500", ""), ("100", "_100")):
            on_unique = of[UNIQUE._replace(wait_prob=wait_prob, num_wait_images=images)]
            found[f"reinforce_short{middle}{end}"] = count(on_unique["reinforce, 8 steps"])
            found[f"reinforce_long{middle}{end}"] = count(on_unique["reinforce, 128 steps"])
    found["lower"], found["undecided"] = graphs.lower_and_undecided()
    found |= {"lost": graphs.lost(), "with_noise": graphs.with_noise(), "published": published()}
    found |= {"solve_shared": graphs.better_than_poor(SHARED), "solve_unique": graphs.better_than_poor(UNIQUE)}
    return found


def page() -> str:
    """Return the page."""
    tables = {"totals": graphs.total_table(), "claim": graphs.claim_table(), "machines": machines(NAME, ladder.NAME)}
    return fill("memory", tables | texts() | ladder.texts())


def draw(folder: Path) -> None:
    """Draw the figures."""
    figures.draw_returns(folder / "memory.png")
    figures.draw_ladder(folder / "memory_ladder.png")
