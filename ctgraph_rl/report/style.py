"""The style of all figures of the report: colours and marks of agents, and sizes in inches."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from pathlib import Path
from typing import Any

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, require
from ctgraph_rl.draw.style import import_matplotlib
from ctgraph_rl.log.escape import figure_text, terminal_text
from ctgraph_rl.packages import OF_REPORT

STYLE = Path(__file__).with_name("style.mplstyle")

WIDTH = 7.2

WIDTHS = {"text": WIDTH, "column": 3.5}
"""Inches of a figure: a page's text, or one of its two columns."""

MOST_AGENTS = 6
"""Agents of a curriculum that figures show, one for each colour of the style."""

LONGEST_NAME = 22


def require_packages(what: str = "the report", *names: str) -> None:
    """Refuse before any work.

    Args:
        names: of packages that the extra ``report`` installs; default: all.

    Raises:
        ModuleNotFoundError: without one of them; names the extra to install.
    """
    for name in names or OF_REPORT:
        try:
            if name == "matplotlib":
                import_matplotlib()
            else:
                import_module(name)
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(f"{what} needs {name}: pip install 'ctgraph_rl[report]'") from error


_WIDTH: ContextVar[str] = ContextVar("width", default="text")
_COLOURS: ContextVar[Mapping[str, str] | None] = ContextVar("colours", default=None)


@contextmanager
def style(width: str = "text", colours: Mapping[str, str] | None = None) -> Iterator[None]:
    """Give figures that are made and saved within it the report's style.

    Args:
        colours: of agents, by their names in figures; others have the style's.

    Raises:
        ValueError: for another width, and for an unknown colour.
    """
    from matplotlib import rc_context
    from matplotlib.colors import is_color_like

    require((width in WIDTHS, f"width must be one of {', '.join(WIDTHS)}, got {width!r}"))
    for agent, colour in (colours or {}).items():
        rule = f"the colour of {agent} must be one that matplotlib knows, such as tab:blue or #0072B2, got {colour!r}"
        require((is_color_like(colour), rule))
    widths = _WIDTH.set(width)
    chosen = _COLOURS.set(colours)
    try:
        with rc_context(fname=STYLE):
            yield
    finally:
        _WIDTH.reset(widths)
        _COLOURS.reset(chosen)


def figure_width() -> float:
    """Return the inches of a whole figure within `style`."""
    return WIDTHS[_WIDTH.get()]


def beside(most: int) -> int:
    """Return how many panels stand side by side, where a page's text has room for ``most``."""
    return max(1, round(most * figure_width() / WIDTH))


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure, in inches; within `style` it has the report's."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def panels(count: int, most: int, height: float, width: float = 1, room: float = 0.5, **shared: bool) -> Any:
    """Return the axes of a new figure, in rows of up to ``most``; spare ones stay empty.

    Args:
        most: in a row of a page's text.
        height: of a row, in inches.
        width: share of a whole figure's.
        room: beside the rows, in inches.
        shared: ``sharex`` and ``sharey``.
    """
    columns = min(beside(most), count)
    rows = math.ceil(count / columns)
    figure = new_figure(figure_width() * width, rows * height + room)
    grid = figure.subplots(rows, columns, squeeze=False, **shared)
    for axes in grid.ravel()[count:]:
        axes.axis("off")
    return grid


def agents_legend(figure: Any, looks: Iterable[tuple[str, ReadOnlyValues]]) -> None:
    """Agents' names above all panels, with the looks of their curves."""
    from matplotlib.lines import Line2D

    marks = [Line2D([], [], label=name, **look) for name, look in looks]
    figure.legend(handles=marks, loc="outside upper left", ncols=min(beside(3), len(marks)))


def agent_style(position: int, agent: str = "") -> NamedValues:
    """Return colour, line and mark of an agent's curve; needs `style`."""
    from matplotlib import rcParams

    cycle = rcParams["axes.prop_cycle"].by_key()
    look = {name: values[position % len(values)] for name, values in cycle.items()}
    own = (_COLOURS.get() or {}).get(agent)
    return look if own is None else {**look, "color": own}


def short(name: str) -> str:
    """Return a name without its middle that fits into a figure, safe for matplotlib."""
    name = terminal_text(name)
    half = LONGEST_NAME // 2
    return figure_text(name if len(name) <= LONGEST_NAME else f"{name[: half - 1]}…{name[-half:]}")


def ink(background: Sequence[float]) -> str:
    """Return black or white as the colour of text on a background, whichever has more contrast, at least 4.5.

    Contrast is that of the Web Content Accessibility Guidelines 2.2.

    Args:
        background: red, green and blue of sRGB, each in [0, 1].
    """
    linear = [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in background]
    luminance = sum(weight * value for weight, value in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
    return "black" if (luminance + 0.05) ** 2 >= 1.05 * 0.05 else "white"


def frames_axis(axes: Any) -> None:
    """Ticks such as 50k and 1.5M."""
    from matplotlib.ticker import EngFormatter

    axes.locator_params(axis="x", nbins=4)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
