"""The status of a sweep's cells, from their directories: a line while they run, and a report at the end."""

from __future__ import annotations

import math
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Hashable, Mapping
from contextlib import suppress
from datetime import timedelta
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ctgraph_rl.disk import read_regular, read_text
from ctgraph_rl.learn.progress import TextBar
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import (
    CHECKPOINTS,
    FAILURE,
    LOCK,
    LOG,
    METRICS,
    MOST_BYTES_OF_A_REASON,
    MOST_BYTES_OF_METRICS,
)
from ctgraph_rl.log.sums import is_complete

if TYPE_CHECKING:
    from rich.console import Console

DONE = "done"
STALE = "stale"
FAILED = "failed"
IN_USE = "in use"
MISSING = "missing"

START_AGAIN = "overwrite=stale runs what is stale again, overwrite=true all"

SHOWN = 20

SECONDS_BETWEEN_LINES = 60.0


class Status(NamedTuple):
    """A cell's state, and why it is not done."""

    state: str
    reason: str = ""


class RunOutcome(NamedTuple):
    """A run directory's results and failure, each as a mark that changes when they are written again."""

    results: Hashable = None
    failure: Hashable = None

    @classmethod
    def of(cls, folder: Path) -> RunOutcome:
        """Return a directory's outcome; clocks of machines are not compared."""
        results = _identity(folder / METRICS)
        content = b""
        with suppress(OSError, ValueError):
            content = read_regular(folder / METRICS, MOST_BYTES_OF_METRICS)
        return cls(results and (results, content), _identity(folder / FAILURE))


NOTHING = RunOutcome()


def holds_results(folder: Path) -> bool:
    """Return whether a directory holds results or a checkpoint, which changed code makes stale."""
    return (folder / METRICS).exists() or any((folder / CHECKPOINTS).glob("*.pt"))


def _identity(path: Path) -> Hashable:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def status_of(folder: Path, before: RunOutcome = NOTHING, error: str | None = None) -> Status:
    """Return the status of a directory's cell.

    Args:
        folder: the directory; need not exist.
        before: results and failures from before the sweep, which do not count.
    """
    now = RunOutcome.of(folder)
    if now.results not in (None, before.results) and is_complete(folder):
        return Status(DONE)
    user = lock_holder(folder)
    if user is not None:
        return Status(IN_USE, f"by {user}")
    if error is not None:
        was_locked = error.startswith(BlockingIOError.__name__)
        return Status(IN_USE if was_locked else FAILED, error)
    if now.failure not in (None, before.failure):
        return Status(FAILED, failure(folder))
    if now.results not in (None, before.results):
        return Status(MISSING, "its results are not what was written; the next start says more")
    begun = (folder / LOG).exists() or (folder / CHECKPOINTS).exists()
    return Status(MISSING, "stopped; the next start resumes it" if begun else "not begun")


def failure(folder: Path) -> str:
    """Return why a run failed, by its file."""
    try:
        return read_text(folder / FAILURE, MOST_BYTES_OF_A_REASON)
    except (OSError, ValueError) as error:
        return str(error)


def lock_holder(folder: Path) -> str | None:
    """Return which process has locked a directory; None for none, or an ended one of this machine."""
    try:
        holder = read_text(folder / LOCK, MOST_BYTES_OF_A_REASON).partition("\n")[0]
    except (OSError, ValueError):
        return None
    _, number, _, host, *_ = [*holder.split(), *[""] * 4]
    if host == socket.gethostname():
        try:
            os.kill(int(number), 0)
        except ProcessLookupError:
            return None
        except (PermissionError, ValueError, OverflowError):  # another user's, or no number
            pass
    return holder or "another process"


def report(statuses: Mapping[str, Status], repeated: int = 0, most: int | None = SHOWN) -> str:
    """Report the number of cells by state, and why some are not done.

    Args:
        most: lines of cells, one for all that failed alike; None: a line a cell.
    """
    counts = Counter(found.state for found in statuses.values())
    states = (DONE, *([STALE] if counts[STALE] else []), FAILED, IN_USE, MISSING)
    numbers = ", ".join(f"{counts[state]} {state}" for state in states)
    twice = f" ({repeated} more are the same as others)" if repeated else ""
    lines = [f"sweep of {len(statuses)} cells{twice}: {numbers}"]
    left = [(name, found) for name, found in statuses.items() if found.state != DONE]
    alike: dict[tuple[Status, str], list[str]] = {}
    for name, found in left:
        is_listed = most is None or found.state != FAILED
        alike.setdefault((found, name if is_listed else ""), []).append(name)
    unnamed = len(left)
    for (found, _), names in islice(alike.items(), most):
        others = f" and {len(names) - 1} more" if len(names) > 1 else ""
        lines.append(f"  {found.state:<7}  {names[0]}{others}  {terminal_text(found.reason)}")
        unnamed -= len(names)
    if unnamed:
        lines.append(f"  and {unnamed} more")
    if counts[STALE]:
        lines.append(f"stale: the code has changed since; {START_AGAIN}")
    elif left:
        lines.append("the same command runs what is not done; with hydra.sweeper.status=true it only lists it")
    return "\n".join(lines)


class SweepProgress(TextBar):
    """Shows how many cells are done, failed and running, on standard error; a context manager.

    It looks at directories every second, or less often if that takes long.

    Args:
        cells: run directories, each with the outcome before the sweep, as `status_of`.
    """

    def __init__(self, cells: Mapping[Path, RunOutcome], console: Console | None = None) -> None:
        super().__init__(console)
        self.total = len(cells)
        self._left = dict(cells)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._task = self._bar.add_task("starting", total=self.total)

    def __enter__(self) -> SweepProgress:
        if self.console.is_terminal:
            self._bar.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        if self.console.is_terminal:
            self._bar.stop()

    def _watch(self) -> None:
        start = last_line = time.perf_counter()
        ended_before = sum(self.look()[:2])
        pause = 1.0
        over = False
        while not over:
            over = self._stop.wait(pause)  # one more look then: cells may have ended since the last
            now = time.perf_counter()
            done, failed, running = self.look()
            pause = max(1.0, 20 * (time.perf_counter() - now))
            text = self.describe(done, failed, running, done + failed - ended_before, now - start)
            if self.console.is_terminal:
                self._bar.update(self._task, completed=done, description=text)
            elif not over and now - last_line >= SECONDS_BETWEEN_LINES:
                last_line = now
                self._print(text)

    def look(self) -> tuple[int, int, int]:
        """Return the numbers of cells done, failed and running."""
        counts: Counter[str] = Counter()
        for folder, before in list(self._left.items()):
            state = status_of(folder, before).state
            counts[state] += 1
            if state == DONE:
                del self._left[folder]
        return self.total - len(self._left), counts[FAILED], counts[IN_USE]

    def describe(self, done: int, failed: int, running: int, ended: int, seconds: float) -> str:
        """Return one line: cells done (also before), failed and running, rate and time left.

        Args:
            ended: done or failed in ``seconds``.
        """
        rate = ended / seconds
        left = (self.total - done - failed) / rate if rate else math.inf
        shown = timedelta(seconds=round(left)) if math.isfinite(left) else "?"
        return f"{done}/{self.total} cells done  {failed} failed  {running} running  {60 * rate:.3g}/min  {shown} left"
