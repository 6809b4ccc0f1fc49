"""The code of others in a separate process: limits of time, memory and disk, and what the system can close off.

bubblewrap closes off everything but the process's own folder; see `ctgraph_rl.board.bubblewrap`. Without it nothing
runs. `Isolation` says what is open and what is not limited.
``python -m ctgraph_rl.board.isolate`` is the first thing that runs in the new process: no module of others can be
imported before its limits are set.
"""

from __future__ import annotations

import json
import math
import os
import runpy
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, NamedTuple

from ctgraph_rl.board import bubblewrap
from ctgraph_rl.checks import LARGEST_INT, positive, require
from ctgraph_rl.disk import made_folder

HERE = "ctgraph_rl.board.isolate"

MOST_OUTPUT = 2**12
"""Bytes of what a process printed that are shown: the last ones."""

MOST_PROCESSES, MOST_FILES, MOST_DEPTH, MOST_OPEN = 256, 100_000, 64, 4096
"""Processes at once, files in the folder, folders within each other there, and open files of a process."""

MOST_THREADS = 1024
"""Of all processes together, where the system holds users to a limit."""

SECONDS_BETWEEN_LOOKS = 0.2
"""At the use of memory and disk."""

SECONDS_TO_END = 5
"""For the last words of a process that was killed."""

KEPT = ("PATH", "LANG", "LC_ALL", "TZ", "CC", "LD_LIBRARY_PATH", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")
"""Variables of the environment that a process is given; no other is."""

PROC = Path("/proc")


class Limits(NamedTuple):
    """What a process may use."""

    seconds: float  # of wall-clock time
    memory: int  # bytes, of all its processes
    disk: int  # bytes, in its folder


class Isolation(NamedTuple):
    """How the code of others is closed off here."""

    bubblewrap: str | None  # its version; None: it cannot be used
    why_not: str | None  # why it cannot
    graphics: bool  # whether the code may use the graphics cards
    is_root: bool

    def closed(self) -> list[str]:
        """Return what is closed off, a text for each thing."""
        if self.bubblewrap is None:
            return []
        inside = "it sees no files but its folder, the code, Python and the programs of the system"
        other = "no other process, socket, shared memory, keyring, device or terminal"
        return [f"bubblewrap {self.bubblewrap}", "no network", inside, "it changes only its folder", other]

    def missing(self) -> list[str]:
        """Return a text for each thing that is not closed off or not limited."""
        root = "the system holds root to no number of processes: a burst of them is stopped once it is seen"
        cards = "graphics cards: it may use all of their memory and of their driver"
        return [
            "weaknesses of the kernel stay, and what the processor's caches tell of other programs",
            "it can see which files are opened in the folders that it reads (inotify)",
            "the kernel's own memory for it is not limited, such as buffers of pipes and sockets; neither are files "
            "that it removed and keeps in a socket",
            f"memory, disk and processes are looked at {1 / SECONDS_BETWEEN_LOOKS:g} times a second",
            *([root] if self.is_root else []),
            *([cards] if self.graphics else []),
        ]


class Outcome(NamedTuple):
    """How a process ended."""

    code: int  # its exit status; negative for a signal
    stopped: str | None  # the limit that it broke
    seconds: float
    output: str  # the end of what it printed

    @property
    def failure(self) -> str | None:
        """Return in words why it did not end well; None if it did."""
        if self.stopped is not None:
            return f"stopped: {self.stopped}"
        last = self.output.strip().splitlines()[-1:] or ["it printed nothing"]
        return None if self.code == 0 else f"ended with exit code {self.code}: {last[0]}"


def isolation(folder: Path, graphics: bool = False) -> Isolation:
    """Return what this system closes off, found by a process that tries.

    Args:
        folder: an existing directory for that process.
        graphics: whether the code of others may use the graphics cards.
    """
    folder = _prepared(folder)
    why_not = bubblewrap.why_not(folder, _environment(folder))
    found = None if why_not is not None else ".".join(map(str, bubblewrap.version() or ()))
    return Isolation(found, why_not, graphics, is_root=os.geteuid() == 0)


def run_isolated(
    module: str,
    arguments: Sequence[str],
    folder: Path,
    limits: Limits,
    *,
    isolated: Isolation,
    paths: Sequence[Path] = (),
    variables: Mapping[str, str] | None = None,
    watch: Callable[[], object] = lambda: None,
) -> Outcome:
    """Run a module in a separate process, within limits, and leave none of its processes behind.

    Args:
        module: as of ``python -m``.
        arguments: of the module.
        folder: an existing directory, the only one that it may change; its working directory and its home.
        limits: what it may use.
        isolated: how it is closed off; what is open was agreed to.
        paths: folders in which it finds more modules, after those that are installed.
        variables: of its environment, beside `KEPT`.
        watch: is called several times a second.

    Raises:
        ValueError: for a limit that is not positive, and without bubblewrap.
    """
    require(
        *positive(seconds=limits.seconds, memory=limits.memory, disk=limits.disk),
        (isolated.bubblewrap is not None, f"the code of others is not run: {isolated.why_not}"),
    )
    folder = _prepared(folder)
    found_in = [str(path.resolve()) for path in paths]
    spec = json.dumps([limits, found_in, module, *arguments])
    command = [sys.executable, "-P", "-s", "-m", HERE, spec]
    start = time.monotonic()
    environment = {**_environment(folder), **(variables or {})}
    with bubblewrap.program() as filtering:
        command = bubblewrap.confined(command, folder, paths, filtering=filtering, graphics=isolated.graphics)
        try:
            with _process(command, folder, environment, (filtering,)) as process:
                said = _Tail(process.stdout)
                stopped = _watched(process, folder, limits, watch)
                if stopped is not None:
                    _kill(process)
                code = process.wait()
        finally:
            strip_privileges(folder)
    return Outcome(code, stopped, time.monotonic() - start, said.text())


def strip_privileges(folder: Path) -> None:
    """Remove the setuid and setgid bits of files and folders."""
    chosen = ["-xdev", "(", "-type", "f", "-o", "-type", "d", ")", "-perm", "/6000"]
    command = ["find", str(folder), *chosen, "-execdir", "chmod", "a-s", "--", "{}", "+"]
    subprocess.run(command, env={"PATH": "/usr/bin:/bin"}, stderr=subprocess.DEVNULL)


class _Tail(threading.Thread):
    """Reads all that a process prints, and keeps the end."""

    def __init__(self, pipe: IO[bytes] | None) -> None:
        assert pipe is not None
        super().__init__(daemon=True)
        self._pipe = pipe
        self._kept = b""
        self.start()

    def run(self) -> None:
        """Read until no process has the other end."""
        with suppress(OSError, ValueError):
            while read := os.read(self._pipe.fileno(), 2**16):
                self._kept = (self._kept + read)[-MOST_OUTPUT:]

    def text(self) -> str:
        """Return the end; what processes that have escaped still print is not waited for."""
        self.join(SECONDS_TO_END)
        return self._kept.decode("utf-8", "replace")


def _prepared(folder: Path) -> Path:
    """Return the path of a folder without links, with the folders in it that a process finds elsewhere."""
    folder = folder.resolve()
    for name in bubblewrap.OWN.values():
        made_folder(folder / name)
    return folder


def _environment(folder: Path) -> dict[str, str]:
    """Return the variables of a new process: no credentials, and its folder as its home."""
    kept = {name: os.environ[name] for name in KEPT if name in os.environ}
    package = Path(__file__).resolve().parents[2]
    own = {"HOME": str(folder), "TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(package)}
    return {**kept, **own, "PYTHONDONTWRITEBYTECODE": "1"}


@contextmanager
def _process(
    command: Sequence[str], folder: Path, environment: Mapping[str, str], opened: Sequence[int]
) -> Iterator[subprocess.Popen[bytes]]:
    """Start a process as the first of a new group and session; kill all of them however this ends.

    It gets nothing that is open here but some descriptors, and prints into a pipe.
    """
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=dict(environment),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        bufsize=0,
        close_fds=True,
        pass_fds=opened,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        _kill(process)
        process.wait()


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a process, those of its children that can be seen, and its group."""
    started = [] if process.poll() is not None else [each for each, _ in _family(process.pid)]
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    for each in started:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(each, signal.SIGKILL)


def _watched(process: subprocess.Popen[bytes], folder: Path, limits: Limits, watch: Callable[[], object]) -> str | None:
    """Wait for a process; return the limit that it broke, None if it ended by itself."""
    end = time.monotonic() + limits.seconds
    while True:
        try:
            process.wait(SECONDS_BETWEEN_LOOKS)
        except subprocess.TimeoutExpired:
            broken = _broken(process.pid, folder, limits, time.monotonic() > end)
            if broken is not None:
                return broken
            watch()
        else:
            return _broken(process.pid, folder, limits, False)


def _broken(number: int, folder: Path, limits: Limits, is_late: bool) -> str | None:
    """Return the limit that a process, those that it started or their folder break."""
    family = list(_family(number))
    try:
        used = _used(folder)
    except PermissionError:
        used = _Used(strange="it closed its folder")
    disk = used.disk + sum(_removed([each for each, _ in family]).values())
    rules = {
        f"it took longer than {limits.seconds:g} seconds": is_late,
        f"it used more than {limits.memory:,} bytes of memory": sum(each for _, each in family) > limits.memory,
        f"it wrote more than {limits.disk:,} bytes": disk > limits.disk,
        f"it made more than {MOST_FILES:,} files": used.files > MOST_FILES,
        str(used.strange): used.strange is not None,
        f"it started more than {MOST_PROCESSES} processes": len(family) > MOST_PROCESSES,
    }
    return next((text for text, is_broken in rules.items() if is_broken), None)


def _family(number: int) -> Iterator[tuple[int, int]]:
    """Yield a process and all that it and those started, each with its memory in bytes; none where none is seen."""
    parents: dict[int, list[tuple[int, int]]] = {}
    for path in PROC.glob("[0-9]*") if PROC.is_dir() else ():
        with suppress(OSError, ValueError, IndexError):
            fields = (path / "stat").read_text(errors="replace").rpartition(")")[2].split()
            memory = int(fields[21]) * os.sysconf("SC_PAGE_SIZE")
            own = int(path.name)
            parents.setdefault(number if own == number else int(fields[1]), []).append((own, memory))
    waiting = [each for each in parents.get(number, ()) if each[0] == number]
    while waiting:
        found = waiting.pop()
        yield found
        waiting += [each for each in parents.get(found[0], ()) if each[0] != number]


def _removed(processes: Sequence[int]) -> dict[tuple[int, int], int]:
    """Return the bytes of files without a name that processes still have, each once, by device and number."""
    found: dict[tuple[int, int], int] = {}
    for process in processes if PROC.is_dir() else ():
        with suppress(OSError):
            for name in os.listdir(PROC / str(process) / "fd"):
                with suppress(OSError):
                    seen = os.stat(PROC / str(process) / "fd" / name)
                    if stat.S_ISREG(seen.st_mode) and seen.st_nlink == 0:
                        found[seen.st_dev, seen.st_ino] = seen.st_blocks * 512
        with suppress(OSError, ValueError):
            for line in (PROC / str(process) / "maps").read_text(errors="replace").splitlines():
                if line.endswith(" (deleted)") and "/dev/zero" not in line:  # that is memory, and counted as such
                    first, _, offset, device, inode, *_ = line.split()
                    start, end = (int(part, 16) for part in first.split("-"))
                    major, minor = (int(part, 16) for part in device.split(":"))
                    key = os.makedev(major, minor), int(inode)
                    found[key] = max(found.get(key, 0), int(offset, 16) + end - start)
    return found


class _Used(NamedTuple):
    """What a folder holds."""

    disk: int = 0  # bytes
    files: int = 0  # counted a little beyond `MOST_FILES`
    strange: str | None = None  # what was made there that hides files from this count


def _used(folder: int | Path, depth: int = 0, files: int = 0) -> _Used:
    """Return what a folder holds, and all in it; paths there may be longer than the system takes.

    Args:
        folder: its path, or its descriptor.
        depth: of folders above it.
        files: that were counted before.
    """
    disk = 0
    strange = None
    if depth > MOST_DEPTH:
        return _Used(disk, files, f"it made more than {MOST_DEPTH} folders within each other")
    with os.scandir(folder) as entries:
        for entry in entries:
            files += 1
            with suppress(OSError):
                disk += entry.stat(follow_symlinks=False).st_blocks * 512
                if entry.is_dir(follow_symlinks=False):
                    below = _opened(entry, folder, depth, files)
                    disk = disk + below.disk
                    files = below.files
                    strange = strange or below.strange
            if files > MOST_FILES or strange is not None:
                break
    return _Used(disk, files, strange)


def _opened(entry: os.DirEntry[str], folder: int | Path, depth: int, files: int) -> _Used:
    """Return what a folder within another one holds; see `_used`."""
    within = folder if isinstance(folder, int) else None
    name = entry.name if within else entry.path
    try:
        opened = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=within)
    except PermissionError:
        return _Used(0, files, "it made a folder that cannot be read")
    try:
        return _used(opened, depth + 1, files)
    finally:
        os.close(opened)


# what runs in the new process


def main() -> None:
    """Set the limits, and run the module that the first argument names, with its arguments."""
    limits, paths, *called = json.loads(sys.argv[1])
    _limit(Limits(*limits))
    # not before: Python imports a sitecustomize that it finds, and modules of these names in place of those of Python
    sys.path += paths
    os.environ["PYTHONPATH"] = os.pathsep.join([os.environ["PYTHONPATH"], *paths])
    sys.argv = called
    runpy.run_module(called[0], run_name="__main__", alter_sys=True)


def _limit(limits: Limits) -> None:
    """Set the limits that the system holds, of this process and of each that it starts."""
    import resource  # here: only POSIX systems have it

    wanted = {
        resource.RLIMIT_DATA: limits.memory,
        resource.RLIMIT_FSIZE: limits.disk,
        resource.RLIMIT_CPU: math.ceil(limits.seconds) * (os.cpu_count() or 1),
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: MOST_OPEN,
        resource.RLIMIT_NPROC: MOST_THREADS,
    }
    for kind, value in wanted.items():
        hard = resource.getrlimit(kind)[1]
        most = min(value, LARGEST_INT if hard == resource.RLIM_INFINITY else hard)
        resource.setrlimit(kind, (most, most))


if __name__ == "__main__":
    main()
