"""The figures of a section: drawn, described, and written as PNG and PDF."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ctgraph_rl.report import curves, heatmaps, trees
from ctgraph_rl.report.sections import Result, Section
from ctgraph_rl.report.style import MOST_AGENTS, style
from ctgraph_rl.report.trees import Trees

FOLDER = "figures"
INTERVAL = "Student's 95 % interval of the mean over seeds, which one seed or seeds that are all equal do not have"
LONGEST_STEM = 60


class Picture(NamedTuple):
    """A figure with its words."""

    kind: str  # end of its file's name
    title: str
    caption: str  # what it shows, n, and what the interval is
    figure: Any


class Written(NamedTuple):
    """A figure in its files."""

    path: str  # of the PNG, seen from the report
    alt: str
    caption: str
    png: str  # base64


def of_section(section: Section) -> Iterator[Picture]:
    """Curves of all agents."""
    if not any(result.finished for result in section.results):
        return
    shown = ", ".join(f"{result.agent} (n = {result.n})" for result in section.results[:MOST_AGENTS])
    who = f"Agents: {shown}.{left_out(len(section.results), MOST_AGENTS, 'agents')}"
    tasks = left_out(len(section.labels), curves.MOST_TASKS, "tasks")
    yield Picture(
        "curves",
        "Learning curves",
        f"Mean return on each task at every evaluation, over the frames learned from.{tasks} {who} Lines: means over "
        f"seeds, where each has a value; bands: {INTERVAL}; thin lines: single seeds, up to {curves.MOST_SEEDS}. Grey: "
        "blocks that train the task; dashed: ends of blocks.",
        curves.draw_tasks(section),
    )
    if curves.has_training(section):
        yield Picture(
            "training",
            "Return while training",
            f"Return of the episodes that were finished while training, means over stretches of frames. {who} Lines: "
            f"means over seeds; bands: {INTERVAL}. Dashed: ends of blocks.",
            curves.draw_training(section),
        )


def of_result(section: Section, result: Result, found: Trees | None) -> Iterator[Picture]:
    """Heat maps and trees of an agent."""
    if not result.finished:
        return
    count = len(section.labels)
    marks = "" if count <= heatmaps.MOST_NUMBERS else " A dash marks losses."
    intervals = f" In brackets: {INTERVAL}." if count <= heatmaps.MOST_INTERVALS else ""
    if count <= heatmaps.MOST_NAMES:
        intervals += " The tables below have all intervals, and n where a cell has fewer seeds."
    yield Picture(
        "transfer",
        f"{result.agent}: performance and transfer",
        f"{result.agent}, means over n = {result.n} seeds. One map: mean return on each task after each block, block 0 "
        "before any training. The other: what each block's training did to each task, the difference of two successive "
        f"rows; purple is gain, orange is loss.{marks}{intervals} Framed: the tasks "
        "that the block trains. Grey: not evaluated.",
        heatmaps.draw_matrices(section, result),
    )
    if found is not None and found.curriculum is not None:
        yield _trees(result, found)


def _trees(result: Result, found: Trees) -> Picture:
    one = result.finished[0]
    tasks = left_out(len(found.curriculum.tasks) if found.curriculum else 0, trees.MOST_TREES, "tasks")
    what = "Stars are goals."
    if found.trained is not None:
        what = (
            f"What the trained agent of seed {one.seed}, the first of n = {result.n}, does in {trees.EPISODES} greedy "
            "episodes of each task; one seed has no interval. Numbers and lines are as the legend says, where there is "
            "room for them. Stars are goals."
        )
    title = f"{result.agent}: the tasks' trees"
    return Picture("trees", title, f"{title}. {what}{tasks}", trees.draw_trees(found, one.seed))


def left_out(count: int, most: int, what: str) -> str:
    """A sentence that says so where not all are shown; empty where all are."""
    return f" The first {most} of {count} {what} are shown." if count > most else ""


class Gallery:
    """Writes figures into the folder of a report, each under a name of its own.

    Args:
        folder: of the report.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._taken: set[str] = set()
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)

    def write(self, names: tuple[str, ...], pictures: Iterator[Picture]) -> list[Written]:
        """Draw and write figures; ``names`` begin those of their files."""
        written = []
        with style():
            for picture in pictures:
                path = f"{FOLDER}/{self._stem(*names, picture.kind)}"
                picture.figure.savefig(self.folder / f"{path}.png")
                picture.figure.set_layout_engine("none")  # its work is done, and is most of the time of a figure
                picture.figure.savefig(self.folder / f"{path}.pdf")
                png = base64.b64encode((self.folder / f"{path}.png").read_bytes()).decode()
                written.append(Written(f"{path}.png", picture.title, picture.caption, png))
        return written

    def _stem(self, *names: str) -> str:
        """A new name for a file, of letters that every system takes."""
        parts = [re.sub(r"[^A-Za-z0-9_.=]+", "-", name).strip("-.")[:LONGEST_STEM] for name in names]
        stem = "-".join(part for part in parts if part)
        same = sum(1 for taken in self._taken if taken == stem or re.fullmatch(rf"{re.escape(stem)}-\d+", taken))
        stem = f"{stem}-{same + 1}" if same else stem
        self._taken.add(stem)
        return stem
