"""Hostile code in a separate process: each limit is kept, and nothing of it is left."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from ctgraph_rl.board import isolate
from ctgraph_rl.board.isolate import CGROUP, SYSTEMD, THREADS, Isolation, Limits, Outcome, isolation, run_isolated

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
    made = []
    for _ in range(5):
        made.append(os.fork())
        if made[-1] == 0:
            kept = bytearray(b"x" * 80_000_000)
            time.sleep(2)
            os._exit(0)
    print(sum(os.waitpid(each, 0)[1] == 9 for each in made), "of 5 were killed")
if what == "shared pages":
    kept = mmap.mmap(-1, 4 * 10**8)
    kept.write(b"x" * 4 * 10**8)
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
if what == "removed":
    with open("removed", "wb") as file:
        file.write(b"x" * 8_000_000)
        os.unlink("removed")
        time.sleep(60)
if what == "shared memory":
    for number in range(4):
        Path(f"/dev/shm/{number}").write_bytes(b"x" * 8_000_000)
    time.sleep(60)
if what == "nested folders":
    for _ in range(1500):
        os.mkdir("x" * 200)
        os.chdir("x" * 200)
    Path("large").write_bytes(b"x" * 20_000_000)
    time.sleep(60)
if what == "closed folder":
    os.mkdir("closed", 0)
    time.sleep(60)
if what == "own folder closed":
    os.chmod(".", 0)
    time.sleep(60)
if what == "processes":
    for _ in range(1100):
        if os.fork() == 0:
            time.sleep(60)
    time.sleep(60)
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
    print(sorted(os.environ))
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

OPEN = Isolation(bubblewrap=None, why_not="this test does without", memory=None, graphics=False)


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
    found = isolation(tmp_path_factory.mktemp("closed"), ROOMY)
    if found.bubblewrap is None:
        pytest.skip("needs bubblewrap")
    return found


def run(place: Path, isolated: Isolation, *arguments: str, limits: Limits = ROOMY, **more) -> Outcome:
    command = [sys.executable, str(place / "code" / "hostile.py"), *arguments]
    return run_isolated(command, place / "work", limits, isolated, paths=[place / "code"], **more)


def beats(place: Path) -> int:
    file = place / "work" / "beat"
    return file.stat().st_size if file.exists() else 0


KILLED = "it was killed, as where it uses more than"

TOO_MUCH = [
    ("sleep", ROOMY._replace(seconds=0.5), "stopped: it took longer than 0.5 seconds"),
    ("memory", ROOMY._replace(memory=10**8), f"MemoryError|{KILLED} 100,000,000 bytes of memory"),
    ("shared pages", ROOMY._replace(memory=10**8), f"MemoryError|Cannot allocate|{KILLED} 100,000,000"),
    ("large file", ROOMY._replace(disk=10**7), "File too large|wrote more than"),
    ("many files", ROOMY._replace(disk=10**7), "stopped: it wrote more than 10,000,000 bytes"),
    ("shared memory", ROOMY._replace(disk=10**7), "stopped: it wrote more than 10,000,000 bytes"),
    ("nested folders", ROOMY._replace(disk=10**7), "File too large|wrote more than"),
    ("processes", ROOMY, "Resource temporarily unavailable"),
]


@pytest.mark.parametrize(("what", "limits", "said"), TOO_MUCH, ids=[each[0] for each in TOO_MUCH])
def test_a_process_that_takes_too_much_is_stopped(place, closed, what, limits, said):
    start = time.monotonic()
    outcome = run(place, closed, what, limits=limits)

    assert re.search(said, outcome.failure), outcome
    assert time.monotonic() - start < ROOMY.seconds


def test_processes_have_the_memory_together_and_no_cgroup_is_left(place, closed):
    if closed.memory != CGROUP:
        pytest.skip("needs a cgroup")
    outcome = run(place, closed, "children", limits=ROOMY._replace(memory=2 * 10**8))

    assert re.search("[345] of 5 were killed", outcome.output) or outcome.stopped, outcome
    assert [*isolate.CGROUPS.rglob(f"ctgraph_rl-{os.getpid()}-*")] == []


def test_a_file_that_it_removed_counts_where_little_of_the_disk_stays_free(place, closed, monkeypatch):
    free = iter([10**10, 10**10, 10**8])
    monkeypatch.setattr(isolate.shutil, "disk_usage", lambda folder: SimpleNamespace(free=next(free)))

    assert run(place, closed, "removed").stopped == "less than 1,000,000,000 bytes of the disk stay free"


def test_many_small_files_are_too_many(place, closed, monkeypatch):
    monkeypatch.setattr(isolate, "MOST_FILES", 20)

    assert run(place, closed, "many files").stopped == "it made more than 20 files"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="it becomes an ordinary user")
@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("closed folder", "stopped: it made a folder that cannot be read"),
        pytest.param("own folder closed", "stopped: it made a folder that cannot be read", marks=pytest.mark.slow),
        ("memory", "MemoryError"),
        pytest.param("shared pages", "Cannot allocate memory", marks=pytest.mark.slow),
        ("processes", "Resource temporarily unavailable"),
    ],
)
def test_an_ordinary_user_without_a_cgroup_has_threads_with_a_share_of_the_memory_each(
    closed, ordinary, find_python, package, what, said
):
    """The system holds root to no number of threads, and closes no folder to root."""
    limits = ROOMY._replace(memory=6 * 10**8)
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        place = Path(folder)
        for name in ("code", "work"):
            (place / name).mkdir()
        (place / "code" / "hostile.py").write_text(HOSTILE)
        for path in (place, *place.rglob("*")):
            os.chown(path, ordinary["user"], ordinary["group"])
        code = (
            "import sys; from pathlib import Path; from ctgraph_rl.board.isolate import *; place = Path(sys.argv[1]);"
            "limits = Limits(*map(int, sys.argv[3:])); here = isolation(place / 'work', limits); print(here);"
            "command = [sys.executable, str(place / 'code' / 'hostile.py'), sys.argv[2]];"
            "print(run_isolated(command, place / 'work', limits, here, paths=[place / 'code']).failure)"
        )
        command = [find_python(ordinary), "-c", code, folder, what, *map(str, limits)]
        environment = {"PYTHONPATH": package, "PATH": os.environ["PATH"]}
        done = subprocess.run(command, cwd="/", env=environment, capture_output=True, text=True, **ordinary)

    assert f"memory='{THREADS}'" in done.stdout, done.stdout + done.stderr
    assert said in done.stdout, done.stderr


def test_root_without_a_cgroup_or_systemd_runs_nothing(tmp_path, closed, monkeypatch):
    def none(memory):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(isolate, "new_cgroups", none)
    monkeypatch.setattr(isolate.os, "geteuid", lambda: 0)
    monkeypatch.setenv("PATH", without_systemd(tmp_path))

    found = isolation(tmp_path, ROOMY)

    assert found.bubblewrap is None
    assert "a cgroup: Permission denied; systemd: No such file or directory; threads: the system holds root" in (
        found.why_not
    )


def without_systemd(folder: Path) -> str:
    """Return a path of programs without that of systemd."""
    (folder / "bin").mkdir()
    for program in ("bwrap", "sh", "env", "find", "prlimit", "chmod"):
        (folder / "bin" / program).symlink_to(shutil.which(program))
    return str(folder / "bin")


def test_systemd_is_asked_for_a_scope_with_all_limits(place, closed, monkeypatch):
    folder = place / "programs"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    asked = place / "asked"
    script = f'#!/bin/sh\nwhile [ "$1" != env ]; do echo "$1" >> {asked}; shift; done\nexec "$@"\n'
    (folder / "systemd-run").write_text(script)
    (folder / "systemd-run").chmod(0o755)

    outcome = run(place, closed._replace(memory=SYSTEMD), "print")

    assert outcome.output.endswith("x last\n")
    assert {"--scope", f"--property=MemoryMax={ROOMY.memory}", "--property=MemorySwapMax=0"} < {
        *asked.read_text().splitlines()
    }


@pytest.mark.parametrize("lacking", [None, "memory.swap.max"])
def test_a_cgroup_of_version_2_has_all_limits_or_is_none(tmp_path, monkeypatch, lacking):
    """Made-up files in place of the kernel's, which makes them with the folder."""
    monkeypatch.setattr(isolate, "CGROUPS", tmp_path)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "cgroup.subtree_control").write_text("")
    names = ("memory.max", "memory.swap.max", "memory.oom.group", "pids.max")
    mkdir = Path.mkdir

    def made(path):
        mkdir(path)
        for name in names:
            if name != lacking:
                (path / name).write_text("")

    monkeypatch.setattr(Path, "mkdir", made)
    monkeypatch.setattr(isolate, "_remove_cgroups", lambda groups: [shutil.rmtree(group) for group in groups])
    monkeypatch.setattr(isolate, "_own_cgroups", lambda: {"": "own"})

    if lacking is not None:
        with pytest.raises(FileNotFoundError):
            isolate.new_cgroups(10**9)
        assert [path.name for path in (tmp_path / "own").iterdir()] == ["cgroup.subtree_control"]
        return
    (group,) = isolate.new_cgroups(10**9)
    assert [(group / name).read_text() for name in names] == ["1000000000", "0", "1", "1024"]
    assert (tmp_path / "own" / "cgroup.subtree_control").read_text() == "+memory +pids"


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
def test_no_process_is_left_behind_also_after_an_interrupt(place, closed, monkeypatch, is_interrupted):
    look = isolate._why_too_much

    def interrupts(*arguments):
        if is_interrupted and beats(place):
            raise KeyboardInterrupt
        return look(*arguments)

    monkeypatch.setattr(isolate, "_why_too_much", interrupts)
    try:
        run(place, closed, "daemon", "60" if is_interrupted else "0.1")
    except KeyboardInterrupt:
        assert is_interrupted
    there = beats(place)
    time.sleep(0.2)

    assert there > 0
    assert beats(place) == there


def test_what_is_open_and_what_is_not_limited_is_said():
    whole = Isolation("0.8.0", None, THREADS, graphics=True)

    assert whole.closed()[:2] == ["bubblewrap 0.8.0", "no network"]
    assert whole.closed()[-1] == "memory limited for all its processes together, by threads"
    assert [text.split(":")[0] for text in whole.missing()[3:]] == [
        "the kernel's own memory for it is not limited, such as buffers of pipes and sockets",
        "graphics cards",
    ]
    assert len(whole._replace(graphics=False, memory=CGROUP).missing()) == 3


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
