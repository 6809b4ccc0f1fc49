"""Files that are whole or not there: written beside, synced and renamed; and a lock for a directory."""

from __future__ import annotations

import json
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

LOCK = ".lock"
"""The file in a directory that says who works there."""

PART = ".part"
"""Ending of a file that is being written."""


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
def locked(folder: Path, wait: bool = False) -> Iterator[None]:
    """Work in a directory alone; the lock ends with the process, however that ends.

    Args:
        folder: an existing directory, on a file system with POSIX locks.
        wait: wait for another process that works there, instead of failing.

    Raises:
        BlockingIOError: if another process works there; names its host, number and start.
    """
    file = _lock(folder / LOCK, wait)
    try:
        yield
    finally:
        (folder / LOCK).unlink(missing_ok=True)
        file.close()


def _lock(path: Path, wait: bool) -> IO[str]:
    """The open and locked file; one that its last holder has removed meanwhile is left."""
    import fcntl

    while True:
        file = path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            file.seek(0)
            holder = file.read() or "another process"
            file.close()
            message = f"{path.parent} is in use by {holder}; wait for it, or stop it"
            raise BlockingIOError(message) from None
        if path.exists() and path.stat().st_ino == os.fstat(file.fileno()).st_ino:
            break
        file.close()
    now = datetime.now(UTC).isoformat(timespec="seconds")
    file.truncate(0)
    file.write(f"process {os.getpid()} on {socket.gethostname()} since {now}")
    file.flush()
    return file


def append_line(path: Path, value: object) -> None:
    """Add a value to a file of JSON lines."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(value) + "\n")
