"""Checkpoints that can be trusted: whole or refused by name, the last two kept, and no code of a file is ever run."""

from __future__ import annotations

import errno
import pickle
import shutil
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.scripted import ONE
from helpers.small_agents import batches
from helpers.stopped_runs import Bomb, bombs, flip_bit, with_header

from ctgraph_rl.runs.checkpoints import KEPT, BrokenCheckpoint, Checkpoints, decoded, encoded


def state(frames: int, size: int = 8) -> dict:
    return {"frames": frames, "agent": {"w": torch.arange(size) + frames, "lr": 0.5, "name": "a", "none": None}}


def saved(folder: Path, *frames: int, **how) -> Checkpoints:
    """Checkpoints after these numbers of frames."""
    checkpoints = Checkpoints(folder / "checkpoints", **how)
    for each in frames:
        checkpoints.save(state(each))
    return checkpoints


def test_what_is_saved_is_read_back_with_its_types(tmp_path):
    found = saved(tmp_path, 64).newest()

    assert found["agent"]["w"].tolist() == list(range(64, 72)) and found["agent"]["w"].dtype == torch.int64
    assert {**found["agent"], "w": 0} == {"w": 0, "lr": 0.5, "name": "a", "none": None}
    assert found["frames"] == 64


def test_an_agent_whose_optimiser_the_compiler_has_marked_is_saved_as_plain_tensors(small_agent, tmp_path):
    agent = small_agent("a2c", [ONE])
    agent.learn(batches(agent, ONE, 1)[0])
    for kept in agent.optimiser.state.values():
        kept["step"].mark = True  # as torch.compile leaves marks of its own

    Checkpoints(tmp_path).save({"frames": 64, "agent": agent.state_dict()})

    assert Checkpoints(tmp_path).newest()["frames"] == 64


def test_without_a_checkpoint_there_is_none(tmp_path):
    assert Checkpoints(tmp_path / "none").newest() is None


def test_the_last_two_are_kept(tmp_path):
    checkpoints = saved(tmp_path, 64, 128, 192, 2 * 10**12)

    assert [int(file.stem) for file in checkpoints.files()] == [2 * 10**12, 192]
    assert checkpoints.newest()["frames"] == 2 * 10**12
    assert checkpoints.newest_frames == 2 * 10**12


def test_a_file_torn_at_any_byte_is_refused_and_named(tmp_path):
    (file,) = saved(tmp_path, 64).files()
    content = file.read_bytes()

    for length in range(len(content)):
        file.write_bytes(content[:length])
        with pytest.raises(
            BrokenCheckpoint, match=r"000000000064\.pt is (no checkpoint, or torn|not what was written)"
        ):
            decoded(file)


def test_a_flipped_bit_anywhere_is_refused_or_changes_nothing_that_is_read(tmp_path):
    (file,) = saved(tmp_path, 64).files()
    content = file.read_bytes()
    header = content.index(b"\n") + 1

    for position in [*range(header), *range(header, len(content), 7)]:
        file.write_bytes(content)
        flip_bit(file, position)
        if position < header:  # such as in a name, of which nothing depends
            try:
                found = decoded(file)
            except BrokenCheckpoint:
                continue
            assert found["agent"]["w"].tolist() == list(range(64, 72))
        else:
            with pytest.raises(BrokenCheckpoint, match="is not what was written"):
                decoded(file)


HOSTILE_HEADERS = {
    "empty": b"",
    "a list": b"[1]\n",
    "a text": b'"x"\n',
    "nested deeply": b"[" * 100_000 + b"\n",
    "a long number": b"1" * 10_000 + b"\n",
    "zeros": bytes(4096),
    "no sum": b'{"format": 1, "bytes": 0}\n',
}


@pytest.mark.parametrize("content", HOSTILE_HEADERS.values(), ids=HOSTILE_HEADERS)
def test_what_is_no_checkpoint_is_refused(tmp_path, content):
    file = tmp_path / "000000000064.pt"
    file.write_bytes(content)

    with pytest.raises(BrokenCheckpoint, match="is no checkpoint, or torn; delete it to resume from the one before"):
        decoded(file)


def test_another_format_is_refused_with_both_numbers(tmp_path):
    file = tmp_path / "000000000064.pt"
    file.write_bytes(with_header(b"", format=2))

    with pytest.raises(BrokenCheckpoint, match="has format 2, this version reads 1; overwrite=true starts again"):
        decoded(file)


def test_a_broken_newest_one_is_named_and_the_one_before_it_is_used(tmp_path):
    checkpoints = saved(tmp_path, 64, 128)
    flip_bit(checkpoints.files()[0], -1)

    with pytest.warns(UserWarning, match=r"000000000128\.pt is not what was written.*the one before it is used"):
        found = checkpoints.newest()

    assert found["frames"] == 64


def test_strict_refuses_to_go_back(tmp_path):
    checkpoints = saved(tmp_path, 64, 128, strict=True)
    flip_bit(checkpoints.files()[0], -1)

    with pytest.raises(BrokenCheckpoint, match=r"000000000128\.pt"):
        checkpoints.newest()


def test_if_all_are_broken_the_run_does_not_start_anew(tmp_path):
    checkpoints = saved(tmp_path, 64, 128)
    for file in checkpoints.files():
        file.write_bytes(b"")

    with pytest.warns(UserWarning), pytest.raises(BrokenCheckpoint, match=r"000000000064\.pt"):
        checkpoints.newest()


def test_a_run_that_has_gone_back_replaces_the_broken_one(tmp_path):
    checkpoints = saved(tmp_path, 64, 128)
    flip_bit(checkpoints.files()[0], -1)

    checkpoints.save(state(96))

    assert [int(file.stem) for file in checkpoints.files()] == [96, 64]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert checkpoints.newest()["frames"] == 96


def test_other_files_are_left_alone_and_what_a_kill_left_is_removed(tmp_path):
    checkpoints = saved(tmp_path, 64)
    (checkpoints.folder / "best.pt").write_bytes(b"mine")
    (checkpoints.folder / "000000000128.pt.part").write_bytes(b"half")

    checkpoints.tidy()
    checkpoints.save(state(128))

    names = sorted(path.name for path in checkpoints.folder.iterdir())
    assert names == ["000000000064.pt", "000000000128.pt", "best.pt"]
    assert checkpoints.newest()["frames"] == 128


def test_a_file_with_code_and_the_right_sum_is_refused_and_the_code_never_runs(tmp_path):
    canary = tmp_path / "canary"

    for name, content in bombs(canary).items():
        file = tmp_path / f"{name}.pt"
        file.write_bytes(with_header(content))
        with pytest.raises(BrokenCheckpoint, match="holds more than tensors and plain values"):
            decoded(file)

    assert not canary.exists()
    pickle.loads(pickle.dumps(Bomb(canary)))
    assert canary.exists(), "the bomb works where pickles are read"


@pytest.mark.parametrize("content", [[1], {"no": "frames"}, {"frames": "64"}])
def test_plain_values_that_are_no_state_are_refused(tmp_path, content):
    torch.save(content, tmp_path / "content")
    file = tmp_path / "000000000064.pt"
    file.write_bytes(with_header((tmp_path / "content").read_bytes()))

    with pytest.raises(BrokenCheckpoint, match="does not say after how many frames"):
        decoded(file)


@pytest.mark.parametrize("value", [np.float64(0.5), Path("x"), lambda: 0], ids=["numpy", "object", "function"])
def test_a_state_that_could_not_be_read_back_is_refused_when_it_is_first_saved(tmp_path, value):
    checkpoints = Checkpoints(tmp_path / "checkpoints")

    with pytest.raises(ValueError, match=r"state_dict\(\) holds tensors and plain Python values"):
        checkpoints.offer(lambda: {"frames": 64, "agent": {"lr": value}}, at_block_end=False)

    assert checkpoints.files() == []


def test_they_are_saved_after_the_first_update_at_block_ends_and_when_time_has_passed(tmp_path, monkeypatch):
    now, kept = [0.0], []
    monkeypatch.setattr("ctgraph_rl.runs.checkpoints.time.monotonic", lambda: now[0])
    checkpoints = Checkpoints(tmp_path / "checkpoints", seconds=10)

    for frames, (seconds, at_block_end) in enumerate([(1, False), (5, False), (6, True), (15, False), (16, False)]):
        now[0] = seconds
        checkpoints.offer(lambda frames=frames: kept.append(frames) or state(frames), at_block_end)

    assert kept == [0, 2, 4]


@pytest.mark.parametrize("seconds", [float("nan"), -1, "60", True])
def test_a_time_between_checkpoints_that_is_no_time_is_refused(tmp_path, seconds):
    with pytest.raises(ValueError, match=f"seconds must be a number >= 0, got {seconds!r}"):
        Checkpoints(tmp_path, seconds)


def full(file: Path, *_) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_names_the_sizes_and_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    checkpoints = saved(tmp_path, 64)
    monkeypatch.setattr("ctgraph_rl.log.files.os.fsync", full)

    with pytest.raises(OSError, match=r"No space left .* cannot write 0\.0 MB to .*128\.pt, .* MB are free") as error:
        checkpoints.save(state(128))

    assert "the checkpoint after 64 frames is kept. Make room, then run the same command" in str(error.value)
    assert [path.name for path in checkpoints.folder.iterdir()] == ["000000000064.pt"]
    assert checkpoints.newest()["frames"] == 64


@pytest.fixture
def tiny_disk(tmp_path):
    """A disk of one MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = shutil.which("mount")
    mounted = mount and subprocess.run([mount, "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder]).returncode == 0
    if not mounted:
        pytest.skip("mounting a disk needs root")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_on_a_disk_that_fills_up_the_last_checkpoint_stays_and_room_is_enough_to_go_on(tiny_disk):
    checkpoints = saved(tiny_disk, 64)
    (tiny_disk / "filler").write_bytes(bytes(900_000))

    with pytest.raises(OSError, match=r"cannot write 0\.8 MB to .*, 0\.\d MB are free; the checkpoint after 64 frames"):
        checkpoints.save(state(128, size=100_000))

    assert [path.name for path in checkpoints.folder.iterdir()] == ["000000000064.pt"]
    (tiny_disk / "filler").unlink()
    checkpoints.save(state(128, size=100_000))
    assert [file.name for file in checkpoints.files()] == ["000000000128.pt", "000000000064.pt"]


def test_a_checkpoint_is_a_header_and_the_state_and_no_more_than_two_lie_on_the_disk(tmp_path):
    size = len(encoded(state(64, size=10_000)))
    checkpoints = Checkpoints(tmp_path / "checkpoints")

    for frames in range(5):
        checkpoints.save(state(frames, size=10_000))

    assert 80_000 < size < 82_000
    assert sum(file.stat().st_size for file in checkpoints.folder.iterdir()) <= KEPT * size
