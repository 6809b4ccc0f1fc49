"""The code of others in a process of its own: limits of time, memory and disk, and what the system can close off.

On Linux the process gets name spaces of its own, where the system allows them to users: no network, no other process
in reach, and all files but those of its folder read-only. Limits hold on every POSIX system; `Isolation` says what
this system cannot do. ``python -m ctgraph_rl.board.isolate`` is the first thing that runs in the new process: no module
of others can be imported before all of that is done.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

from ctgraph_rl.checks import LARGEST_INT, positive, require

HERE = "ctgraph_rl.board.isolate"

OUTPUT = "output.txt"
"""The file in its folder that a process prints to."""

MOST_OUTPUT = 2**12
"""Bytes of `OUTPUT` that are shown: the last ones."""

MOST_PROCESSES, MOST_FILES, MOST_OPEN = 256, 100_000, 4096
"""Processes at once, files in the folder and open files of a process."""

SECONDS_BETWEEN_LOOKS = 0.2
"""At the use of memory and disk."""

KEPT = ("PATH", "LANG", "LC_ALL", "TZ", "CC", "LD_LIBRARY_PATH", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")
"""Variables of the environment that a process is given; no other is."""

SOCKETS = ("/run", "/var/run", "/tmp")
"""Folders in which programs listen on Unix sockets: a process finds them empty, but for what it runs from."""

PROC = Path("/proc")

# from linux/sched.h, linux/mount.h, linux/prctl.h and linux/capability.h
NEW_USER, NEW_NETWORK, NEW_PROCESSES, NEW_MOUNTS = 0x10000000, 0x40000000, 0x20000000, 0x00020000
BIND, RECURSIVE, PRIVATE, DETACH = 0x1000, 0x4000, 0x40000, 2
MOUNT_SETATTR, AT_CWD, AT_RECURSIVE, READ_ONLY = 442, -100, 0x8000, 1
DIE_WITH_PARENT, DROP_FROM_BOUNDS, NO_NEW_PRIVILEGES, LAST_CAPABILITY = 1, 24, 38, 40
CAPABILITIES_3 = 0x20080522


class Limits(NamedTuple):
    """What a process may use."""

    seconds: float  # of wall-clock time
    memory: int  # bytes, of all its processes
    disk: int  # bytes, in its folder


class Isolation(NamedTuple):
    """What this system closes off for a process of ours."""

    network: bool
    files: bool  # all but those of its folder are read-only
    processes: bool  # others are out of reach, and its own end with it
    memory: bool  # the use of all its processes is seen; else each alone is limited
    sockets: bool  # those of `SOCKETS` are out of sight

    def missing(self) -> list[str]:
        """Return a sentence for each thing that the code of others could do here."""
        open_ways = {
            "network": "it can use the network",
            "files": "it can read and change every file that you can",
            "processes": "it can signal your other processes and read their environment, and leave some behind",
            "memory": "its memory is limited for each process alone, and not for all together",
            "sockets": "it can connect to every Unix socket that you can, such as those of ssh-agent and docker",
        }
        reads = "it can read every file that you can"
        reads += f", and connect to Unix sockets outside {', '.join(SOCKETS)}" if self.sockets else ""
        return [text for name, text in open_ways.items() if not getattr(self, name)] + [reads] * self.files


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


def isolation(folder: Path) -> Isolation:
    """Return what this system closes off, found by a process that tries.

    Args:
        folder: an existing directory for that process.
    """
    require((os.name == "posix", "verify needs a POSIX system to limit the code of others; use Linux or macOS"))
    done = subprocess.run(_command({"folder": str(folder.resolve())}), capture_output=True, env=_environment(folder))
    try:
        found = json.loads(done.stdout)
    except ValueError:
        found = []
    closed = {name: name in found for name in ("network", "files", "processes", "sockets")}
    return Isolation(**closed, memory=PROC.is_dir())


def run_isolated(
    module: str,
    arguments: Sequence[str],
    folder: Path,
    limits: Limits,
    *,
    paths: Sequence[Path] = (),
    variables: Mapping[str, str] | None = None,
    watch: Callable[[], object] = lambda: None,
) -> Outcome:
    """Run a module in a process of its own, within limits, and leave none of its processes behind.

    Args:
        module: as of ``python -m``.
        arguments: of the module.
        folder: an existing directory, the only one that it may change; its working directory and its home.
        limits: what it may use.
        paths: folders in which it finds more modules, after those that are installed.
        variables: of its environment, beside `KEPT`.
        watch: is called several times a second.

    Raises:
        ValueError: for a limit that is not positive.
    """
    require(*positive(seconds=limits.seconds, memory=limits.memory, disk=limits.disk))
    folder = folder.resolve()
    (folder / "tmp").mkdir(exist_ok=True)
    spec = {"folder": str(folder), "limits": limits, "module": module, "arguments": list(arguments)}
    spec["paths"] = [str(path.resolve()) for path in paths]
    environment = {**_environment(folder), **(variables or {})}
    (folder / OUTPUT).unlink(missing_ok=True)
    with (folder / OUTPUT).open("x+b") as output:
        with _process(_command(spec), folder, environment, output) as process:
            start = time.monotonic()
            stopped = _watched(process, folder, limits, watch)
            if stopped is not None:
                _kill(process)
            code = process.wait()
        return Outcome(code, stopped, time.monotonic() - start, _tail(output))


def _tail(output: IO[bytes]) -> str:
    """Return the end of what was printed, from the file as it was opened, whatever now has its name."""
    size = output.seek(0, os.SEEK_END)
    output.seek(max(0, size - MOST_OUTPUT))
    return output.read(MOST_OUTPUT).decode("utf-8", "replace")


def _command(spec: Mapping[str, object]) -> list[str]:
    """Return what starts a process that finds no modules in its working directory or its home."""
    return [sys.executable, "-P", "-s", "-m", HERE, json.dumps(spec)]


def _environment(folder: Path) -> dict[str, str]:
    """Return the variables of a new process: no credentials, and its folder as its home."""
    kept = {name: os.environ[name] for name in KEPT if name in os.environ}
    package = Path(__file__).resolve().parents[2]
    own = {"HOME": str(folder), "TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(package)}
    return {**kept, **own, "PYTHONDONTWRITEBYTECODE": "1"}


@contextmanager
def _process(
    command: Sequence[str], folder: Path, environment: Mapping[str, str], output: IO[bytes]
) -> Iterator[subprocess.Popen[bytes]]:
    """Start a process as the first of a group and session of its own; kill all of them however this ends."""
    streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": subprocess.STDOUT}
    process = subprocess.Popen(command, cwd=folder, env=dict(environment), start_new_session=True, **streams)
    try:
        yield process
    finally:
        _kill(process)
        process.wait()


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a process, those that it started as far as they are seen, and its group."""
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
    memory, (disk, files) = sum(each for _, each in family), _used(folder)
    rules = {
        f"it took longer than {limits.seconds:g} seconds": is_late,
        f"it used more than {limits.memory:,} bytes of memory": memory > limits.memory,
        f"it wrote more than {limits.disk:,} bytes": disk > limits.disk,
        f"it made more than {MOST_FILES:,} files": files > MOST_FILES,
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


def _used(folder: Path) -> tuple[int, int]:
    """Return the bytes on disk of a folder, and its files, counted a little beyond `MOST_FILES`."""
    total, count = 0, 0
    for where, folders, files in os.walk(folder):
        count += len(folders) + len(files)
        for name in (*folders, *files):
            with suppress(OSError):
                total += os.lstat(os.path.join(where, name)).st_blocks * 512
        if count > MOST_FILES:
            break
    return total, count


# what runs in the new process


def main() -> None:
    """Close off what the system allows, set the limits, and run the module that the first argument names."""
    spec = json.loads(sys.argv[1])
    with suppress(OSError, AttributeError):
        _libc().prctl(DIE_WITH_PARENT, signal.SIGKILL)
    paths = spec.get("paths", [])
    closed = _close_off(Path(spec["folder"]), paths)
    if "module" not in spec:
        print(json.dumps(closed))
        return
    _limit(Limits(*spec["limits"]))
    # not before: Python imports a sitecustomize that it finds, and modules of these names in place of its own
    sys.path += paths
    os.environ["PYTHONPATH"] = os.pathsep.join([os.environ["PYTHONPATH"], *paths])
    sys.argv = [spec["module"], *spec["arguments"]]
    runpy.run_module(spec["module"], run_name="__main__", alter_sys=True)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _close_off(folder: Path, paths: Sequence[str]) -> list[str]:
    """Enter name spaces of this process's own, as many as the system allows; return what they close off."""
    if sys.platform != "linux":
        return []
    user, group, closed = os.getuid(), os.getgid(), []
    if not _unshared(NEW_USER | NEW_NETWORK):
        return []
    closed.append("network")
    with suppress(OSError):
        for name, text in (("uid_map", f"{user} {user} 1"), ("setgroups", "deny"), ("gid_map", f"{group} {group} 1")):
            (PROC / "self" / name).write_text(text)
    if _unshared(NEW_PROCESSES):
        closed.append("processes")
        _become_first_process()
    if _unshared(NEW_MOUNTS) and _libc().mount(b"none", b"/", None, RECURSIVE | PRIVATE, None) == 0:
        needed = _needed([str(folder), *paths])
        emptied = [_emptied(os.path.realpath(place), needed) for place in SOCKETS]
        closed += ["sockets"] * all(emptied)
        closed += ["files"] * _only_writes(os.fsencode(folder))
    os.chdir(folder)
    _drop_capabilities()
    return closed


def _unshared(flags: int) -> bool:
    return _libc().unshare(flags) == 0


def _become_first_process() -> None:
    """Continue in a child, the first process of a new name space, with which all others of it end; wait for it here."""
    child = os.fork()
    if child == 0:
        _libc().prctl(DIE_WITH_PARENT, signal.SIGKILL)
        return
    _, status = os.waitpid(child, 0)
    os._exit(os.waitstatus_to_exitcode(status) % 256)


def _needed(given: Sequence[str]) -> list[str]:
    """Return the folders that a process runs from: given ones, and those of Python, programs and libraries."""
    listed = [os.environ.get(name, "").split(os.pathsep) for name in ("PATH", "LD_LIBRARY_PATH")]
    folders = [*given, sys.prefix, sys.base_prefix, *sys.path, *(each for some in listed for each in some)]
    both = [path for each in folders if each for path in (os.path.abspath(each), os.path.realpath(each))]
    return sorted({path for path in both if os.path.isdir(path)})


def _emptied(place: str, needed: Sequence[str]) -> bool:
    """Mount an empty folder over one, and in it what is needed of the one; return whether all else is out of sight."""
    libc, target = _libc(), os.fsencode(place)
    if any(Path(place).is_relative_to(path) for path in needed):
        return False
    within = {path: os.open(path, os.O_PATH) for path in needed if Path(path).is_relative_to(place)}
    if not os.path.isdir(place) or libc.mount(b"none", target, b"tmpfs", 0, None) != 0:
        return not os.path.isdir(place)
    for path, number in within.items():
        os.makedirs(path, exist_ok=True)
        if libc.mount(os.fsencode(f"/proc/self/fd/{number}"), os.fsencode(path), None, BIND | RECURSIVE, None) != 0:
            libc.umount2(target, DETACH)
            return False
    return True


def _only_writes(folder: bytes) -> bool:
    """Make all mounted files but those of one folder read-only; return whether that worked."""
    is_own = _libc().mount(folder, folder, None, BIND | RECURSIVE, None) == 0
    return is_own and _mount_flags(b"/", AT_RECURSIVE, READ_ONLY, 0) and _mount_flags(folder, 0, 0, READ_ONLY)


def _mount_flags(path: bytes, how: int, added: int, removed: int) -> bool:
    flags = (ctypes.c_uint64 * 4)(added, removed, 0, 0)
    arguments = (AT_CWD, path, how, ctypes.byref(flags), ctypes.sizeof(flags))
    return _libc().syscall(MOUNT_SETATTR, *arguments) == 0


def _drop_capabilities() -> None:
    """Give up what the first process of a name space may do to it, for good."""
    libc = _libc()
    for each in range(LAST_CAPABILITY + 1):
        libc.prctl(DROP_FROM_BOUNDS, each, 0, 0, 0)
    libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    header, nothing = (ctypes.c_uint32 * 2)(CAPABILITIES_3, 0), (ctypes.c_uint32 * 6)()
    libc.capset(ctypes.byref(header), ctypes.byref(nothing))


def _limit(limits: Limits) -> None:
    """Set the limits that the system holds, of this process and of each that it starts."""
    import resource  # here: POSIX systems alone have it

    seconds = math.ceil(limits.seconds) * (os.cpu_count() or 1)
    wanted = {
        resource.RLIMIT_DATA: limits.memory,
        resource.RLIMIT_FSIZE: limits.disk,
        resource.RLIMIT_CPU: seconds,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: MOST_OPEN,
    }
    for kind, value in wanted.items():
        hard = resource.getrlimit(kind)[1]
        most = min(value, LARGEST_INT if hard == resource.RLIM_INFINITY else hard)
        resource.setrlimit(kind, (most, most))


if __name__ == "__main__":
    main()
