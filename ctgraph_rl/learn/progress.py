"""Progress bars on a terminal, and in a notebook with ipywidgets; a line every ten seconds elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from datetime import timedelta
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

SECONDS_BETWEEN_LINES = 10.0

QUICK = 2.0

Count = Callable[[str, int, int], object]


def silent(what: str, done: int, total: int) -> None:
    """Show nothing; a `Count`."""


class TextBar:
    """A bar with a text on a terminal, and lines of text elsewhere.

    Args:
        transient: the bar disappears at its end.
    """

    def __init__(self, console: Console | None, transient: bool = False) -> None:
        from rich.console import Console  # here: --help shows no bar
        from rich.progress import BarColumn, Progress, TextColumn  # here: as above

        self.console = Console(stderr=True) if console is None else console
        columns = (BarColumn(bar_width=16), TextColumn("{task.description}"))
        self._bar = Progress(*columns, console=self.console, transient=transient)

    def _print(self, text: str) -> None:
        self.console.print(text, highlight=False, soft_wrap=True)


class StepCounter(TextBar):
    """A context manager that shows steps done, rate and time left once `QUICK` seconds have passed."""

    def __init__(self, console: Console | None = None) -> None:
        super().__init__(console, transient=True)
        self._task = self._bar.add_task("")
        self._what = ""
        self._first = self._start = self._now = self._last_line = time.perf_counter()

    def __enter__(self) -> StepCounter:
        return self

    def __exit__(self, *_: object) -> None:
        if self.console.is_terminal:
            self._bar.stop()

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show progress, as a `Count`."""
        if what != self._what:
            self._what = what
            self._start = self._now
        self._now = time.perf_counter()
        if self._now - self._first < QUICK:
            return
        rate = done / (self._now - self._start)
        text = f"{done}/{total} {what}  {rate:.3g}/s  {timedelta(seconds=round((total - done) / rate))} left"
        if self.console.is_terminal:
            self._bar.start()
            self._bar.update(self._task, completed=done, total=total, description=text)
        elif self._now - self._last_line >= SECONDS_BETWEEN_LINES:
            self._last_line = self._now
            self._print(text)


class ProgressBar(TextBar):
    """A context manager that shows block, frames, rate, return and time left.

    Args:
        done: frames learned before the run was resumed.
    """

    def __init__(self, num_blocks: int, num_frames: int, console: Console | None = None, done: int = 0) -> None:
        super().__init__(console)
        self.num_blocks = num_blocks
        self.num_frames = num_frames
        self.done = done
        self._live = self.console.is_terminal or (self.console.is_jupyter and find_spec("ipywidgets") is not None)
        self._task = self._bar.add_task(self.beginning, completed=done, total=num_frames)
        self._start = self._last_line = time.perf_counter()

    def __enter__(self) -> ProgressBar:
        if self._live:
            self._bar.start()
        elif self.done:
            self._print(self.beginning)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._bar.stop()

    @property
    def beginning(self) -> str:
        """The text before the first batch."""
        return f"resumed after {_short(self.done)} frames" if self.done else "evaluating before training"

    def update(self, block: int, frames: int, episode_return: float) -> None:
        """Show the bar or line after a batch."""
        now = time.perf_counter()
        text = self.describe(block, frames, episode_return, now - self._start)
        if self._live:
            self._bar.update(self._task, completed=frames, description=text)
        elif now - self._last_line >= SECONDS_BETWEEN_LINES or frames == self.num_frames:
            self._last_line = now
            self._print(text)

    def describe(self, block: int, frames: int, episode_return: float, seconds: float) -> str:
        """One line: block, frames, rate, return and time left."""
        rate = (frames - self.done) / seconds
        left = timedelta(seconds=round((self.num_frames - frames) / rate))
        shown = "-" if math.isnan(episode_return) else f"{episode_return:.2f}"
        return (
            f"block {block}/{self.num_blocks}  {_short(frames)}/{_short(self.num_frames)} frames  {_short(rate)}/s  "
            f"return {shown}  {left} left"
        )


def _short(number: float) -> str:
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if number >= size:
            return f"{number / size:.4g}{unit}"
    return f"{number:.0f}"
