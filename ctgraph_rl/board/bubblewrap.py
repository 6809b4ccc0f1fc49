"""What closes off the code of others on Linux: name spaces that bubblewrap makes, and a filter of system calls.

https://github.com/containers/bubblewrap, 0.8 or newer. Inside are Python and the programs of the system, read-only, and
one folder to write to. There is no network, no other process, no capability, no terminal and nothing that was open.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path

from ctgraph_rl.board.system_calls import filter_of
from ctgraph_rl.checks import require

OLDEST = (0, 8)
"""The first version that has all options."""

OPTIONS = (
    *("--unshare-all", "--unshare-user", "--disable-userns", "--cap-drop", "ALL"),
    *("--new-session", "--die-with-parent"),
)
"""New name spaces but no further ones, no capability, no terminal; the process ends when its watcher ends."""

SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32", "/etc/alternatives", "/etc/ld.so.cache")
"""Programs and libraries."""

PACKAGES = ("ctgraph_rl", "baselines", "conf", "curricula", "hydra_plugins")
"""Folders of our packages, beside each other."""

GRAPHICS = ("nvidia*", "kfd", "dri")
"""Devices of graphics cards, in ``/dev``."""

OWN = {"/tmp": "tmp", "/dev/shm": "shm"}
"""Folders to write to, and where they are in the folder of the process: what is written there is counted with it."""

SECONDS_TO_START = 60


def why_not(folder: Path, environment: Mapping[str, str]) -> str | None:
    """Return why bubblewrap cannot be used here; None if it can: a process inside has answered.

    Args:
        folder: an existing directory for that process.
        environment: its variables.
    """
    if sys.platform != "linux":
        return "bubblewrap needs Linux"
    if filter_of() is None:
        return f"no filter of system calls is known for {os.uname().machine}"
    found = version()
    if found is None or found < OLDEST:
        shown = "there is none" if found is None else f"this is {'.'.join(map(str, found))}"
        return f"it needs bubblewrap {'.'.join(map(str, OLDEST))} or newer, {shown}: install the package bubblewrap"
    with program() as filtering:
        command = confined([sys.executable, "-I", "-S", "-c", "print('inside')"], folder, filtering=filtering)
        done = subprocess.run(
            command,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            pass_fds=(filtering,),
            timeout=SECONDS_TO_START,
        )
    last = done.stderr.strip().splitlines()[-1:] or ["it printed nothing"]
    return None if done.stdout == "inside\n" else f"bubblewrap does not start here: {last[0]}"


def version() -> tuple[int, ...] | None:
    """Return the version of bubblewrap; None where there is none."""
    path = shutil.which("bwrap")
    if path is None:
        return None
    done = subprocess.run([path, "--version"], capture_output=True, text=True)
    found = re.search(r"(\d+)\.(\d+)\.(\d+)", done.stdout)
    return None if found is None else tuple(map(int, found.groups()))


@contextmanager
def program() -> Iterator[int]:
    """Open the filter of system calls for `confined`."""
    content = filter_of()
    assert content is not None
    reading, writing = os.pipe()
    try:
        os.write(writing, content)
        os.close(writing)
        yield reading
    finally:
        os.close(reading)


def confined(
    command: Sequence[str], folder: Path, paths: Sequence[Path] = (), *, filtering: int, graphics: bool = False
) -> list[str]:
    """Return the command that runs another one inside.

    Args:
        command: the other one.
        folder: an absolute path, the only folder that it may change; its working directory.
        paths: folders that it may read beside the system's and Python's.
        filtering: the open `program`.
        graphics: whether it may use the graphics cards.

    Raises:
        ValueError: for a path that would show all files.
    """
    wrong = [str(path) for path in paths if Path(os.path.realpath(path)) == Path("/")]
    require((not wrong, "the code of others must be in a folder below /, got /"))
    made = [str(shutil.which("bwrap")), *OPTIONS, "--seccomp", str(filtering), "--proc", "/proc", "--dev", "/dev"]
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
    """Return what Python and our packages are read from, and given folders, those that hold others first."""
    package = Path(__file__).resolve().parents[2]
    sites = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    named: list[str | Path] = [*paths, sys.prefix, sys.base_prefix, *sites, *(package / name for name in PACKAGES)]
    both = {*map(os.path.abspath, named), *map(os.path.realpath, named)}
    return sorted(path for path in both if os.path.isdir(path) and not Path(path).is_relative_to("/usr"))
