"""Signals that ask a run to stop: it saves within one update and exits; a second one stops it at once."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

STOPPING = ("SIGINT", "SIGTERM", "SIGUSR2")
"""SIGUSR2 only if something handles it, such as submitit before a SLURM job's time limit."""


class Interrupt:
    """While this context is entered, a signal to stop is kept for `exit` instead of acting at once.

    A library that handles SIGUSR2 to queue the job again (submitit) does so after the save. Ignored signals, as in a
    script's background, stay ignored. Outside the main thread signals act as before.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    @property
    def is_asked(self) -> bool:
        """True once the process was asked to stop."""
        return self.signal is not None

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for name in STOPPING:
                number = getattr(signal, name, 0)
                before = signal.getsignal(number) if number else None
                requeues = number == _requeuing()  # an ignored signal stays so
                if callable(before) if requeues else before not in (signal.SIG_IGN, None):
                    self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._restore()
        if kind is None:
            self.check()

    def check(self) -> None:
        """Exit if the process was asked to stop."""
        if self.is_asked:
            self.exit()

    def exit(self) -> None:
        """Exit with the signal's code, or let the scheduler's library queue the job again.

        Raises:
            SystemExit: always, but for the next.
            RuntimeError: if the job could not be queued again.
        """
        assert self.signal is not None
        print("saved; the same command resumes from there", file=sys.stderr)
        requeue = self._before.get(_requeuing())
        self._restore()
        if callable(requeue):
            with _deaf():
                shown = _shown_job()
                is_ended = "JobState=COMPLETING" in shown or "JobState=CANCELLED" in shown  # a requeue would undo it
                if not is_ended:
                    try:
                        requeue(_requeuing(), None)
                    except (OSError, subprocess.SubprocessError) as error:
                        if not _is_in_queue():
                            said = f"SLURM did not put job {_job()} into the queue again, as scontrol requeue failed"
                            raise RuntimeError(f"{said}: the same command resumes the run") from error
        raise SystemExit(128 + self.signal)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.signal = number
        self._restore()
        print(f"\n{signal.Signals(number).name}: saving after this update ... ", end="", file=sys.stderr, flush=True)

    def _restore(self) -> None:
        for number, before in self._before.items():
            if signal.getsignal(number) == self._ask:
                signal.signal(number, before)


@contextmanager
def _deaf() -> Iterator[None]:
    """Ignore signals to stop, also in started processes, as SLURM sends them to all."""
    before = {}
    for name in STOPPING:
        number = getattr(signal, name, 0)
        if number:
            before[number] = signal.signal(number, signal.SIG_IGN)
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # it was not set by Python
                signal.signal(number, handler)


def _is_in_queue() -> bool:
    """Return whether SLURM has queued the job: it counts a restart at once, while it ends this one."""
    restarts = re.search(r"Restarts=(\d+)", _shown_job())
    return restarts is not None and int(restarts[1]) > int(os.environ.get("SLURM_RESTART_COUNT") or 0)


def _shown_job() -> str:
    command = ["scontrol", "show", "job", _job()]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=10).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""


def _job() -> str:
    """Return SLURM's name for this job; an array task's number would name all its tasks."""
    names = [os.environ.get(name, "") for name in ("SLURM_ARRAY_JOB_ID", "SLURM_ARRAY_TASK_ID")]
    return "_".join(names) if all(names) else os.environ.get("SLURM_JOB_ID", "")


def _requeuing() -> int:
    return getattr(signal, "SIGUSR2", 0)
