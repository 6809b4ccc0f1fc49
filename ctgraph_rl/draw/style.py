"""The style of all figures of trees: a colour and shape for each kind of state, marks and lines.

A grey print and any colour vision keep the kinds apart.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ctgraph_rl.checks import NamedValues
from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.disk import write_named
from ctgraph_rl.draw.layout import Layout
from ctgraph_rl.draw.pixels import GOAL, PALETTE
from ctgraph_rl.parsers import DPI

MARKERS = {StateType.HOME: "p", StateType.WAIT: "o", StateType.DECISION: "D", StateType.END: "s", StateType.FAIL: "8"}

PlanePoint = tuple[float, float]


def import_matplotlib() -> None:
    """Import matplotlib, also where MPLBACKEND names a missing backend: figures of this package use none.

    Raises:
        ModuleNotFoundError: without matplotlib.
    """
    backend = os.environ.get("MPLBACKEND")
    try:
        import matplotlib
    except ValueError:
        os.environ.pop("MPLBACKEND", None)
        for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
            del sys.modules[name]  # half imported
        try:
            import matplotlib  # noqa: F401
        finally:
            os.environ.update({} if backend is None else {"MPLBACKEND": backend})


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure, in inches.

    Raises:
        ModuleNotFoundError: without matplotlib; names the extra to install.
    """
    try:
        import_matplotlib()
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("figures need matplotlib: pip install 'ctgraph_rl[plot]'") from error
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def picture(figure: Any, form: str, dpi: float | None = None) -> bytes:
    """Return a figure in a format, such as ``png``; without ``dpi``, that of its style."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=form, **({} if dpi is None else {"dpi": dpi}))
    return buffer.getvalue()


def save_figure(figure: Any, path: Path | str, dpi: float = DPI) -> None:
    """Write a figure; the path's ending decides the format, ``.png`` where it has none.

    Raises:
        ValueError: for an unknown ending.
    """
    path = Path(path)
    path = path if path.suffix else path.with_name(f"{path.name}.png")
    write_named(path, picture(figure, path.suffix[1:].lower(), dpi))


def colour(number: int) -> str:
    """Return a colour of `ctgraph_rl.draw.pixels`'s palette as ``#rrggbb``."""
    return "#" + "".join(f"{channel:02x}" for channel in PALETTE[number])


def mark(kind: StateType, size: float) -> NamedValues:
    """Return matplotlib's style of a state, sizes in points."""
    shown = 0.85 * size if kind == StateType.DECISION else size  # a square on its corner is wide
    return _mark(MARKERS[kind], shown, colour(kind), edge_width=min(0.8, size / 10))


def goal_mark(size: float) -> NamedValues:
    """Return matplotlib's style of a goal, the star of `ctgraph_rl.draw.pixels`."""
    return _mark("*", size, colour(GOAL), edge_width=0.8)


def _mark(marker: str, size: float, face: str, edge_width: float) -> NamedValues:
    return {
        "marker": marker,
        "markersize": size,
        "markerfacecolor": face,
        "linestyle": "none",
        "markeredgecolor": "0",
        "markeredgewidth": edge_width,
    }


def draw_lines(axes: Any, lines: Sequence[Sequence[PlanePoint]], **style: Any) -> None:
    """Draw straight lines behind the states."""
    from matplotlib.collections import LineCollection

    look: NamedValues = {"zorder": 1, "colors": "0", "capstyle": "round"} | style
    axes.add_collection(LineCollection(list(lines), **look))


def stub_lines(layout: Layout, places: Mapping[int, PlanePoint], height: float) -> list[list[PlanePoint]]:
    """Return short lines from states half the way towards left-out branches."""
    lines = []
    for node, end in layout.stubs:
        x, y = places[node]
        lines.append([(x, y), ((x + end) / 2, y - height)])
    return lines


def shape_of(graph: CTGraph) -> str:
    """Return a graph's three numbers for a title."""
    return f"b={graph.branching_factor}, d={graph.depth}, p={graph.wait_prob:g}"
