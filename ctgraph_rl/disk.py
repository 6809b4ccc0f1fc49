"""Files in directories that others may have made: written whole and never through a link, read within limits.

Every file of the package is written here, beside its place, and renamed, so that a link is replaced and not followed.
Folders that the package names are refused where they are links. `write_named` follows names that the user gives.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from ctgraph_rl.checks import require

PART = ".part"


def write_whole(path: str | os.PathLike[str], content: bytes | str, synced: bool = True) -> None:
    """Write a file so that a reader, also after a crash, finds the old content or the new; a link is replaced.

    Args:
        content: text is written in UTF-8.
        synced: whether it must survive a power cut; False for what no run resumes from.

    Raises:
        OSError: if it cannot be written, with path and bytes needed and free. The old file stays.
    """
    path = Path(path)
    part = path.with_name(path.name + PART)
    data = _encoded(content)
    try:
        part.unlink(missing_ok=True)
        with part.open("xb") as file:  # a new file, never one that is there, nor a link
            file.write(data)
        if synced:
            publish(part, path)
        else:
            part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise cannot_write(path, len(data), error) from error


def _encoded(content: bytes | str) -> bytes:
    return content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content


def is_writable(folder: Path | str) -> bool:
    """Return whether files can be made in a folder."""
    return os.access(folder, os.W_OK)


def publish(made: Path, path: Path) -> None:
    """Move a finished file within a file system, so that after a power cut it is whole or absent.

    Raises:
        OSError: if it cannot be synced or moved.
    """
    with made.open("rb") as file:
        os.fsync(file.fileno())
    made.replace(path)
    sync_folder(path.parent)


def write_named(path: Path | str, content: bytes | str) -> None:
    """Write a file that the user has named, also through a link, pipe or device.

    Raises:
        OSError: if it cannot be written.
    """
    path = Path(path)
    if path.is_symlink() or (path.exists() and not path.is_file()):
        path.write_bytes(_encoded(content))
    else:
        write_whole(path, content)


def cannot_write(path: Path, num_bytes: int, error: OSError) -> OSError:
    """The error, with sizes, for a file that cannot be written."""
    if not path.parent.is_dir():
        return FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}; make it first")
    try:
        free = f"{shutil.disk_usage(path.parent).free / 1e6:.1f} MB are free"
    except OSError:
        free = "its disk cannot be read"
    return OSError(error.errno, f"{error.strerror}: cannot write {num_bytes / 1e6:.1f} MB to {path}, {free}")


def sync_folder(folder: Path) -> None:
    """Make a folder's new, moved and removed names last, where a file system can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def sync_folders(folder: Path) -> None:
    """Make a folder and all above it last."""
    for each in (folder.absolute(), *folder.absolute().parents):
        sync_folder(each)


def make_folder(folder: Path) -> Path:
    """Make a folder that the package names, unless it exists.

    Raises:
        ValueError: if a link is there.
    """
    require_no_link(folder)
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        sync_folder(folder.parent)
    return folder


def remove_empty(folder: Path) -> None:
    """Remove a folder without files, and then empty folders above it in the working directory."""
    here = Path.cwd()
    with suppress(OSError):
        for each in (folder, *folder.parents):
            if each == folder or (each != here and each.is_relative_to(here)):
                each.rmdir()


def require_new(path: Path) -> None:
    """Refuse an existing path.

    Raises:
        FileExistsError: if something is there.
    """
    if os.path.lexists(path):
        raise FileExistsError(f"{path} exists: choose another folder, nothing is overwritten")


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Make a folder whole or not at all: it is filled beside its place and renamed.

    Args:
        path: must not exist.

    Raises:
        FileExistsError: if something is there.
        OSError: if it cannot be written; nothing is left.
    """
    require_new(path)
    make_folder(path.absolute().parent)
    part = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=PART, dir=path.absolute().parent))
    try:
        yield part
        part.chmod(0o755)
        sync_folder(part)
        os.rename(part, path)
        sync_folder(path.absolute().parent)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def require_no_link(path: Path) -> None:
    """Refuse a symbolic link.

    Raises:
        ValueError: if there is one.
    """
    fix = "links within a run's directory or a report's are not followed; remove it"
    require((not path.is_symlink(), f"{path} is a symbolic link, and {fix}"))


def open_own(path: Path, mode: str) -> BinaryIO:
    """Open a file to change it in place, unbuffered; ``mode`` is of `open`, binary.

    Raises:
        ValueError: for a symbolic link, a file with a second name, and other than regular files.
    """
    require_no_link(path)
    rule = f"{path} must be a regular file without another name, as hard links are; remove it"
    with suppress(FileNotFoundError):  # one look, as another process may remove it at any time
        require((stat.S_ISREG(path.lstat().st_mode), rule))
    opener = _opener(os.O_NOFOLLOW | os.O_NONBLOCK)
    file: BinaryIO = open(path, mode, 0, opener=opener)  # type: ignore[assignment] # noqa: SIM115 - it is returned
    if os.fstat(file.fileno()).st_nlink > 1:
        file.close()
        raise ValueError(rule)
    return file


def _opener(more: int) -> Callable[[str, int], int]:
    return lambda path, flags: os.open(path, flags | more, 0o666)


@contextmanager
def appending(path: Path, known: os.stat_result) -> Iterator[int]:
    """Open a file again that this process made, to append to it.

    Args:
        known: its earlier state; another file is refused.

    Raises:
        FileNotFoundError: if it was moved, removed or replaced.
    """
    moved = f"{path} was moved, removed or replaced while this run was writing it; the run stops here"
    error = FileNotFoundError(errno.ENOENT, f"{moved}. Move it back and run the same command, which resumes it")
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise error from None
    try:
        if not os.path.samestat(os.fstat(descriptor), known):
            raise error
        yield descriptor
    finally:
        os.close(descriptor)


def append_line(path: Path, value: object) -> None:
    """Append a value to JSON lines."""
    with open_own(path, "ab") as file:
        file.write(json.dumps(value).encode() + b"\n")


def read_text(path: str | os.PathLike[str], most: int) -> str:
    """Return `read_regular` as text, marking bytes that are not UTF-8."""
    return read_regular(path, most).decode("utf-8", "replace")


def in_words(error: Exception) -> str:
    """Return an error's message; of the system's the file and the reason, without a number."""
    if not isinstance(error, OSError) or not error.strerror:
        return str(error)
    if error.filename is None:
        return error.strerror
    return f"{error.filename} cannot be opened: {error.strerror[0].lower()}{error.strerror[1:]}; check the path"


def read_regular(path: str | os.PathLike[str], most: int) -> bytes:
    """Return the content of a regular file, also by a link; pipes and devices are not opened.

    Raises:
        ValueError: for more than ``most`` bytes, and other than regular files.
        OSError: if it cannot be read.
    """
    with open(path, "rb", opener=_opener(os.O_NONBLOCK)) as file:
        found = os.fstat(file.fileno())
        require((stat.S_ISREG(found.st_mode), f"{path} must be a regular file"))
        content = file.read(found.st_size + 1) if found.st_size <= most else b""
    size = max(found.st_size, len(content))
    require((size <= most, f"{path} has {size:,} bytes, the limit is {most:,}"))
    return content
