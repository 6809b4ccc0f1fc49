"""Attacks from inside: none succeeds as root or as an ordinary user, and each option is what stops one."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ctgraph_rl.board import isolate

CODE = Path(__file__).with_name("attacks.py")

ALL_BUT_THE_TERMINAL = [
    *("descriptors", "capabilities", "mount", "host name", "write to /", "write to /dev", "write to /usr"),
    *("write to the code", "settings of the kernel", "disk", "file of others", "file in /tmp", "file in /dev/shm"),
    *("other process", "environment of others", "network", "socket", "abstract socket", "packets", "environment"),
    *("shared memory of others", "shared memory", "memory file", "keyring", "key", "user name space"),
]

SECCOMP = (["--seccomp", "FILTER"], [])
USERS = (["--disable-userns"], [])
RIGHTS = (["--cap-drop", "ALL"], [])
SPACES = (["--unshare-all"], [])


@pytest.fixture(scope="module")
def user(request: pytest.FixtureRequest, ordinary: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `subprocess.run` by which a process is of root, or of an ordinary user."""
    if request.param == "root" and os.geteuid() != 0:
        pytest.skip("these tests do not run as root")
    if request.param == "ordinary user" and os.geteuid() == 0:
        return ordinary
    return {}


@pytest.fixture(scope="module")
def python(user: dict[str, Any], find_python: Callable[[dict[str, Any]], str]) -> str:
    """An interpreter that the user may run."""
    if (isolate.bubblewrap_version() or (0, 0)) < isolate.OLDEST:
        pytest.skip("needs bubblewrap")
    return find_python(user)


@pytest.fixture(scope="module")
def place(user: dict[str, Any], python: str) -> Iterator[Path]:
    """A folder of the user with ``work`` and ``code``, and ``hidden`` with what nobody else should see."""
    folder = Path(tempfile.mkdtemp(dir="/tmp"))
    for name in ("work", "code", "hidden"):
        (folder / name).mkdir()
    shutil.copy(CODE, folder / "code")
    (folder / "hidden" / "secret").write_text("secret")
    for path in (folder, *folder.rglob("*")) if user else ():
        os.chown(path, user["user"], user["group"])
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def outside(place: Path) -> Iterator[dict[str, Any]]:
    """What there is outside for attacks to find."""
    libc = ctypes.CDLL(None)
    key = 0x5EC2E7
    segment = libc.shmget(key, 4096, 0o1666)
    shm = Path(f"/dev/shm/{place.name}")
    shm.write_text("secret")
    with socket.socket(socket.AF_UNIX) as named, socket.socket(socket.AF_UNIX) as abstract:
        named.bind(f"{place}/hidden/socket")
        abstract.bind(f"\0{place.name}")
        os.chmod(f"{place}/hidden/socket", 0o777)
        for each in (named, abstract):
            each.listen(100)
        with socket.create_server(("127.0.0.1", 0), backlog=100) as server:
            found = {"port": server.getsockname()[1], "abstract": place.name, "socket": f"{place}/hidden/socket"}
            yield found | {"key": key, "shm": str(shm), "file": f"{place}/hidden/secret"}
    libc.shmctl(segment, 0, None)
    shm.unlink()


class Attacker:
    """Starts attacks as a user."""

    def __init__(self, place: Path, package: str, python: str, user: dict[str, Any], outside: dict[str, Any]) -> None:
        self.user = user
        self.python = python
        self.folder = place / "work"
        self.code = str(place / "code" / CODE.name)
        self.environment = {"PYTHONPATH": package, "PATH": os.environ["PATH"], "MY_TOKEN": "secret"}
        self.spec = {"folder": str(place / "work"), "code": str(place / "code"), **outside}

    def command(self, attacks: list[str], how: str = "around", **more: Any) -> list[str]:
        """Return the command of attacks."""
        return [self.python, self.code, how, json.dumps({**self.spec, "attacks": attacks, **more}), "outside-marker"]

    def tries(self, *attacks: str, **more: Any) -> dict[str, str]:
        """Return what came of attacks, by name."""
        command = self.command(list(attacks), **more)
        done = subprocess.run(command, env=self.environment, cwd="/", capture_output=True, text=True, **self.user)
        lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
        assert lines, done.stdout + done.stderr
        return json.loads(lines[0])


@pytest.fixture
def attacker(place: Path, package: str, python: str, user: dict[str, Any], outside: dict[str, Any]) -> Attacker:
    return Attacker(place, package, python, user, outside)


both = pytest.mark.parametrize("user", ["root", "ordinary user"], indirect=True)
as_root = pytest.mark.parametrize("user", ["root"], indirect=True)
on_x86_64 = pytest.mark.skipif(platform.machine() != "x86_64", reason="numbers of system calls are those of x86-64")


@both
@on_x86_64
def test_no_attack_from_inside_succeeds(attacker):
    found = attacker.tries(*ALL_BUT_THE_TERMINAL)

    assert [name for name in ALL_BUT_THE_TERMINAL if found[name] == "open"] == []


@pytest.mark.parametrize("user", ["root", pytest.param("ordinary user", marks=pytest.mark.slow)], indirect=True)
def test_the_terminal_of_who_verifies_is_out_of_reach(attacker):
    found = attacker.tries("terminal", how="with_terminal")
    without = attacker.tries("terminal", how="with_terminal", without=[(["--new-session"], [])])

    assert found == {"terminal": "No such device or address"}
    assert without == {"terminal": "open"}


@as_root
@on_x86_64
@pytest.mark.parametrize(
    ("attacks", "without"),
    [
        (["network", "abstract socket", "other process", "shared memory of others"], [SPACES]),
        (["capabilities"], [RIGHTS]),
        (["host name"], [RIGHTS, USERS]),
        (["mount", "packets"], [RIGHTS, USERS]),
        (["environment", "environment of others"], [(["env", "-i"], ["env"])]),
        (["memory file", "shared memory", "keyring", "key"], [SECCOMP]),
        (["user name space"], [USERS]),
        (["settings of the kernel"], [(["--remount-ro", "/proc"], [])]),
        (["write to /dev"], [(["--remount-ro", "/dev"], [])]),
        (["write to /"], [(["--remount-ro", "/"], [])]),
    ],
)
def test_each_option_stops_attacks(attacker, attacks, without):
    assert attacker.tries(*attacks, without=without) == dict.fromkeys(attacks, "open")


@as_root
@pytest.mark.parametrize("what", ["file in /tmp", "file in /dev/shm"])
def test_folders_of_sockets_and_shared_memory_are_its_own(attacker, what):
    place = {"file in /tmp": "/tmp", "file in /dev/shm": "/dev/shm"}[what]
    inside = str(attacker.folder / isolate.OWN[place])

    found = attacker.tries(what, without=[(["--bind", inside, place], ["--bind", place, place])])

    assert found == {what: "open"}


@as_root
def test_what_is_open_outside_is_seen_by_the_test_of_descriptors(attacker):
    assert attacker.tries("descriptors", descriptors=True) == {"descriptors": "open"}


@as_root
def test_bubblewrap_itself_asks_for_a_name_space_of_users(attacker):
    done = subprocess.run(
        attacker.command(["mount"], without=[(["--unshare-user"], [])]),
        env=attacker.environment,
        capture_output=True,
        text=True,
    )

    assert "--disable-userns requires --unshare-user" in done.stdout


@as_root
@pytest.mark.parametrize("is_kept", [True, False])
def test_it_ends_with_the_process_that_watches(attacker, is_kept):
    without = [] if is_kept else [(["--die-with-parent"], [])]
    beat = attacker.folder / "beat"
    enough = attacker.folder / "enough"
    for file in (beat, enough):
        file.unlink(missing_ok=True)
    command = attacker.command([], beats=120, without=without)

    def grows(seconds: float) -> bool:
        before = beat.stat().st_size
        time.sleep(seconds)
        return beat.stat().st_size > before

    with subprocess.Popen(command, env=attacker.environment, stdout=subprocess.PIPE) as watching:
        while not beat.exists():
            time.sleep(0.02)
        watching.send_signal(signal.SIGKILL)
    patience = time.monotonic() + 30
    while grows(0.3) == is_kept:  # a busy machine takes a while to end it, or to let it beat
        assert time.monotonic() < patience
    enough.touch()


NONE = "install the package bubblewrap"


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        ("bubblewrap 0.7.9", f"it needs bubblewrap 0.8 or newer, this is 0.7.9: {NONE}"),
        (None, f"it needs bubblewrap 0.8 or newer, there is none: {NONE}"),
        ("bubblewrap 0.8.0", "bubblewrap does not start here with limited memory: "),
    ],
)
def test_an_old_or_broken_bubblewrap_is_none(tmp_path, monkeypatch, said, reason):
    if sys.platform != "linux":
        pytest.skip("needs Linux")
    for program in ("sh", "env", "find", "prlimit"):
        (tmp_path / program).symlink_to(shutil.which(program))
    monkeypatch.setenv("PATH", f"{tmp_path}")
    if said is not None:
        script = f'#!/bin/sh\n[ "$1" = --version ] && echo "{said}" || echo "bwrap: no permissions" >&2\n'
        (tmp_path / "bwrap").write_text(script)
        (tmp_path / "bwrap").chmod(0o755)

    found = isolate.isolation(tmp_path, isolate.Limits(60, 10**9, 10**9))

    assert (found.bubblewrap, found.memory) == (None, None)
    assert found.why_not.startswith(reason)


def test_without_libseccomp_there_is_no_isolation(tmp_path, monkeypatch):
    monkeypatch.setattr(isolate, "bubblewrap_version", lambda: (0, 8, 0))
    monkeypatch.setattr(isolate, "_libseccomp", lambda: None)

    found = isolate.isolation(tmp_path, isolate.Limits(60, 10**9, 10**9))

    assert found.why_not == "it needs libseccomp 2, there is none: install the package libseccomp2"


def test_code_of_others_is_not_the_whole_file_system(tmp_path):
    with pytest.raises(ValueError, match="must be in a folder below /, got /"):
        isolate.confined(["true"], tmp_path, [Path("/")], {}, filtering=3)
