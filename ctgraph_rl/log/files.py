"""The files of a run: their names, and a lock for their directory."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO
from weakref import WeakSet

from ctgraph_rl.disk import open_own, read_regular

LOG, AGENT, METRICS, CURRICULUM = "run.jsonl", "agent.pt", "metrics.json", "curriculum.json"
"""Files of a run; `METRICS` is there when it is complete."""

FAILURE = "failed.txt"

MOST_BYTES_OF_METRICS, MOST_BYTES_OF_A_REASON = 2**24, 2**16

CHECKPOINTS = "checkpoints"

LOCK = ".lock"

WITH_LOCKS = (
    "keep runs on a file system with locks (flock): set hydra.run.dir, with -m hydra.sweep.dir, and experts_dir"
)

EX_TEMPFAIL = 75
"""Exit code of a command whose directory another process writes, so that a queue tries again."""

SECONDS_BETWEEN_ATTEMPTS = 0.5

BY_WAY_OF = b"\nby way of "
"""Stands in a lock file between who has the directory and the lock file that is locked for it."""

ATTEMPTS_TO_READ = 10


def member_folder(folder: Path, number: int) -> Path:
    """Return the run directory of a collective's member, from 0."""
    return folder / f"member_{number:03d}"


def list_members(folder: Path) -> list[Path]:
    """Return the run directories of a collective's members."""
    return sorted(folder.glob("member_*"))


@contextmanager
def locked(folder: Path, waiting: Callable[[], object] | None = None) -> Iterator[None]:
    """Keep other writers out of a directory, by `Locks.add`."""
    with closing(Locks()) as locks:
        locks.add(folder, waiting)
        yield


@contextmanager
def locked_new(folder: Path) -> Iterator[None]:
    """Keep other writers from making a folder, by a lock beside it, if its parent exists.

    Raises:
        BlockingIOError, OSError: as `Locks.add`.
    """
    with closing(Locks()) as locks:
        locks.add(folder, None, folder.parent / f".{folder.name}{LOCK}")
        yield


_held: WeakSet[BinaryIO] = WeakSet()


def _close_copies() -> None:
    """Close a forked process's copies of its parent's lock files, which would outlast the parent."""
    for file in [*_held]:
        file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_copies)


class Locks:
    """Keeps all other writers out of directories, also those of this process; locks end with the process at last.

    The first lock file is open and locked; those of more directories name it.
    """

    def __init__(self) -> None:
        self._file: BinaryIO | None = None
        self._path = Path()
        self._others: dict[Path, bytes] = {}

    def add(self, folder: Path, waiting: Callable[[], object] | None = None, path: Path | None = None) -> None:
        """Lock a directory.

        Args:
            folder: an existing directory, on a file system with POSIX locks.
            waiting: called every half second while another writer is there; None: fail at once.
            path: the lock file; default: `LOCK` in the directory.

        Raises:
            BlockingIOError: if another writer is there; names its host, process and start.
            OSError: if the file system has no locks.
        """
        path = (folder / LOCK if path is None else path).absolute()
        file = _lock(path, folder, waiting)
        if self._file is None:
            self._file = file
            self._path = path
            _held.add(file)
            with suppress(OSError):  # on a full disk without, for only messages and more directories need it
                _sign(file, f"{_signature()}since {datetime.now(UTC).isoformat(timespec='microseconds')}".encode())
            return
        with file:
            name = os.path.relpath(self._path, path.parent).encode("utf-8", "surrogateescape")
            content = _read(self._file) + BY_WAY_OF + name
            _sign(file, content)
            self._others[path] = content

    def close(self) -> None:
        """Let others in."""
        if self._file is None:
            return
        try:
            if not self._file.closed:  # as a fork's is
                for path, content in self._others.items():
                    found = b""
                    with suppress(OSError, ValueError):
                        found = read_regular(path, MOST_BYTES_OF_A_REASON)
                    if found == content:
                        path.unlink(missing_ok=True)
                if _is_still_there(self._file, self._path):
                    self._path.unlink(missing_ok=True)
        finally:
            self._file.close()
            self._file = None


def _lock(path: Path, folder: Path, waiting: Callable[[], object] | None) -> BinaryIO:
    while True:
        file = open_own(path, "ab+")
        try:
            if _is_locked(file):
                is_there = _is_still_there(file, path)
                if is_there and not _is_held_elsewhere(file, path):
                    return file
            else:
                is_there = True
            if is_there and waiting is None:
                raise BlockingIOError(f"{folder} is in use by {_holder(file)}")
        except BaseException:
            file.close()
            raise
        file.close()
        if is_there and waiting is not None:
            waiting()
            time.sleep(SECONDS_BETWEEN_ATTEMPTS)


def _is_held_elsewhere(file: BinaryIO, path: Path) -> bool:
    signature, found, name = _read(file).partition(BY_WAY_OF)
    if not found:
        return False
    try:
        with open_own(path.parent / os.fsdecode(name), "rb+") as other:
            return _read(other) == signature and not _is_locked(other)
    except (FileNotFoundError, NotADirectoryError):
        return False


def _read(file: BinaryIO) -> bytes:
    file.seek(0)
    return file.read()


def _holder(file: BinaryIO) -> str:
    signature = b""
    for _ in range(ATTEMPTS_TO_READ):  # it is signed right after it is locked
        signature = _read(file)
        if signature:
            break
        time.sleep(SECONDS_BETWEEN_ATTEMPTS / ATTEMPTS_TO_READ)
    holder = signature.partition(BY_WAY_OF)[0].decode(errors="replace") or "another process"
    fix = f"{holder}; wait for it, or stop it"
    return f"{fix}: it is this process, close its Recorder or del it" if holder.startswith(_signature()) else fix


def _signature() -> str:
    return f"process {os.getpid()} on {socket.gethostname()} "


def _is_locked(file: BinaryIO) -> bool:
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
    try:
        return path.stat().st_ino == os.fstat(file.fileno()).st_ino
    except FileNotFoundError:
        return False


def _sign(file: BinaryIO, content: bytes) -> None:
    file.truncate(0)
    file.write(content)


OF_A_SWEEP = ("multirun.yaml", "optimization_results.yaml")
"""Files of Hydra's sweepers beside run directories, which ``SWEEP/*`` names too."""


def without_sweeps_files(paths: Iterable[Path | str]) -> list[Path]:
    """Return the paths of a command line without Hydra's files of a sweep, unless there are no others."""
    every = list(map(Path, paths))
    return [path for path in every if path.name not in OF_A_SWEEP or path.is_dir()] or every


def no_run(path: Path, below: bool = True) -> str:
    """Return why a path holds no run; ``below``: folders that hold runs would do, too."""
    fix = "name a run directory" + ", or a folder that holds some" * below
    if path.is_dir():
        return f"{path} holds no run: no {LOG} in {'or below ' * below}it; {fix}"
    if not path.exists():
        return f"{path} holds no run: there is no such directory; {fix}"
    within = f", such as {path.parent}" if (path.parent / LOG).exists() else ""
    return f"{path} holds no run: it is a file; name a run directory{within}"
