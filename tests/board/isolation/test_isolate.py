"""Hostile code in a separate process: each limit is kept, and nothing of it is left."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ctgraph_rl.board.isolate import Isolation, Limits, Outcome, isolation, run_isolated

ROOMY = Limits(seconds=120, memory=10**9, disk=10**8)

HOSTILE = """
import mmap, os, sys, time
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
if what in ("removed", "removed and mapped", "shared memory"):
    place = Path("/dev/shm" if what == "shared memory" else ".") / "removed"
    kept = []
    for _ in range(4):
        with place.open("w+b") as file:
            file.write(b"x" * 8_000_000)
            file.flush()
            kept.append(mmap.mmap(file.fileno(), 0) if what == "removed and mapped" else os.dup(file.fileno()))
        if what != "shared memory":
            place.unlink()
        else:
            place.rename(f"/dev/shm/{len(kept)}")
    time.sleep(60)
if what == "nested folders":
    for _ in range(1500):
        os.mkdir("x" * 200)
        os.chdir("x" * 200)
    time.sleep(60)
if what == "closed folder":
    os.mkdir("closed", 0)
    time.sleep(60)
if what == "own folder closed":
    os.chmod(".", 0)
    time.sleep(60)
if what == "processes":
    for _ in range(300):
        if os.fork() == 0:
            time.sleep(60)
    time.sleep(60)
if what == "threads":
    import threading
    end = threading.Event()
    for _ in range(1100):
        threading.Thread(target=end.wait, daemon=True).start()
if what == "write elsewhere":
    Path(sys.argv[2]).write_text("x")
if what == "set bits":
    for name, bits in (("plain", 0o755), ("user", 0o4755), ("group", 0o2755), ("both", 0o6711)):
        Path(name).write_text("x")
        os.chmod(name, bits)
    os.makedirs("within/" + "x" * 100)
    os.chmod("within", 0o2777)
    Path("within/user").write_text("x")
    os.chmod("within/user", 0o4755)
    if len(sys.argv) > 2:
        time.sleep(60)
if what == "print":
    print("first", "x" * 10**6, "last")
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
    while not Path("beat").exists():
        time.sleep(0.01)
    time.sleep(float(sys.argv[2]))
"""

OPEN = Isolation(bubblewrap=None, why_not="this test does without", graphics=False, is_root=False)


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Path]:
    """A folder with hostile code in ``code``, and ``work`` for its process; Python cannot remove what that makes."""
    for name in ("code", "work"):
        (tmp_path / name).mkdir()
    (tmp_path / "code" / "hostile.py").write_text(HOSTILE)
    yield tmp_path
    subprocess.run(["rm", "-rf", str(tmp_path / "work")], check=True)


@pytest.fixture(scope="session")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Isolation:
    found = isolation(tmp_path_factory.mktemp("closed"))
    if found.bubblewrap is None:
        pytest.skip("needs bubblewrap")
    return found


def run(place: Path, isolated: Isolation, *arguments: str, limits: Limits = ROOMY, **more) -> Outcome:
    paths = [place / "code"]
    return run_isolated("hostile", arguments, place / "work", limits, isolated=isolated, paths=paths, **more)


def beats(place: Path) -> int:
    file = place / "work" / "beat"
    return file.stat().st_size if file.exists() else 0


TOO_MUCH = [
    ("sleep", ROOMY._replace(seconds=0.5), "stopped: it took longer than 0.5 seconds"),
    ("memory", ROOMY._replace(memory=10**8), "MemoryError|used more than 100,000,000 bytes of memory"),
    ("children", ROOMY._replace(memory=2 * 10**8), "stopped: it used more than 200,000,000 bytes of memory"),
    ("large file", ROOMY._replace(disk=10**7), "File too large|wrote more than"),
    ("many files", ROOMY._replace(disk=10**7), "stopped: it wrote more than 10,000,000 bytes"),
    ("removed", ROOMY._replace(disk=10**7), "stopped: it wrote more than 10,000,000 bytes"),
    ("removed and mapped", ROOMY._replace(disk=10**7), "stopped: it wrote more than 10,000,000 bytes"),
    ("shared memory", ROOMY._replace(disk=10**7), "stopped: it wrote more than 10,000,000 bytes"),
    ("nested folders", ROOMY, "stopped: it made more than 64 folders within each other"),
    ("processes", ROOMY._replace(memory=10**11), "stopped: it started more than 256 processes"),
]


@pytest.mark.parametrize(("what", "limits", "said"), TOO_MUCH, ids=[each[0] for each in TOO_MUCH])
def test_a_process_that_takes_too_much_is_stopped(place, closed, what, limits, said):
    outcome = run(place, closed, what, limits=limits)

    assert re.search(said, outcome.failure)
    assert outcome.seconds < ROOMY.seconds


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="it becomes an ordinary user")
@pytest.mark.parametrize(
    ("what", "limits", "said"),
    [
        pytest.param(*("removed", ROOMY._replace(disk=10**7), "stopped: it wrote more than"), marks=pytest.mark.slow),
        ("closed folder", ROOMY, "stopped: it made a folder that cannot be read"),
        pytest.param("own folder closed", ROOMY, "stopped: it closed its folder", marks=pytest.mark.slow),
        pytest.param("threads", ROOMY, "can't start new thread", marks=pytest.mark.slow),
    ],
)
def test_an_ordinary_user_is_held_to_limits_too(closed, ordinary, find_python, package, what, limits, said):
    """The system holds root to no number of threads, and closes no folder to root."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        place = Path(folder)
        for name in ("code", "work"):
            (place / name).mkdir()
        (place / "code" / "hostile.py").write_text(HOSTILE)
        for path in (place, *place.rglob("*")):
            os.chown(path, ordinary["user"], ordinary["group"])
        code = (
            "import sys; from pathlib import Path; from ctgraph_rl.board.isolate import *; place = Path(sys.argv[1]);"
            "here = isolation(place / 'work'); assert here.bubblewrap, here; limits = Limits(*map(int, sys.argv[3:]));"
            "print(run_isolated('hostile', sys.argv[2:3], place / 'work', limits, isolated=here,"
            " paths=[place / 'code']).failure)"
        )
        command = [find_python(ordinary), "-c", code, folder, what, *map(str, limits)]
        environment = {"PYTHONPATH": package, "PATH": os.environ["PATH"]}
        done = subprocess.run(command, cwd="/", env=environment, capture_output=True, text=True, **ordinary)

    assert said in done.stdout, done.stderr


def test_modules_of_others_are_not_imported_before_limits_and_isolation(place, closed):
    for name in ("sitecustomize", "usercustomize", "types", "ctypes"):
        (place / "code" / f"{name}.py").write_text("open('ran', 'w').close()")

    outcome = run(place, closed, "environment")

    assert (outcome.code, (place / "work" / "ran").exists()) == (0, False)
    assert outcome.output.strip().endswith(f":{place / 'code'}")


def test_code_of_others_writes_into_its_folder_alone(place, closed):
    outcome = run(place, closed, "write elsewhere", str(place / "code" / "elsewhere"))

    assert "Read-only file system" in outcome.failure
    assert not (place / "code" / "elsewhere").exists()


def test_code_of_others_sees_no_credentials_of_the_environment(place, closed, monkeypatch):
    monkeypatch.setenv("MY_TOKEN", "secret")

    outcome = run(place, closed, "environment")

    assert "HOME" in outcome.output
    assert "TOKEN" not in outcome.output


def test_the_end_of_what_it_prints_is_kept(place, closed):
    outcome = run(place, closed, "print")

    assert (outcome.code, len(outcome.output)) == (0, 4096)
    assert outcome.output.endswith("x last\n")


@pytest.mark.parametrize("is_interrupted", [False, True])
def test_no_process_is_left_behind_also_after_an_interrupt(place, closed, is_interrupted):
    def watch():
        if is_interrupted and beats(place):
            raise KeyboardInterrupt

    try:
        run(place, closed, "daemon", "60" if is_interrupted else "0.1", watch=watch)
    except KeyboardInterrupt:
        assert is_interrupted
    there = beats(place)
    time.sleep(0.2)

    assert there > 0
    assert beats(place) == there


def test_what_is_open_and_what_is_not_limited_is_said():
    whole = Isolation("0.8.0", None, graphics=True, is_root=True)

    assert OPEN.closed() == []
    assert whole.closed()[:2] == ["bubblewrap 0.8.0", "no network"]
    assert [text.split(":")[0] for text in whole.missing()[4:]] == [
        "the system holds root to no number of processes",
        "graphics cards",
    ]
    assert len(whole._replace(graphics=False, is_root=False).missing()) == 4


@pytest.mark.parametrize("limits", [ROOMY._replace(seconds=0), ROOMY._replace(memory=-1)])
def test_a_limit_must_be_positive(place, limits):
    with pytest.raises(ValueError, match="must be a number > 0"):
        run(place, OPEN, "sleep", limits=limits)


@pytest.mark.parametrize("more", [[], ["is killed"]])
def test_no_file_that_it_wrote_lets_others_act_as_its_owner(place, closed, more):
    run(place, closed, "set bits", *more, limits=ROOMY._replace(seconds=2 if more else 60))

    found = {path.relative_to(place / "work"): path.lstat().st_mode & 0o7777 for path in (place / "work").rglob("*")}
    assert found[Path("plain")] == found[Path("user")] == found[Path("within/user")] == 0o755
    assert (found[Path("both")], found[Path("within")]) == (0o711, 0o777)
    assert not any(mode & 0o6000 for mode in found.values())


def test_nothing_runs_without_bubblewrap(place):
    with pytest.raises(ValueError, match="the code of others is not run: this test does without"):
        run(place, OPEN, "print")
