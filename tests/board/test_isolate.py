"""Hostile code in a process of its own: each limit is kept, and nothing of it is left."""

from __future__ import annotations

import re
import socket
import tempfile
import time
from pathlib import Path

import pytest

from ctgraph_rl.board.isolate import Isolation, Limits, Outcome, isolation, run_isolated

ROOMY = Limits(seconds=20, memory=10**9, disk=10**8)

HOSTILE = """
import os, socket, sys, time
from pathlib import Path

what = sys.argv[1]
if what == "sleep":
    time.sleep(60)
while what == "memory":
    kept = [*globals().get("kept", ()), bytearray(10**7)]
if what == "children":
    for _ in range(5):
        if os.fork() == 0:
            kept = bytearray(b"x" * 80_000_000)
            time.sleep(60)
    time.sleep(60)
if what == "large file":
    with open("large", "wb") as file:
        for _ in range(100):
            file.write(b"x" * 2**20)
            file.flush()
number = 0
while what == "many files":
    Path(f"small{number}").write_bytes(b"x" * 2**20)
    number += 1
    time.sleep(0.005)
if what == "network":
    socket.create_connection(("127.0.0.1", int(sys.argv[2])), timeout=5)
if what == "socket":
    socket.socket(socket.AF_UNIX).connect(sys.argv[2])
if what == "write elsewhere":
    Path(sys.argv[2]).write_text("x")
if what == "environment":
    print(sorted(os.environ), os.environ["PYTHONPATH"])
if what == "daemon" and os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        while True:
            with open("beat", "a") as file:
                file.write("x")
            time.sleep(0.02)
if what == "daemon":
    time.sleep(float(sys.argv[2]))
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with hostile code in ``code``, and ``work`` for its process."""
    for name in ("code", "work"):
        (tmp_path / name).mkdir()
    (tmp_path / "code" / "hostile.py").write_text(HOSTILE)
    return tmp_path


def run(place: Path, *arguments: str, limits: Limits = ROOMY, **more) -> Outcome:
    return run_isolated("hostile", arguments, place / "work", limits, paths=[place / "code"], **more)


def needs(place: Path, what: str) -> None:
    if not getattr(isolation(place / "work"), what):
        pytest.skip(f"this system does not close off {what}")


def beats(place: Path) -> int:
    file = place / "work" / "beat"
    return file.stat().st_size if file.exists() else 0


@pytest.mark.parametrize(
    ("what", "limits", "said"),
    [
        ("sleep", ROOMY._replace(seconds=0.5), "stopped: it took longer than 0.5 seconds"),
        ("memory", ROOMY._replace(memory=10**8), "ended with exit code 1: MemoryError"),
        ("children", ROOMY._replace(memory=2 * 10**8), "stopped: it used more than 200,000,000 bytes of memory"),
        ("large file", ROOMY._replace(disk=10**7), "File too large|wrote more than"),
        ("many files", ROOMY._replace(disk=10**7), "stopped: it wrote more than 10,000,000 bytes"),
    ],
)
def test_a_process_that_takes_too_much_is_stopped(place, what, limits, said):
    if what == "children":
        needs(place, "memory")

    outcome = run(place, what, limits=limits)

    assert re.search(said, outcome.failure)
    assert outcome.seconds < 10


def test_code_of_others_has_no_network_where_the_system_allows(place):
    needs(place, "network")
    with socket.create_server(("127.0.0.1", 0)) as server:
        outcome = run(place, "network", str(server.getsockname()[1]))

    assert "Network is unreachable" in outcome.failure


def test_code_of_others_finds_no_socket_of_other_programs_where_the_system_allows(place):
    needs(place, "sockets")
    with tempfile.TemporaryDirectory(dir="/tmp") as folder, socket.socket(socket.AF_UNIX) as server:
        server.bind(f"{folder}/socket")
        server.listen()
        outcome = run(place, "socket", f"{folder}/socket")

    assert "No such file or directory" in outcome.failure


def test_modules_of_others_are_not_imported_before_limits_and_isolation(place):
    for name in ("sitecustomize", "usercustomize", "types", "ctypes"):
        (place / "code" / f"{name}.py").write_text(f"open({str(place / 'ran')!r}, 'w').close()")

    outcome = run(place, "environment")

    assert (outcome.code, (place / "ran").exists()) == (0, False)
    assert outcome.output.strip().endswith(f":{place / 'code'}")


def test_code_of_others_writes_into_its_folder_alone_where_the_system_allows(place):
    needs(place, "files")
    outcome = run(place, "write elsewhere", str(place / "elsewhere"))

    assert "Read-only file system" in outcome.failure
    assert not (place / "elsewhere").exists()


def test_code_of_others_sees_no_credentials_of_the_environment(place, monkeypatch):
    monkeypatch.setenv("MY_TOKEN", "secret")

    outcome = run(place, "environment")

    assert "HOME" in outcome.output
    assert "TOKEN" not in outcome.output


@pytest.mark.parametrize("is_interrupted", [False, True])
def test_no_process_is_left_behind_also_after_an_interrupt(place, is_interrupted):
    needs(place, "processes")

    def watch():
        if is_interrupted and beats(place):
            raise KeyboardInterrupt

    try:
        run(place, "daemon", "20" if is_interrupted else "0.5", watch=watch)
    except KeyboardInterrupt:
        assert is_interrupted
    there = beats(place)
    time.sleep(0.2)

    assert there > 0
    assert beats(place) == there


def test_what_a_system_cannot_close_off_is_said():
    nothing = Isolation(network=False, files=False, processes=False, memory=False, sockets=False)

    assert [text.split(" ")[:4] for text in nothing.missing()] == [
        ["it", "can", "use", "the"],
        ["it", "can", "read", "and"],
        ["it", "can", "signal", "your"],
        ["its", "memory", "is", "limited"],
        ["it", "can", "connect", "to"],
    ]
    (reads,) = Isolation(*[True] * 5).missing()
    assert reads == "it can read every file that you can, and connect to Unix sockets outside /run, /var/run, /tmp"


@pytest.mark.parametrize("limits", [ROOMY._replace(seconds=0), ROOMY._replace(memory=-1)])
def test_a_limit_must_be_positive(place, limits):
    with pytest.raises(ValueError, match="must be a number > 0"):
        run(place, "sleep", limits=limits)
