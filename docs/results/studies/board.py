"""The page board.md, its figure and the board's files, from the submissions in ``board``."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from ctgraph_rl.board.standings.board_formats import columns
from ctgraph_rl.board.standings.board_page import write_board
from ctgraph_rl.board.standings.board_tables import BoardTable
from ctgraph_rl.board.tracks import tracks
from ctgraph_rl.draw.style import new_figure, save_figure
from studies.raw import HERE, fill, table
from studies.verdicts import undecided

ELSEWHERE = ("average performance", "bytes of the agent", "steps", "n", "hours", "level")
"""Columns that only the board itself has: the page names seeds and levels once."""


@cache
def written() -> list[BoardTable]:
    """Write the files of the board; return its tables."""
    return write_board([HERE / "board"], HERE / "board").tables


def page(tables: list[BoardTable] | None = None) -> str:
    """Return the page of some tables, by default those of the submissions."""
    tables = tables or written()
    several = [f"## {each.title}\n\n{_table(each)}" for each in tables if len(each.standings) > 1]
    alone = [_line(each) for each in tables if len(each.standings) == 1]
    there = {each.track.name for each in tables}
    lacking = [f"`{each.name}`" for each in tracks() if each.name not in there]
    texts = {
        "tables": "\n\n".join(several),
        "alone": table(["track and rung", "given", "method", "score", "bytes per task", "landmarks"], alone),
        "count": sum(len(each.standings) for each in tables),
        "without": f" No line yet: {', '.join(lacking)}." if lacking else "",
        "clearest": _clearest(tables[0]),
    }
    return fill("board", texts)


def _clearest(of: BoardTable) -> str:
    """Return the clearest difference of two lines of the first ranks, whose order is open."""
    names = {line.name for line in of.standings if line.best_rank == 1}
    found = {pair: each for pair, each in of.pairs.items() if names.issuperset(pair)}
    one, other = min(found, key=lambda pair: found[pair].p_value or 0)
    return f"{one} less {other}, {undecided(found[one, other])}"


def _table(of: BoardTable) -> str:
    rows = []
    for line in of.standings:
        cells = [cell for cell in columns(line) if cell.head not in ELSEWHERE]
        rank, *others = cells
        shown = [f"{cell.shown} {cell.interval}".strip() for cell in others]
        rows.append([rank.shown.replace(" to ", "-"), *shown])
    return table([cell.head for cell in cells], rows)


def _line(of: BoardTable) -> list[str]:
    """Return the cells of a table's only line, beside what policies get that lack what the track is about."""
    standing = of.standings[0]
    cells = {cell.head: cell.shown for cell in columns(standing)}
    learned = ", ".join(filter(None, (of.track.id, of.variant.rung)))
    score, _, interval = str(standing.score).partition(" n = ")[0].partition(" ")
    about = [cells["method"], f"{score} {interval}", cells["bytes per task"]]
    return [learned, of.variant.given, *about, _landmarks(of.ceilings)]


def _landmarks(ceilings: dict[str, float | None]) -> str:
    """Return the returns of policies that lack what a track is about."""
    parts = [f"random {ceilings['random policy']:.2g}"]
    memoryless = ceilings["best policy without memory"]
    search = ceilings["best search for a goal that is not known"]
    if memoryless is not None and memoryless < 1:
        parts.append(f"no memory {memoryless:.2f}")
    if search is not None:
        parts.append(f"best search {search:.3f}")
    return ", ".join(parts)


def draw(folder: Path) -> None:
    """Draw every seed, the mean and its interval of each submission of the first table, beside its bytes."""
    of = written()[0]
    lines = list(reversed(of.standings))
    figure = new_figure(7.2, 0.32 * len(lines) + 0.9)
    axes = figure.subplots()
    for row, line in enumerate(lines):
        score = line.score
        axes.plot(line.entry.scores, [row] * len(line.entry.scores), "|", color="0.6", markersize=9)
        axes.plot([score.low, score.high], [row, row], color="tab:blue", linewidth=2)
        axes.plot(score.value, row, "o", color="tab:blue", markersize=5)
        size = line.entry.method["bytes_per_task"]
        axes.annotate(f"{size:,} bytes", (1.03, row), va="center", fontsize=8, annotation_clip=False)
    axes.set_yticks(range(len(lines)), [f"{line.name}  ({line.rank})" for line in lines], fontsize=8)
    axes.set_xlim(0, 1.01)
    axes.set_xlabel("normalised performance: mean and 95 % interval, and every seed", fontsize=8)
    axes.set_title(f"{of.title} (rank); at the right: kept for a further task", fontsize=9)
    axes.grid(axis="x", alpha=0.3)
    save_figure(figure, folder / "board.png")
