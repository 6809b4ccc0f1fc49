"""The command ``ctgraph-rl collectives``: a page on runs with ``exchange=NAME``, its figures, and tidy tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from ctgraph_rl import parsers
from ctgraph_rl.checks import require
from ctgraph_rl.collective.summary import COLLECTIVE, RUN, WHAT, Collective, read_collective, tables
from ctgraph_rl.disk import make_folder, write_whole
from ctgraph_rl.learn.messages import DELAYED, DROPPED, SENT
from ctgraph_rl.log.escape import csv_text, markdown_table, markdown_text, refused_by, terminal_text
from ctgraph_rl.log.files import METRICS, locked
from ctgraph_rl.metrics.record import MASTERED
from ctgraph_rl.report.figures.gallery import CaptionedFigure, Gallery
from ctgraph_rl.report.style import MOST_AGENTS, WIDTH, agent_style, new_figure, require_packages, short
from ctgraph_rl.report.terminal import print_note
from ctgraph_rl.strict import files_below

MEASURES = ("learning_time", "share_learned", "final_return")

COLUMNS = (*RUN, "every", "drop_prob", "delay_prob", *MEASURES, *WHAT, "bytes", "helps")

SHOWN = (*RUN, *MEASURES, SENT, DROPPED, DELAYED, "bytes", "helps")

MEANING = (
    f"learning_time: mean over members and blocks of the frames until {MASTERED} of a batch are at the goal; a block "
    "without one counts with all its frames. share_learned: share of blocks with one. final_return: sum over members "
    "of the mean return of the last five batches of a block. sent, dropped, delayed: messages. bytes: of what "
    "was sent. helps: masks that were taken over."
)

MOST_MAPS = 12


def find_collectives(paths: Sequence[Path | str]) -> list[Collective]:
    """Return every finished collective in or below folders; others are named on standard error.

    Raises:
        ValueError: if there is none; and as `read_collective`.
    """
    folders: dict[Path, None] = {}
    for path in paths:
        folders |= dict.fromkeys(log.parent for log in files_below(Path(path), (COLLECTIVE,))[0])
    found = []
    for folder in folders:
        if (folder / METRICS).exists():
            found.append(read_collective(folder))
        else:
            print_note("left out", f"{folder} is unfinished; the same command resumes it")
    where = ", ".join(map(str, paths))
    require(
        (bool(folders), f"no {COLLECTIVE} in or below {where}: run one with exchange=l2d2c"),
        (not folders or bool(found), f"no collective in or below {where} is finished: run it to its end"),
    )
    return found


def write_report(paths: Sequence[Path | str], folder: Path) -> Path:
    """Write ``collectives.md`` with its figures, ``collectives.csv`` and the tidy tables; return the page.

    Raises:
        ModuleNotFoundError: before any work, without what the extra ``report`` installs.
        ValueError: if no collective can be read.
        BlockingIOError: if another process writes into the folder.
    """
    require_packages()
    found = find_collectives(paths)
    with locked(make_folder(folder)):
        gallery = Gallery(folder)
        for name, rows in tables(found).items():
            write_whole(folder / name, csv_text(rows))
        measured = []
        for each in found:
            row = {**each.config["exchange"], **each.about, "helps": len(each.helps)}
            for name in MEASURES:
                row[name] = getattr(each, name)
            for name in (*WHAT, "bytes"):
                row[name] = each.total(name)
            measured.append(row)
        cells = [[row.get(name) for name in COLUMNS] for row in measured]
        write_whole(folder / "collectives.csv", csv_text([COLUMNS, *cells]))
        shown = [[markdown_text(_shown(row[name])) for name in SHOWN] for row in measured]
        parts = ["# Collectives", markdown_table(SHOWN, shown), MEANING]
        for figure in gallery.write((), _figures(found)):
            parts.append(f"![{figure.alt}]({figure.path})\n\n{figure.caption}")
        page = folder / "collectives.md"
        write_whole(page, "\n\n".join(parts) + "\n")
    return page


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2f}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _figures(found: Sequence[Collective]) -> Iterator[CaptionedFigure]:
    yield CaptionedFigure(
        "learning_time",
        "Learning time",
        "Mean frames that a member needs to learn a block, over the number of members. Marks: single collectives; "
        "lines: means over seeds. Dotted: the value of the fewest members divided by N.",
        _draw_times(found),
    )
    for each in list(filter(lambda each: each.helps, found))[:MOST_MAPS]:
        caption = "Masks that each member (row) has taken over from each other (column), members counted from 0."
        title = (
            f"Who helped whom: {each.about['exchange']}, {each.about['num_members']} members, seed {each.about['seed']}"
        )
        count = each.about["num_members"]
        figure = new_figure(0.6 * WIDTH, 0.5 * WIDTH)
        axes = figure.subplots()
        cells = np.zeros((count, count))
        for row in each.helps:
            cells[row["receiver"], row["sender"]] += 1
        image = axes.imshow(cells, cmap="viridis", vmin=0, interpolation="none")
        figure.colorbar(image, ax=axes, label="masks taken over")
        axes.set(xlabel="sender", ylabel="receiver")
        for axis in (axes.xaxis, axes.yaxis):
            axis.get_major_locator().set_params(integer=True)
        yield CaptionedFigure("helps", title, f"{title}. {caption}", figure)


def _draw_times(found: Sequence[Collective]) -> Any:
    lines: dict[str, dict[int, list[float]]] = {}
    for each in found:
        name = " ".join(str(each.about[part]) for part in ("exchange", "curriculum", "agent", "method"))
        lines.setdefault(name, {}).setdefault(each.about["num_members"], []).append(each.learning_time)
    figure = new_figure(WIDTH, 2.8)
    axes = figure.subplots()
    for position, (name, times) in enumerate(list(lines.items())[:MOST_AGENTS]):
        numbers = sorted(times)
        look = agent_style(position)
        means = [fmean(times[number]) for number in numbers]
        axes.plot(numbers, means, label=short(name), **look)
        axes.plot(numbers, [means[0] * numbers[0] / number for number in numbers], ":", color=look["color"])
        pairs = [(number, time) for number in numbers for time in times[number]]
        axes.plot(*zip(*pairs, strict=True), linestyle="", marker=".", markersize=3, color=look["color"])
    axes.set(xlabel="members", ylabel="frames to learn a block", ylim=(0, None))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend()
    return figure


def main() -> None:
    """Write the page."""
    parser = parsers.collectives()
    arguments = parser.parse_args()
    with refused_by(parser):
        page = write_report(arguments.runs, arguments.out)
    print(f"report: {terminal_text(page)}")


if __name__ == "__main__":
    main()
