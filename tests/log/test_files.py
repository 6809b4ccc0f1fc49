"""Files that are whole or not there, and a lock that ends with its process."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from helpers.stopped_runs import StopsAfter, learn_into

from ctgraph_rl import RunLog, disk, metrics
from ctgraph_rl.disk import write_whole
from ctgraph_rl.log import files
from ctgraph_rl.log.files import LOCK, LOG, METRICS, Locks, locked
from ctgraph_rl.log.sums import damaged, stored_sums, sum_of, write_metrics
from ctgraph_rl.runs.status import status_of

HOLD = """
import signal, sys
from pathlib import Path
from ctgraph_rl.log.files import locked
with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    signal.pause()
"""


@pytest.fixture
def holder(tmp_path, checkout):
    """Another process that works in the folder."""
    env = {**os.environ, "PYTHONPATH": str(checkout)}
    process = subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True, env=env)
    assert process.stdout is not None and process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.wait()


def test_a_file_is_written_and_nothing_else_is_left(tmp_path):
    write_whole(tmp_path / "file", b"old")
    write_whole(tmp_path / "file", b"new")

    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("file", b"new")]


@pytest.mark.parametrize("step", ["os.fsync", "Path.replace"])
def test_a_failure_at_any_step_keeps_the_old_content_and_removes_the_half(tmp_path, monkeypatch, step):
    write_whole(tmp_path / "file", b"old")

    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(f"ctgraph_rl.disk.{step}", fail)
    with pytest.raises(OSError, match=r"No space left on device: cannot write 2\.0 MB to .*file, [\d.]+ MB are free"):
        write_whole(tmp_path / "file", bytes(2_000_000))

    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("file", b"old")]


def test_a_kill_between_any_two_steps_keeps_the_old_content_or_has_the_new(tmp_path, monkeypatch):
    steps, found = ["fsync", "replace", "folder"], []

    class Killed(BaseException):
        pass

    def kill(*_):
        raise Killed

    for step in steps:
        with monkeypatch.context() as patch:
            write_whole(tmp_path / "file", b"old")
            names = {"fsync": "os.fsync", "replace": "Path.replace", "folder": "sync_folder"}
            patch.setattr(f"ctgraph_rl.disk.{names[step]}", kill)
            with pytest.raises(Killed):
                write_whole(tmp_path / "file", b"new")
            found.append((tmp_path / "file").read_bytes())

    assert found == [b"old", b"old", b"new"]


def test_content_and_folder_reach_the_disk_before_it_returns(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(
        "ctgraph_rl.disk.os.fsync", lambda number: synced.append(os.readlink(f"/proc/self/fd/{number}"))
    )

    write_whole(tmp_path / "file", b"new")

    assert synced == [str(tmp_path / "file.part"), str(tmp_path)]


def test_a_second_process_is_refused_at_once_and_told_who_is_there(tmp_path, holder):
    said = rf"{tmp_path} is in use by process {holder.pid} on \S+ since 2.*; wait for it, or stop it"
    with pytest.raises(BlockingIOError, match=said), locked(tmp_path):
        pytest.fail("two at once")


def test_the_lock_of_a_killed_process_is_free(tmp_path, holder):
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert (tmp_path / LOCK).exists()

    with locked(tmp_path):
        assert f"process {os.getpid()} on" in (tmp_path / LOCK).read_text()

    assert list(tmp_path.iterdir()) == []


def test_one_open_file_locks_any_number_of_directories_and_logs_hold_none(tmp_path):
    folders = [tmp_path / str(number) for number in range(40)]
    before = len(os.listdir("/proc/self/fd"))

    with closing(Locks()) as locks:
        for folder in folders:
            folder.mkdir()
            locks.add(folder)
        logs = [RunLog(folder / LOG) for folder in folders]
        for log in logs:
            log.append("run")

        assert len(os.listdir("/proc/self/fd")) == before + 1
        for folder in folders:
            with pytest.raises(BlockingIOError, match=f"{folder.name} is in use by process {os.getpid()} on"):
                Locks().add(folder)
            assert status_of(folder).state == "in use"

    assert [path.name for folder in folders for path in folder.iterdir()] == [LOG] * 40


def test_a_lock_that_names_one_of_a_killed_process_is_free_also_where_another_has_that(tmp_path):
    folders = [tmp_path / "first", tmp_path / "second"]
    with closing(Locks()) as locks:
        for folder in folders:
            folder.mkdir()
            locks.add(folder)
        left = [(folder / LOCK).read_bytes() for folder in folders]

    for folder, content in zip(folders, left, strict=True):
        (folder / LOCK).write_bytes(content)
    with locked(folders[1]):
        pass
    (folders[1] / LOCK).write_bytes(left[1])
    with locked(folders[0]), locked(folders[1]):
        pass

    assert not any((folder / LOCK).exists() for folder in folders)


def test_who_waits_is_called_meanwhile_and_gets_the_lock(tmp_path, holder, monkeypatch):
    monkeypatch.setattr(files, "SECONDS_BETWEEN_ATTEMPTS", 0.01)
    calls = []

    def waiting():
        calls.append(1)
        if len(calls) == 3:
            holder.kill()
            holder.wait()

    with locked(tmp_path, waiting):
        pass

    assert len(calls) == 3


def test_who_is_asked_to_stop_while_waiting_stops(tmp_path, holder):
    def waiting():
        raise SystemExit(143)

    with pytest.raises(SystemExit), locked(tmp_path, waiting):
        pytest.fail("two at once")


def test_a_lock_file_that_its_holder_removed_before_we_locked_it_is_left_for_a_new_one(tmp_path, monkeypatch):
    is_locked, opened = files._is_locked, []

    def removed_first(file):
        opened.append(file)
        if len(opened) == 1:
            (tmp_path / LOCK).unlink()
        return is_locked(file)

    monkeypatch.setattr(files, "_is_locked", removed_first)
    with locked(tmp_path):
        assert (tmp_path / LOCK).exists()

    assert len(opened) == 2


def test_of_many_threads_one_at_a_time_works_in_a_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "SECONDS_BETWEEN_ATTEMPTS", 0.001)
    inside, most = [], []

    def work():
        for _ in range(10):
            with locked(tmp_path, lambda: None):
                inside.append(1)
                most.append(len(inside))
                inside.pop()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert most == [1] * 40


def test_the_lock_ends_with_an_error(tmp_path):
    with pytest.raises(ZeroDivisionError), locked(tmp_path):
        _ = 1 / 0

    with locked(tmp_path):
        pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP])
def test_a_file_system_without_locks_is_named_and_leaves_no_sign_of_a_process(tmp_path, monkeypatch, number):
    def no_locks(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    said = rf"{os.strerror(number)}: .*\.lock cannot be locked; keep runs on a file system with locks"

    with pytest.raises(OSError, match=said), locked(tmp_path):
        pytest.fail("no lock")

    assert list(tmp_path.iterdir()) == []
    assert status_of(tmp_path, error="OSError: no locks") == ("failed", "OSError: no locks")


def test_the_lock_of_another_is_left_where_a_file_system_has_lost_its_locks(tmp_path, monkeypatch):
    (tmp_path / LOCK).write_text("process 1 on another since now")
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(errno.ENOLCK, "No locks available")))

    with pytest.raises(OSError, match="No locks available"), locked(tmp_path):
        pytest.fail("no lock")

    assert (tmp_path / LOCK).read_text() == "process 1 on another since now"


def test_the_lock_of_a_folder_in_the_place_of_one_that_was_moved_is_left(tmp_path):
    (tmp_path / "run").mkdir()
    with locked(tmp_path / "run"):
        (tmp_path / "run").rename(tmp_path / "moved")
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / LOCK).write_text("another's")

    assert (tmp_path / "run" / LOCK).read_text() == "another's"


def test_a_folder_that_cannot_be_written_is_named(monkeypatch, tmp_path):
    def read_only(path, *_, **__):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr("ctgraph_rl.disk.os.open", read_only)

    with pytest.raises(OSError, match=rf"Read-only file system: '{tmp_path}"), locked(tmp_path):
        pytest.fail("no lock")


def test_a_run_whose_directory_is_moved_says_so_at_the_next_write_and_writes_nothing_at_the_old_place(tmp_path):
    class Moves(StopsAfter):
        def offer(self, state, at_block_end):
            self.frames = -1  # never stops the run
            super().offer(state, at_block_end)
            if state()["frames"] == 64:
                (tmp_path / "run").rename(tmp_path / "moved")

    said = (
        "run/run.jsonl was moved, removed or replaced while this run was writing it; the run stops here. Move it back"
    )

    with pytest.raises(FileNotFoundError, match=said):
        learn_into(tmp_path / "run", Moves(tmp_path / "run" / "checkpoints"))

    assert not (tmp_path / "run").exists()
    (tmp_path / "moved").rename(tmp_path / "run")
    learn_into(tmp_path / "run")
    assert (tmp_path / "run" / "metrics.json").exists() and (tmp_path / "run" / "restarts.jsonl").exists()


def test_a_named_file_is_written_whole_and_a_link_to_it_through_the_link(tmp_path, monkeypatch):
    whole = []
    monkeypatch.setattr(disk, "write_whole", lambda path, content: whole.append(path.name))
    (tmp_path / "old").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "old")

    for name in ("new", "old", "link"):
        disk.write_named(tmp_path / name, "text")

    assert whole == ["new", "old"]
    assert (tmp_path / "old").read_text() == "text"


def stored(tmp_path: Path) -> Any:
    """What `write_metrics` stored, with the sum of a log."""
    metric = metrics.average_performance(torch.eye(2, dtype=torch.float64), [(0,)])
    (tmp_path / LOG).write_bytes(b"log")
    write_metrics(tmp_path / METRICS, {"average_performance": metric})
    return json.loads((tmp_path / METRICS).read_text())


def test_the_sums_of_a_run_are_beside_its_metrics(tmp_path):
    stored(tmp_path)

    assert stored_sums(tmp_path) == {LOG: sum_of(b"log")}


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content["files"].pop(METRICS),
        lambda content: content["files"].pop("run"),
        lambda content: content["files"].update(other=sum_of(b"")),
        lambda content: content["files"].update({LOG: {}}),
        lambda content: content.update(files=1),
        lambda content: content["average_performance"].update(value=0.25),
        lambda content: content.update(forgetting=content["average_performance"]),
    ],
)
def test_sums_that_are_not_what_was_written_are_refused(tmp_path, change):
    content = stored(tmp_path)
    change(content)
    (tmp_path / METRICS).write_text(json.dumps(content))

    with pytest.raises(ValueError, match="it is not what was written"):
        stored_sums(tmp_path)
    assert damaged(tmp_path) == [METRICS]
