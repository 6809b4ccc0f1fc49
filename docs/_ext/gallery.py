"""The gallery: figures, each with the command that makes it; those of `DRAWN` are drawn when the site is built."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import sys
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from ctgraph_rl import cli

DOCS = Path(__file__).resolve().parents[1]
SHELL = re.compile(r"```bash\n(.*?)```", re.DOTALL)


class Tile(NamedTuple):
    """A figure: a title, the command, and the path of the figure from ``docs/generated``."""

    title: str
    command: str
    figure: str


DRAWN = {
    "The graphs and goals of a curriculum": "curricula describe fo_b1_depth2to5 --figure FIGURE",
    "How similar the tasks of a curriculum are": "curricula describe su_b1_4tasks --similarity FIGURE",
    "A task of twenty-seven end states": "draw --branching-factor 3 --depth 3 --goal 2.1.3 --figure FIGURE",
    "What the optimal policy does": "draw CT-SU-B1 --goal 2.1 --policy optimal --figure FIGURE",
    "A policy that waits and decides at random": "draw CT-CO-B1 --policy navigation --figure FIGURE",
    "The images of a fully observable task": "draw CT-FO-B1 --show images --figure FIGURE",
}
"""Commands of figures that are drawn here."""

TITLES = {
    "b2d3": "Two branches, depth 3",
    "b3d2": "Three branches, depth 2, waiting that may last",
    "confounding": "Confounding: a wait state shows any of many images",
    "episode": "An episode of the optimal policy",
    "full": "Fully observable: each state has its image",
    "images": "Images with noise and rotation",
    "large": "The way to the goal in a deep tree",
    "surjective": "Surjective: an image for each kind of state",
    "visits": "Where a random policy goes",
}
"""What the figures of the pages on pictures and drawing show."""

MAKE, REPORT = "python docs/results/make.py", "ctgraph-rl report runs/su_b1_4tasks --agent LSTMPPO=LSTM-PPO"
RESULTS = {
    "main_job.png": ("A graph, and the performance matrix of LSTM-PPO", MAKE),
    "main_job-training.png": ("LSTM-PPO learns four goals one after the other", REPORT),
    "main_job-transfer.png": ("Its performance matrix, and what each block changed", REPORT),
    "baselines_b1.png": ("Six agents on four configurations", MAKE),
    "masks_ct8.png": ("Modulating masks on CT8", MAKE),
    "methods.png": ("All methods on four agents", MAKE),
}
"""Titles and commands of figures of the results: of the raw results, or of runs of the main job."""


def gallery_page(folder: Path) -> str:
    """Draw the figures of commands into a folder, and return the page of all tiles in Markdown."""
    of_pages = [*_of_page("explanation/ct_graph_in_pictures.md"), *_of_page("how-to/draw_and_play.md")]
    tiles = [*_drawn(folder), *dict.fromkeys(of_pages), *_of_results()]
    parts = ["# Gallery", "Every figure with the command that makes it.", "::::{container} gallery"]
    return "\n\n".join([*parts, *map(_markdown, tiles), "::::"]) + "\n"


def _markdown(tile: Tile) -> str:
    figure = f"![{tile.title}]({tile.figure})"
    return f":::{{container}} tile\n**{tile.title}**\n\n{figure}\n\n```bash\n{tile.command}\n```\n:::"


def _drawn(folder: Path) -> list[Tile]:
    folder.mkdir(parents=True, exist_ok=True)
    tiles = []
    for number, (title, command) in enumerate(DRAWN.items(), 1):
        path = folder / f"gallery{number}.png"
        if not path.is_file():
            _run(shlex.split(command.replace("FIGURE", str(path))))
        tiles.append(Tile(title, f"ctgraph-rl {command.replace('FIGURE', 'figure.png')}", f"figures/{path.name}"))
    return tiles


def _run(words: list[str]) -> None:
    argv = mock.patch.object(sys, "argv", ["ctgraph-rl", *words])
    with argv, contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        cli.main()


def _of_page(name: str) -> list[Tile]:
    """Return a tile for each stored figure of a page whose commands a test compares with it."""
    lines = [line for block in SHELL.findall((DOCS / name).read_text(encoding="utf-8")) for line in block.splitlines()]
    figures = {line.split()[-1]: line for line in lines if (DOCS / "pictures" / line.split()[-1]).is_file()}
    return [
        Tile(TITLES.get(Path(figure).stem, figure), line, f"../pictures/{figure}") for figure, line in figures.items()
    ]


def _of_results() -> list[Tile]:
    found = {name: tile for name, tile in RESULTS.items() if (DOCS / "results" / name).is_file()}
    return [Tile(title, command, f"../results/{name}") for name, (title, command) in found.items()]
