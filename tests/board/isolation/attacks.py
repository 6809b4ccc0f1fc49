"""What hostile code tries, as a program of the standard library alone, and a program that starts it in bubblewrap.

``python attacks.py inside SPEC`` tries each attack that SPEC names, and prints a JSON object of what came of it:
``open`` where it worked, or the error. ``python attacks.py around SPEC`` starts the former in
`ctgraph_rl.board.isolate`, without the options that SPEC lists: a test then sees what each of them is for.
"""

from __future__ import annotations

import ctypes
import json
import os
import pty
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

LIBC = ctypes.CDLL(None, use_errno=True)

NEW_USER, KEYCTL, ADD_KEY, SHMGET, SESSION = 0x10000000, 250, 248, 29, -3


def called(result: int) -> None:
    """Raise the error of a function of C."""
    if result == -1:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def write(path: str) -> None:
    """Open a file for writing, and write nothing."""
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT))


def mount(spec: Any) -> None:
    called(LIBC.mount(b"none", spec["folder"].encode(), b"tmpfs", 0, None))


def find(what: str, text: str) -> None:
    """Look for a text in what processes show of themselves."""
    for process in Path("/proc").glob("[0-9]*"):
        if int(process.name) != os.getpid() and text.encode() in (process / what).read_bytes():
            return
    raise OSError(0, "none has it")


def missing() -> None:
    raise OSError(0, "it is not there")


def connect(family: int, address: Any) -> None:
    with socket.socket(family) as client:
        client.settimeout(5)
        client.connect(address)


def descriptors(spec: Any) -> None:
    for number in range(3, 300):
        try:
            os.fstat(number)
        except OSError:
            continue
        return
    raise OSError(0, "none is open")


def capabilities(spec: Any) -> None:
    lines = Path("/proc/self/status").read_text().splitlines()
    if not any(line.startswith("Cap") and line.split()[1] != "0" * 16 for line in lines):
        raise OSError(0, "it has none")


def shared_memory(spec: Any) -> None:
    """Find a segment of System V that was made outside."""
    if str(spec["key"]) not in Path("/proc/sysvipc/shm").read_text().split():
        raise OSError(0, "it sees none")


ATTACKS: dict[str, Callable[[Any], Any]] = {
    "descriptors": descriptors,
    "capabilities": capabilities,
    "mount": mount,
    "host name": lambda spec: socket.sethostname("hostile"),
    "write to /": lambda spec: write("/hostile"),
    "write to /dev": lambda spec: write("/dev/hostile"),
    "write to /usr": lambda spec: write("/usr/hostile"),
    "write to the code": lambda spec: write(f"{spec['code']}/hostile"),
    "settings of the kernel": lambda spec: os.close(os.open("/proc/sys/kernel/core_pattern", os.O_WRONLY)),
    "disk": lambda spec: [os.stat(path) for path in ("/dev/vda", "/dev/sda", "/dev/kmsg", "/dev/mem")],
    "file of others": lambda spec: Path(spec["file"]).read_bytes(),
    "file in /tmp": lambda spec: Path(spec["socket"]).stat(),
    "file in /dev/shm": lambda spec: Path(spec["shm"]).read_bytes(),
    "other process": lambda spec: find("cmdline", "outside-marker"),
    "environment of others": lambda spec: find("environ", "MY_TOKEN"),
    "environment": lambda spec: os.environ["MY_TOKEN"] if "MY_TOKEN" in os.environ else missing(),
    "network": lambda spec: connect(socket.AF_INET, ("127.0.0.1", spec["port"])),
    "socket": lambda spec: connect(socket.AF_UNIX, spec["socket"]),
    "abstract socket": lambda spec: connect(socket.AF_UNIX, "\0" + spec["abstract"]),
    "packets": lambda spec: socket.socket(socket.AF_PACKET, socket.SOCK_RAW).close(),
    "shared memory of others": shared_memory,
    "shared memory": lambda spec: called(LIBC.syscall(SHMGET, 0, 4096, 0o1600)),
    "memory file": lambda spec: os.close(os.memfd_create("hostile")),
    "keyring": lambda spec: called(LIBC.syscall(KEYCTL, 0, SESSION, 1)),
    "key": lambda spec: called(LIBC.syscall(ADD_KEY, b"user", b"hostile", b"x", 1, SESSION)),
    "user name space": lambda spec: called(LIBC.unshare(NEW_USER)),
    "terminal": lambda spec: os.close(os.open("/dev/tty", os.O_RDWR)),
}
"""Attacks by name, in the order in which they are tried: the first ones look at what is there."""


def inside(spec: Any) -> None:
    """Try attacks."""
    found = {}
    for name, attack in ATTACKS.items():
        if name in spec["attacks"]:
            try:
                attack(spec)
                found[name] = "open"
            except OSError as error:
                found[name] = error.strerror
    print(json.dumps(found), flush=True)
    end = time.monotonic() + spec.get("beats", 0)
    while time.monotonic() < end and not Path("enough").exists():
        with open("beat", "a") as file:
            file.write("x")
        time.sleep(0.02)


def around(spec: Any) -> None:
    """Start attacks in bubblewrap, from a process with a terminal and more that is open."""
    from ctgraph_rl.board import isolate

    extra = os.open(spec["socket"].rpartition("/")[0], os.O_RDONLY)
    os.set_inheritable(extra, True)
    folder = Path(spec["folder"])
    for name in isolate.OWN.values():
        (folder / name).mkdir(exist_ok=True)
    with isolate.system_calls() as filtering:
        command = [sys.executable, "-I", "-S", f"{spec['code']}/attacks.py", "inside", json.dumps(spec)]
        full = isolate.confined(command, folder, [Path(spec["code"])], {}, filtering=filtering)
        for options, others in spec.get("without", ()):
            options = [str(filtering) if each == "FILTER" else each for each in options]
            starts = [i for i in range(len(full)) if full[i : i + len(options)] == options]
            full[starts[0] : starts[0] + len(options)] = others
        kept = () if not spec.get("descriptors") else (extra,)
        done = subprocess.run(full, capture_output=True, pass_fds=(filtering, *kept))
    sys.stdout.buffer.write(done.stdout + done.stderr)


def with_terminal(spec: Any) -> None:
    """Start `around` as the leader of a terminal's session."""
    process, terminal = pty.fork()
    if process == 0:
        os.execv(sys.executable, [sys.executable, __file__, "around", json.dumps(spec)])
    said = b""
    while True:
        try:
            said += os.read(terminal, 2**16)
        except OSError:
            break
    os.waitpid(process, 0)
    sys.stdout.buffer.write(said)


if __name__ == "__main__":
    globals()[sys.argv[1]](json.loads(sys.argv[2]))
