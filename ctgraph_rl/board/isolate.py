"""The code of others in bubblewrap, within limits of time, memory, disk and processes.

https://github.com/containers/bubblewrap, 0.8 or newer. Inside are Python and the system's programs, read-only, and one
writable folder; no network, other process, capability, terminal or open file. libseccomp filters system calls. Without
these nothing runs.

A cgroup, made here or by systemd, limits the memory of all processes together, else a number of threads with a share
each. Where neither works, nothing runs.
"""

from __future__ import annotations

import ctypes
import errno
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import NamedTuple

from ctgraph_rl.checks import require
from ctgraph_rl.disk import make_folder

OLDEST = (0, 8)

OPTIONS = (
    *("--unshare-all", "--unshare-user", "--disable-userns", "--cap-drop", "ALL"),
    *("--new-session", "--die-with-parent"),
)
"""New name spaces but no further ones, no capability, no terminal; the process ends with its watcher."""

SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32", "/etc/alternatives", "/etc/ld.so.cache")

PACKAGES = ("ctgraph_rl", "baselines", "conf", "curricula", "hydra_plugins")

GRAPHICS = ("nvidia*", "kfd", "dri")

OWN = {"/tmp": "tmp", "/dev/shm": "shm"}
"""Folders to write to, and their places in the folder of the process, with which they are counted."""

KEPT = ("PATH", "LANG", "LC_ALL", "TZ", "CC", "LD_LIBRARY_PATH", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")

REFUSED = {
    errno.EPERM: (
        *("add_key", "bpf", "keyctl", "mq_open", "msgget", "perf_event_open", "ptrace", "request_key", "semget"),
        *("syslog", "userfaultfd"),
    ),
    errno.ENOSYS: ("io_uring_setup", "memfd_create", "memfd_secret", "shmget"),
}
"""System calls by the error that they give: keyrings, debugging, the kernel's programs, memory outside of limits.

Libraries use others where one is missing (ENOSYS).
"""

ALLOW, REFUSE = 0x7FFF0000, 0x00050000

CGROUPS = Path("/sys/fs/cgroup")

MOST_FILES, MOST_OPEN, MOST_THREADS = 100_000, 4096, 1024

LEAST_FREE = 10**9

MOST_OUTPUT = 2**12
"""Last bytes of a process's output that are shown."""

SECONDS_BETWEEN_LOOKS = 0.5
"""At the folder of a process."""

SECONDS_TO_START = 60

CGROUP, SYSTEMD, THREADS = "a cgroup", "systemd", "threads"


class Limits(NamedTuple):
    """What a process and its children may use, more than 0 of each."""

    seconds: float  # of wall-clock time
    memory: int  # bytes
    disk: int  # bytes, in its folder
    threads: int = 1  # that it needs, at least; used where a number of threads limits memory

    @property
    def most_threads(self) -> int:
        """Threads of all processes that share the memory: Python starts a few beside those of torch."""
        return 4 + 2 * self.threads


class Isolation(NamedTuple):
    """How the code of others is isolated here."""

    bubblewrap: str | None  # its version; None: it cannot be used
    why_not: str | None  # why it cannot, and what to install
    memory: str | None  # how memory is limited, one of `CGROUP`, `SYSTEMD`, `THREADS`
    graphics: bool  # whether the code may use the graphics cards

    def closed(self) -> list[str]:
        """Return what is isolated, a text for each thing."""
        inside = "it sees no files but its folder, the code, Python and the programs of the system"
        other = "no other process, socket, shared memory, keyring, device or terminal"
        memory = f"memory limited for all its processes together, by {self.memory}"
        return [f"bubblewrap {self.bubblewrap}", "no network", inside, "it changes only its folder", other, memory]

    def missing(self) -> list[str]:
        """Return what is not isolated or not limited, a text for each thing."""
        cards = "graphics cards: it may use all of their memory and of their driver"
        kernel = "the kernel's own memory for it is not limited, such as buffers of pipes and sockets"
        return [
            "weaknesses of the kernel stay, and what the processor's caches tell of other programs",
            "it can see which files are opened in the folders that it reads (inotify)",
            f"the disk is looked at {1 / SECONDS_BETWEEN_LOOKS:g} times a second; files that it removed and has open "
            f"count only where less than {LEAST_FREE:,} bytes stay free",
            *([kernel] if self.memory == THREADS else []),
            *([cards] if self.graphics else []),
        ]


class Outcome(NamedTuple):
    """How a process ended."""

    code: int  # its exit status; negative for a signal
    stopped: str | None  # the limit that it broke
    output: str  # the end of what it printed

    @property
    def failure(self) -> str | None:
        """Why it failed, in words; None if it did not."""
        if self.stopped is not None:
            return f"stopped: {self.stopped}"
        last = self.output.strip().splitlines()[-1:] or ["it printed nothing"]
        return None if self.code == 0 else f"ended with exit code {self.code}: {last[0]}"


def isolation(folder: Path, limits: Limits, graphics: bool = False) -> Isolation:
    """Return what this system isolates, by a test process for each way to limit memory.

    Args:
        folder: an existing directory for that process.
    """
    found = bubblewrap_version()
    shown = ".".join(map(str, found or ()))
    why_not = None
    if sys.platform != "linux":
        why_not = "bubblewrap needs Linux"
    elif found is None or found < OLDEST:
        there = "there is none" if found is None else f"this is {shown}"
        why_not = f"it needs bubblewrap {'.'.join(map(str, OLDEST))} or newer, {there}: install the package bubblewrap"
    elif _libseccomp() is None:
        why_not = "it needs libseccomp 2, there is none: install the package libseccomp2"
    if why_not is not None:
        return Isolation(None, why_not, None, graphics)
    said = []
    for way in (CGROUP, SYSTEMD, THREADS):
        if way == THREADS and os.geteuid() == 0:
            said.append(f"{way}: the system holds root to no number of them, be an ordinary user")
            continue
        here = Isolation(shown, None, way, graphics)
        try:
            short = limits._replace(seconds=SECONDS_TO_START)
            outcome = run_isolated([sys.executable, "-I", "-S", "-c", "print('inside')"], folder, short, here)
        except OSError as error:
            said.append(f"{way}: {error.strerror}")
            continue
        if (outcome.code, outcome.output) == (0, "inside\n"):
            return here
        said.append(f"{way}: {outcome.failure or 'it did not answer'}")
    return Isolation(None, f"bubblewrap does not start here with limited memory: {'; '.join(said)}", None, graphics)


def bubblewrap_version() -> tuple[int, ...] | None:
    """Return the version of bubblewrap, if it is installed."""
    path = shutil.which("bwrap")
    if path is None:
        return None
    done = subprocess.run([path, "--version"], capture_output=True, text=True)
    found = re.search(r"(\d+)\.(\d+)\.(\d+)", done.stdout)
    return None if found is None else tuple(map(int, found.groups()))


def run_isolated(
    command: Sequence[str],
    folder: Path,
    limits: Limits,
    isolated: Isolation,
    *,
    paths: Sequence[Path] = (),
    variables: Mapping[str, str] | None = None,
) -> Outcome:
    """Run a command in bubblewrap, within limits, and leave no process behind.

    Args:
        command: starts with an absolute path.
        folder: an existing directory, the only one that it may change; its working directory and home.
        paths: folders that it may read beside the system's and Python's.
        variables: of its environment, beside `KEPT`.

    Raises:
        ValueError: where `isolation` found no way.
        OSError: if no cgroup can be made.
    """
    require((isolated.why_not is None, f"the code of others is not run: {isolated.why_not}"))
    folder = folder.resolve()
    for name in OWN.values():
        make_folder(folder / name)
    own = {"HOME": str(folder), "TMPDIR": str(folder / "tmp"), **(variables or {})}
    groups = new_cgroups(limits.memory) if isolated.memory == CGROUP else []
    try:
        with system_calls() as filtering, TemporaryFile(dir=folder) as said:
            inside = [*_limit_each(limits, isolated.memory == THREADS), *command]
            closed = confined(inside, folder, paths, own, filtering=filtering, graphics=isolated.graphics)
            process = subprocess.Popen(
                [*_limit_together(limits, isolated.memory, groups), *closed],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
                pass_fds=(filtering,),
                start_new_session=True,
            )
            try:
                stopped = _wait(process, folder, limits)
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            said.seek(max(0, said.seek(0, os.SEEK_END) - MOST_OUTPUT))
            output = said.read().decode("utf-8", "replace")
    finally:
        _remove_cgroups(groups)
        strip_privileges(folder)
    if stopped is None and process.returncode in (-signal.SIGKILL, 128 + signal.SIGKILL):
        stopped = f"it was killed, as where it uses more than {limits.memory:,} bytes of memory"
    return Outcome(process.returncode, stopped, output)


def _wait(process: subprocess.Popen[bytes], folder: Path, limits: Limits) -> str | None:
    end = time.monotonic() + limits.seconds
    while True:
        try:
            process.wait(SECONDS_BETWEEN_LOOKS)
        except subprocess.TimeoutExpired:
            if time.monotonic() > end:
                return f"it took longer than {limits.seconds:g} seconds"
        broken = _why_too_much(folder, limits.disk)
        if broken is not None or process.returncode is not None:
            return broken


def _why_too_much(folder: Path, disk: int) -> str | None:
    closed = ["-type", "d", "(", "!", "-readable", "-o", "!", "-executable", ")", "-printf", "closed\n"]
    command = ["find", str(folder), "-xdev", *closed, "-o", "-printf", "%b\n"]
    blocks = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True).stdout.split()
    if "closed" in blocks:
        return "it made a folder that cannot be read"
    if len(blocks) > MOST_FILES:
        return f"it made more than {MOST_FILES:,} files"
    if 512 * sum(map(int, blocks)) > disk:
        return f"it wrote more than {disk:,} bytes"
    free = shutil.disk_usage(folder).free
    return f"less than {LEAST_FREE:,} bytes of the disk stay free" if free < LEAST_FREE else None


def strip_privileges(folder: Path) -> None:
    """Remove the setuid and setgid bits of files and folders."""
    chosen = ["-xdev", "(", "-type", "f", "-o", "-type", "d", ")", "-perm", "/6000"]
    command = ["find", str(folder), *chosen, "-execdir", "chmod", "a-s", "--", "{}", "+"]
    subprocess.run(command, env={"PATH": "/usr/bin:/bin"}, stderr=subprocess.DEVNULL)


def _limit_each(limits: Limits, shares_memory: bool) -> list[str]:
    import resource  # here: only POSIX systems have it

    seconds = math.ceil(limits.seconds) * (os.cpu_count() or 1)
    wanted = {"FSIZE": limits.disk, "CPU": seconds, "CORE": 0, "NOFILE": MOST_OPEN}
    if shares_memory:
        wanted |= {"NPROC": limits.most_threads, "AS": limits.memory // limits.most_threads}
    found = ["prlimit"]
    for name, value in wanted.items():
        hard = resource.getrlimit(getattr(resource, f"RLIMIT_{name}"))[1]
        most = value if hard == resource.RLIM_INFINITY else min(value, hard)
        found.append(f"--{name.lower()}={most}")
    return found


def _limit_together(limits: Limits, way: str | None, groups: Sequence[Path]) -> list[str]:
    if way == SYSTEMD:
        user = [] if os.geteuid() == 0 else ["--user"]
        values = (f"MemoryMax={limits.memory}", "MemorySwapMax=0", f"TasksMax={MOST_THREADS}")
        return ["systemd-run", *user, "--scope", "--quiet", "--collect", *(f"--property={each}" for each in values)]
    found: list[str] = []
    for group in groups:
        found += ["sh", "-c", 'echo $$ > "$0" && exec "$@"', str(group / "cgroup.procs")]
    return found


def new_cgroups(memory: int) -> list[Path]:
    """Make cgroups with limits within those of this process; two in version 1.

    Raises:
        OSError: where none can be made, or one lacks a limit.
    """
    own = _own_cgroups()
    if "memory" in own:
        values = {
            CGROUPS / "memory" / own["memory"]: {
                "memory.limit_in_bytes": memory,
                "memory.memsw.limit_in_bytes": memory,
            },
            CGROUPS / "pids" / own.get("pids", ""): {"pids.max": MOST_THREADS},
        }
    else:
        home = CGROUPS / own.get("", "")
        _set(home / "cgroup.subtree_control", "+memory +pids")
        whole = {"memory.max": memory, "memory.swap.max": 0, "memory.oom.group": 1, "pids.max": MOST_THREADS}
        values = {home: whole}
    made: list[Path] = []
    try:
        for home, files in values.items():
            group = home / f"ctgraph_rl-{os.getpid()}-{time.monotonic_ns()}"
            group.mkdir()
            made.append(group)
            for name, value in files.items():
                _set(group / name, value)
    except OSError:
        _remove_cgroups(made)
        raise
    return made


def _own_cgroups() -> dict[str, str]:
    """Return this process's cgroups by controller, that of version 2 by an empty text."""
    own = {}
    for line in Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines():
        _, controllers, path = line.split(":", 2)
        own[controllers] = path.removeprefix("/")
    return own


def _set(path: Path, value: object) -> None:
    with path.open("r+", encoding="ascii") as file:
        file.write(str(value))


def _remove_cgroups(groups: Sequence[Path]) -> None:
    end = time.monotonic() + SECONDS_TO_START
    for group in groups:
        while True:
            try:
                group.rmdir()
                break
            except OSError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.01)


def confined(
    command: Sequence[str],
    folder: Path,
    paths: Sequence[Path],
    variables: Mapping[str, str],
    *,
    filtering: int,
    graphics: bool = False,
) -> list[str]:
    """Return the command that runs another one inside; arguments as `run_isolated`.

    ``filtering`` is the open file of `system_calls`.

    Raises:
        ValueError: for a path that would show all files.
    """
    wrong = [str(path) for path in paths if Path(os.path.realpath(path)) == Path("/")]
    require((not wrong, "the code of others must be in a folder below /, got /"))
    kept = {name: os.environ[name] for name in KEPT if name in os.environ}
    made = ["env", "-i"]  # of bubblewrap, too: those inside can read its variables
    for name, value in {**kept, **variables}.items():
        made.append(f"{name}={value}")
    made += [str(shutil.which("bwrap")), *OPTIONS, "--seccomp", str(filtering), "--proc", "/proc", "--dev", "/dev"]
    for path in map(Path, SYSTEM):
        if path.is_symlink():
            made += ["--symlink", os.readlink(path), str(path)]
        elif path.exists():
            made += ["--ro-bind", str(path), str(path)]
    for device in sorted(chain(*map(Path("/dev").glob, GRAPHICS))) if graphics else ():
        made += ["--dev-bind", str(device), str(device)]
    for place, name in OWN.items():
        made += ["--bind", str(folder / name), place]
    for each in _needed(paths):
        made += ["--ro-bind", each, each]
    made += ["--bind", str(folder), str(folder), "--chdir", str(folder)]
    for place in ("/proc", "/dev", "/"):
        made += ["--remount-ro", place]
    return [*made, "--", *command]


def _needed(paths: Sequence[Path]) -> list[str]:
    sites = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    named: list[str | Path] = [*paths, sys.prefix, sys.base_prefix, *sites, *(home() / name for name in PACKAGES)]
    both = {*map(os.path.abspath, named), *map(os.path.realpath, named)}
    return sorted(path for path in both if os.path.isdir(path) and not Path(path).is_relative_to("/usr"))


def home() -> Path:
    """Return the folder that holds our packages."""
    return Path(__file__).resolve().parents[2]


def _libseccomp() -> ctypes.CDLL | None:
    """Return https://github.com/seccomp/libseccomp, if installed."""
    try:
        return ctypes.CDLL("libseccomp.so.2")
    except OSError:
        return None


@contextmanager
def system_calls() -> Iterator[int]:
    """Open a file with libseccomp's filter of system calls for this machine."""
    library = _libseccomp()
    assert library is not None
    library.seccomp_init.restype = ctypes.c_void_p
    program = ctypes.c_void_p(library.seccomp_init(ALLOW))
    with TemporaryFile() as file:
        for error, names in REFUSED.items():
            for name in names:
                number = library.seccomp_syscall_resolve_name(name.encode())
                failed = library.seccomp_rule_add_array(program, REFUSE | error, number, 0, None)
                require((failed == 0, f"this libseccomp does not know the system call {name}: install a newer one"))
        failed = library.seccomp_export_bpf(program, file.fileno())
        library.seccomp_release(program)
        require((failed == 0, "libseccomp cannot write a filter of system calls for this machine"))
        file.seek(0)
        yield file.fileno()
