"""The files of a run: their names, and a lock for their directory."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO
from weakref import WeakSet

from ctgraph_rl.disk import open_own

LOG, AGENT, METRICS, CURRICULUM = "run.jsonl", "agent.pt", "metrics.json", "curriculum.json"
"""Files of a run's directory; `METRICS` is there when the run is complete."""

FAILURE = "failed.txt"
"""Says why a run ended by an error."""

MOST_BYTES_OF_METRICS, MOST_BYTES_OF_A_REASON = 2**24, 2**16
"""Largest `METRICS`, and largest `FAILURE` and `LOCK`, that are read."""

CHECKPOINTS = "checkpoints"
"""The folder with the checkpoints of an unfinished run."""

LOCK = ".lock"
"""The file in a directory that names the process that has locked it."""

WITH_LOCKS = (
    "keep runs on a file system with locks (flock): set hydra.run.dir, with -m hydra.sweep.dir, and experts_dir"
)

EX_TEMPFAIL = 75
"""Exit code of a command whose directory another process writes: a queue that restarts failed commands tries again."""

SECONDS_BETWEEN_ATTEMPTS = 0.5
"""To get a lock that another writer has."""

ATTEMPTS_TO_READ = 10
"""Who has a lock, within half a second."""


def member_folder(folder: Path, number: int) -> Path:
    """Return the run directory of a member of a collective, counted from 0, within the collective's."""
    return folder / f"member_{number:03d}"


def list_members(folder: Path) -> list[Path]:
    """Return the run directories of a collective's members."""
    return sorted(folder.glob("member_*"))


@contextmanager
def locked(folder: Path, waiting: Callable[[], object] | None = None) -> Iterator[None]:
    """Keep all other writers out of a directory, those of this process too; the lock ends with the process at last.

    Args:
        folder: an existing directory, on a file system with POSIX locks.
        waiting: called every half second while another writer is there; None fails at once instead.

    Raises:
        BlockingIOError: if another writer is there; names its host, process and start.
        OSError: if the file system has no locks.
    """
    with _locked(folder / LOCK, folder, waiting):
        yield


@contextmanager
def locked_new(folder: Path) -> Iterator[None]:
    """Keep all other writers from making a folder, by a lock beside it, where the folder to come has a parent.

    Raises:
        BlockingIOError, OSError: see `locked`.
    """
    with _locked(folder.parent / f".{folder.name}{LOCK}", folder, None):
        yield


_held: WeakSet[BinaryIO] = WeakSet()
"""The lock files of this process."""


def _close_copies() -> None:
    """Close the lock files that a forked process has of its parent, whose lock would last until both have ended."""
    for file in [*_held]:
        file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_copies)


@contextmanager
def _locked(path: Path, folder: Path, waiting: Callable[[], object] | None) -> Iterator[None]:
    file = _lock(path, folder, waiting)
    _held.add(file)
    try:
        yield
    finally:
        try:
            if not file.closed and _is_still_there(file, path):  # not a fork's, nor that of another folder
                path.unlink(missing_ok=True)
        finally:
            file.close()


def _lock(path: Path, folder: Path, waiting: Callable[[], object] | None) -> BinaryIO:
    """The open and locked file."""
    while True:
        file = open_own(path, "ab+")
        try:
            if _is_locked(file):
                if _is_still_there(file, path):
                    return _signed(file)
            elif waiting is None:
                raise BlockingIOError(f"{folder} is in use by {_holder(file)}")
            else:
                waiting()
                time.sleep(SECONDS_BETWEEN_ATTEMPTS)
        except BaseException:
            file.close()
            raise
        file.close()


def _holder(file: BinaryIO) -> str:
    """Who has signed a lock file, and what to do about it."""
    signature = b""
    for _ in range(ATTEMPTS_TO_READ):  # it is signed right after it is locked
        file.seek(0)
        signature = file.read()
        if signature:
            break
        time.sleep(SECONDS_BETWEEN_ATTEMPTS / ATTEMPTS_TO_READ)
    holder = signature.decode(errors="replace") or "another process"
    fix = f"{holder}; wait for it, or stop it"
    return f"{fix}: it is this process, close its Recorder or del it" if holder.startswith(_signature()) else fix


def _signature() -> str:
    return f"process {os.getpid()} on {socket.gethostname()} "


def _is_locked(file: BinaryIO) -> bool:
    """Lock the file, unless another process has done so."""
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if not os.fstat(file.fileno()).st_size:  # else another process has signed it
            Path(os.fsdecode(file.name)).unlink(missing_ok=True)
        message = f"{error.strerror}: {file.name} cannot be locked; {WITH_LOCKS}"
        raise OSError(error.errno, message) from error
    return True


def _is_still_there(file: BinaryIO, path: Path) -> bool:
    """Whether its last holder has not removed it between our opening and locking it."""
    try:
        return path.stat().st_ino == os.fstat(file.fileno()).st_ino
    except FileNotFoundError:
        return False


def _signed(file: BinaryIO) -> BinaryIO:
    """The file, in which we say who we are; on a full disk without, for only messages need it."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    file.truncate(0)
    with suppress(OSError):
        file.write(f"{_signature()}since {now}".encode())
    return file


OF_A_SWEEP = ("multirun.yaml", "optimization_results.yaml")
"""What Hydra's sweepers leave beside run directories, and ``SWEEP/*`` names on a command line."""


def without_sweeps_files(paths: Iterable[Path | str]) -> list[Path]:
    """Return the paths of a command line but for Hydra's own files of a sweep; these too if there is nothing else."""
    every = list(map(Path, paths))
    return [path for path in every if path.name not in OF_A_SWEEP or path.is_dir()] or every


def no_run(path: Path) -> str:
    """Return why there is no run in or below a path."""
    if path.is_dir():
        return f"{path} holds no run: no {LOG} in or below it"
    if not path.exists():
        return f"{path} holds no run: there is no such directory"
    within = f", such as {path.parent}" if (path.parent / LOG).exists() else ""
    return f"{path} holds no run: it is a file; name a run directory{within}"
