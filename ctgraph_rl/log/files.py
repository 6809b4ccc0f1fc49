"""The files of a run: their names, written whole or not at all, and a lock for their directory."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

LOG, AGENT, METRICS, CURRICULUM = "run.jsonl", "agent.pt", "metrics.json", "curriculum.json"
"""Files of a run's directory; `METRICS` is there when the run is complete."""

FAILURE = "failed.txt"
"""Says why a run ended by an error."""

CHECKPOINTS = "checkpoints"
"""The folder with the checkpoints of an unfinished run."""

LOCK = ".lock"
"""The file in a directory that names the process that has locked it."""

PART = ".part"
"""Ending of a file that is being written."""

SECONDS_BETWEEN_ATTEMPTS = 0.5
"""To get a lock that another process has."""


def write_whole(path: Path | str, content: bytes) -> None:
    """Write a file so that whoever reads it, also after a crash, finds the old content or the new.

    Raises:
        OSError: if it cannot be written; names the path and the bytes needed and free. The old file stays.
    """
    path = Path(path)
    part = path.with_name(path.name + PART)
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise cannot_write(path, len(content), error) from error


def cannot_write(path: Path, num_bytes: int, error: OSError) -> OSError:
    """The error for a file that cannot be written, with sizes."""
    try:
        free = f"{shutil.disk_usage(path.parent).free / 1e6:.1f} MB are free"
    except OSError:
        free = "its disk cannot be read"
    return OSError(error.errno, f"{error.strerror}: cannot write {num_bytes / 1e6:.1f} MB to {path}, {free}")


def _sync_folder(folder: Path) -> None:
    """Make a rename last; folders of some file systems cannot be synced, which then do it themselves."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def locked(folder: Path, waiting: Callable[[], object] | None = None) -> Iterator[None]:
    """Work in a directory alone; the lock ends with the process, however that ends.

    Args:
        folder: an existing directory, on a file system with POSIX locks.
        waiting: called every half second while another process works there; None fails at once instead.

    Raises:
        BlockingIOError: if another process works there; names its host, number and start.
        OSError: if the file system has no locks.
    """
    file = _lock(folder / LOCK, waiting)
    try:
        yield
    finally:
        (folder / LOCK).unlink(missing_ok=True)
        file.close()


def _lock(path: Path, waiting: Callable[[], object] | None) -> BinaryIO:
    """The open and locked file."""
    while True:
        file = path.open("ab+", buffering=0)
        try:
            if _is_locked(file):
                if _is_still_there(file, path):
                    return _signed(file)
            elif waiting is None:
                file.seek(0)
                holder = file.read().decode(errors="replace") or "another process"
                raise BlockingIOError(f"{path.parent} is in use by {holder}; wait for it, or stop it")
            else:
                waiting()
                time.sleep(SECONDS_BETWEEN_ATTEMPTS)
        except BaseException:
            file.close()
            raise
        file.close()


def _is_locked(file: BinaryIO) -> bool:
    """Lock the file, unless another process has done so."""
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        message = f"{error.strerror}: {file.name} cannot be locked; keep runs on a file system with locks"
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
        file.write(f"process {os.getpid()} on {socket.gethostname()} since {now}".encode())
    return file


def append_line(path: Path, value: object) -> None:
    """Add a value to a file of JSON lines."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(value) + "\n")
