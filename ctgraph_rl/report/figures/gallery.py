"""Figures of the report with their captions, written as PNG and PDF."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ctgraph_rl.disk import make_folder, write_whole
from ctgraph_rl.draw.style import picture
from ctgraph_rl.report.style import style

FOLDER = "figures"
INTERVAL = "the 95 % interval of the mean over seeds, within what is possible; one seed has none"
LONGEST_STEM = 60


class CaptionedFigure(NamedTuple):
    """A figure with its title and caption."""

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


def left_out(count: int, most: int, what: str) -> str:
    """Return a sentence on how many are shown, if not all."""
    return f" The first {most} of {count} {what} are shown." if count > most else ""


class Gallery:
    """Writes figures into a report's folder, with unique names."""

    def __init__(
        self,
        folder: Path,
        width: str = "text",
        colours: Mapping[str, str] | None = None,
        count: Callable[[int], object] | None = None,
    ) -> None:
        self.folder = folder
        self.width = width
        self.colours = colours
        self._count = count
        self._done = 0
        self._taken: set[str] = set()
        make_folder(folder / FOLDER)

    def write(self, names: tuple[str, ...], figures: Iterable[CaptionedFigure | None]) -> list[Written]:
        """Draw and write figures, skipping None; file names start with ``names``."""
        written = []
        with style(self.width, self.colours):
            for one in figures:
                self._done += 1
                if self._count is not None:
                    self._count(self._done)
                if one is None:
                    continue
                path = f"{FOLDER}/{self._stem(*names, one.kind)}"
                png = picture(one.figure, "png")
                one.figure.set_layout_engine("none")  # its work is done, and is most of the time of a figure
                write_whole(self.folder / f"{path}.png", png)
                write_whole(self.folder / f"{path}.pdf", picture(one.figure, "pdf"))
                written.append(Written(f"{path}.png", one.title, one.caption, base64.b64encode(png).decode()))
        return written

    def _stem(self, *names: str) -> str:
        parts = [re.sub(r"[^A-Za-z0-9_.=]+", "-", name).strip("-.")[:LONGEST_STEM] for name in names]
        stem = "-".join(part for part in parts if part)
        same = sum(1 for taken in self._taken if taken == stem or re.fullmatch(rf"{re.escape(stem)}-\d+", taken))
        stem = f"{stem}-{same + 1}" if same else stem
        self._taken.add(stem)
        return stem
